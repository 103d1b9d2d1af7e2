"""The learned parts, what each is for, and whether it can be used here: its package, its weights, their licence."""

from __future__ import annotations

import importlib.util
from dataclasses import dataclass

from splatnode.recon.networks.catalogue import CATALOGUE
from splatnode.recon.networks.weights import complaint, located


@dataclass(frozen=True)
class Part:
    name: str
    purpose: str
    files: tuple[str, ...]  # of splatnode.recon.networks.catalogue.CATALOGUE
    package: str | None = None  # import name of what it needs beside torch

    @property
    def licence(self) -> str:
        """Of the weights."""
        return "; ".join(dict.fromkeys(weights.licence for weights in CATALOGUE if weights.path in self.files))


PARTS = (
    Part("mast3r", "prior", ("mast3r/MASt3R_ViTLarge_BaseDecoder_512_catmlpdpt_metric.pth",)),
    Part("da3", "prior", ("da3/da3-small.safetensors",), "safetensors"),
    Part("patchmatchnet", "prior", ("patchmatchnet/patchmatchnet_dtu.pth",)),
    Part("xfeat", "prior", ("xfeat/xfeat_640x640.onnx", "xfeat/lighterglue_L3.onnx"), "onnxruntime"),
    Part("aliked", "prior", ("aliked/aliked-n16.pth",)),
    Part("mono depth", "depth and normal losses", ("depth_anything_v2/depth_anything_v2_vits.pth",)),
    Part("dinov2", "semantic loss", ("dinov2/dinov2_vits14_pretrain.pth",)),
    Part("metric", "metres indoors", ("depth_anything_v2/depth_anything_v2_metric_hypersim_vits.pth",)),
)


def obstacle(part: Part) -> str:
    """What keeps `part` from being used, and the remedy; empty if nothing does, as far as digests tell."""
    if part.package is not None and not importlib.util.find_spec(part.package):
        return f"pip install {part.package}"
    known = {weights.path: weights for weights in CATALOGUE}
    for file in part.files:
        where, name = located(file), known[file].name
        if where is None:
            return f"no weights: splatnode weights fetch {name}" if known[file].url else f"no weights: see {name}"
        if wrong := complaint(known[file], where):
            return f"{where}: {wrong}; splatnode weights fetch {name}"
    return ""
