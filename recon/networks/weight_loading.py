"""Loads a network from a file of weights, PyTorch's format or safetensors, without running anything in the file."""

from __future__ import annotations

import argparse
import pickle
import re
import zipfile
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TypeVar

import torch
from torch import Tensor, nn

from splatnode.capture.process.printable import sanitize_text

N = TypeVar("N", bound=nn.Module)


def load_network(build: Callable[[], N], weights: Mapping[str, Tensor], path: Path, model: str) -> N:
    """The network of `build` with `weights`, ready for inference in float32.

    Raises ValueError, which calls the network `model`, where the weights of the file `path` are those of another.
    """
    with torch.device("meta"):
        network = build()
    expected = {name: tuple(value.shape) for name, value in network.state_dict().items()}
    check_names_and_shapes(weights, expected, path, model)
    network.load_state_dict({name: tensor.to(torch.float32) for name, tensor in weights.items()}, assign=True)
    return network.eval().requires_grad_(False)


def read_weights(path: Path) -> dict[str, Tensor]:
    """Every tensor of the file by its name; of a training's checkpoint those under `model`.

    Raises ValueError where the file is damaged or holds anything but data, and FileNotFoundError.
    """
    if not path.is_file():
        raise FileNotFoundError(2, "no such checkpoint (splatnode weights tells where it can be had)", str(path))
    if path.suffix == ".safetensors":
        return _check_tensors(_read_safetensors(path), path)
    _check_archive(path)
    try:
        # Only plain data and this one class, which holds attributes and does nothing, are let through.
        with torch.serialization.safe_globals([argparse.Namespace]):
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=zipfile.is_zipfile(path))
    except pickle.UnpicklingError as error:
        named = re.search(r"GLOBAL ([\w.]+)", str(error))
        what = f"it wants to run {named[1]}" if named else "it is not a PyTorch checkpoint of plain data"
        raise ValueError(f"{path} was not loaded: {what}; take the official file") from error
    except MemoryError:
        raise
    except Exception as error:  # of a damaged file: whatever its bytes happen to say
        raise ValueError(f"{path} is damaged or not a PyTorch checkpoint; fetch it again ({error})") from error
    weights = content.get("model", content) if isinstance(content, Mapping) else None
    if not isinstance(weights, Mapping) or not all(isinstance(value, Tensor) for value in weights.values()):
        raise ValueError(f"{path} must hold a dict of tensors, or one under 'model'; it holds something else")
    return _check_tensors(dict(weights), path)


def _check_tensors(weights: dict[str, Tensor], path: Path) -> dict[str, Tensor]:
    """Raises ValueError unless all are plain arrays of numbers, each no larger than what the file holds of it."""
    for name, tensor in weights.items():
        is_plain = type(tensor) in (Tensor, nn.Parameter) and tensor.layout == torch.strided and not tensor.is_quantized
        if not isinstance(name, str) or not is_plain or tensor.device.type != "cpu":
            raise ValueError(
                f"{path} must hold plain tensors, {sanitize_text(str(name), 100)} is none; take the official file"
            )
        held, shown = tensor.untyped_storage().nbytes(), f"{sanitize_text(name, 100)} {tuple(tensor.shape)}"
        if tensor.numel() * tensor.element_size() > held:
            raise ValueError(f"{path} holds {held} bytes of {shown}, fewer than it needs; take the official file")
    return weights


def _check_archive(path: Path) -> None:
    """Raises ValueError where a file of PyTorch's, which is a ZIP archive, would be unpacked to more than its bytes."""
    if not zipfile.is_zipfile(path):
        return
    try:
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise ValueError(f"{path} is damaged or not a PyTorch checkpoint; fetch it again ({error})") from error
    size = path.stat().st_size
    if any(part.compress_type != zipfile.ZIP_STORED for part in parts) or sum(part.file_size for part in parts) > size:
        raise ValueError(
            f"{path} is packed, as no checkpoint of PyTorch is: it was not unpacked; take the official file"
        )


def check_names_and_shapes(
    weights: Mapping[str, Tensor], expected: Mapping[str, tuple[int, ...]], path: Path, model: str
) -> None:
    """Raises ValueError that names what is missing, what does not belong, or whose shape differs."""
    missing, extra = sorted(set(expected) - set(weights)), sorted(set(weights) - set(expected))
    wrong = [name for name, shape in expected.items() if name in weights and tuple(weights[name].shape) != shape]
    if not (missing or extra or wrong):
        return
    complaints = []
    if missing:
        complaints.append(f"lacks {_abbreviate_names(missing)}")
    if extra:
        complaints.append(f"has {_abbreviate_names(extra)}, which does not belong to it")
    if wrong:
        name = wrong[0]
        complaints.append(f"has {name} of shape {tuple(weights[name].shape)} instead of {expected[name]}")
    raise ValueError(f"{path} is not the checkpoint of {model}: it {'; it '.join(complaints)}")


def _read_safetensors(path: Path) -> dict[str, Tensor]:
    try:
        from safetensors.torch import load_file
    except ImportError as error:
        raise ValueError(f"{path} needs the package safetensors: pip install 'splatnode[learned]'") from error
    try:
        return load_file(path)
    except MemoryError:
        raise
    except Exception as error:  # of a damaged file: whatever its bytes happen to say
        raise ValueError(f"{path} is damaged or not a safetensors file; fetch it again ({error})") from error


def _abbreviate_names(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"
