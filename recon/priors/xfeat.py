"""XFeat (Potje et al. 2024) and LighterGlue as a prior: classical depth, learned matches where plain ones are few.

Both networks are published ONNX files, and run on the processor. "XFeat: Accelerated Features for Lightweight Image
Matching", section 3: a map of descriptors and of their reliability at an eighth of the image, and for each cell of 8 x
8 pixels the odds of a keypoint in each of them. Keypoints are added to a keyframe's points, which the matches then
name.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.config import Internal
from splatnode.recon.keyframes import Keyframe
from splatnode.recon.networks import WeightsError, find
from splatnode.recon.priors import classical
from splatnode.recon.priors.classical import ClassicalPrior

if TYPE_CHECKING:
    import onnxruntime

WEIGHTS = ("xfeat/xfeat_640x640.onnx", "xfeat/lighterglue_L3.onnx")
PACKAGE = "onnxruntime"
Float32 = npt.NDArray[np.float32]
Float64 = npt.NDArray[np.float64]

_SIDE, _CELL = 640, 8  # the file's input is square; the network was trained on any shape
_REACH = 2  # pixels: no two keypoints are closer
_MIN_PROBABILITY = 0.05  # of a keypoint, as published
_REMEMBERED = 64  # keyframes whose keypoints are kept: half a megabyte each


class Config(classical.Config, frozen=True, forbid_unknown_fields=True):
    features: Path | None = None  # ONNX file of XFeat; None: where `splatnode weights` puts it
    matcher: Path | None = None  # ONNX file of LighterGlue; None: the same
    num_keypoints: Internal[int] = 2000  # of an image, at most


def load(config: Config) -> ClassicalPrior:
    """Raises WeightsError where onnxruntime or the weights are missing, or are not XFeat's."""
    _import_onnxruntime()  # the first thing that may be missing
    features = config.features or find(WEIGHTS[0])
    matcher = config.matcher or find(WEIGHTS[1])
    return ClassicalPrior(config, matcher=XfeatMatcher(load_network(features, matcher), config.num_keypoints))


def _import_onnxruntime() -> Any:
    """The package, which is an extra. Raises WeightsError where it is missing."""
    try:
        import onnxruntime
    except ModuleNotFoundError as error:
        raise WeightsError("the prior xfeat needs onnxruntime: pip install 'splatnode[xfeat]'") from error
    return onnxruntime


@dataclass(frozen=True, eq=False)
class _AddedKeypoints:
    """The keypoints that were added to a keyframe's points."""

    first: int  # number of the keyframe's first point that is one of these
    keypoints: Keypoints

    def is_in(self, keyframe: Keyframe) -> bool:
        """Whether the keyframe has them, at `first`."""
        mine = self.keypoints.points
        return np.array_equal(keyframe.features.points[self.first : self.first + len(mine)], mine)


class XfeatMatcher:
    """A `recon.matching.view_graph.Matcher`."""

    def __init__(self, network: Xfeat, num_keypoints: int) -> None:
        self._network, self._count = network, num_keypoints
        self._added: dict[str, _AddedKeypoints] = {}  # by keyframe, the last ones that were asked about

    def add_points(self, keyframe: Keyframe) -> Keyframe:
        known = self._added.get(keyframe.name)
        if known is not None and known.is_in(keyframe):
            return keyframe
        keypoints = self._network.extract(keyframe.frame.image, self._count)
        features = keyframe.features
        self._added[keyframe.name] = _AddedKeypoints(len(features.points), keypoints)
        while len(self._added) > _REMEMBERED:
            del self._added[next(iter(self._added))]
        points = np.concatenate([features.points, keypoints.points])
        return replace(keyframe, features=replace(features, points=points))

    def match(self, keyframe1: Keyframe, keyframe2: Keyframe) -> npt.NDArray[np.int64]:
        first, second = self._added[keyframe1.name], self._added[keyframe2.name]
        sizes = ((keyframe.frame.width, keyframe.frame.height) for keyframe in (keyframe1, keyframe2))
        size1, size2 = sizes
        return self._network.match(first.keypoints, size1, second.keypoints, size2) + [first.first, second.first]


@dataclass(frozen=True, eq=False)
class Keypoints:
    """The most reliable keypoints of an image."""

    points: Float64  # (M, 2) pixels of the image, top-left pixel centre at (0.5, 0.5)
    descriptors: Float32  # (M, 64) of unit length


@dataclass(frozen=True, eq=False)
class Xfeat:
    """The two loaded networks: XFeat's features, and LighterGlue, which matches them."""

    features: onnxruntime.InferenceSession
    matcher: onnxruntime.InferenceSession

    def extract(self, image: npt.NDArray[np.uint8], count: int) -> Keypoints:
        """At most `count` keypoints of an image (H, W, 3)."""
        height, width = image.shape[:2]
        square = cv2.resize(image, (_SIDE, _SIDE), interpolation=cv2.INTER_AREA).astype(np.float32) / 255.0
        descriptors, logits, reliability = self.features.run(None, {"input": square.transpose(2, 0, 1)[None]})
        probability = _compute_heatmap(np.asarray(logits)[0])
        highest = cv2.dilate(probability, np.ones((2 * _REACH + 1,) * 2))
        peaks = (probability == highest) & (probability > _MIN_PROBABILITY)
        row, column = np.nonzero(peaks)
        at = (np.stack([column, row], 1) + 0.5).astype(np.float32)
        score = probability[row, column] * _sample_maps(np.asarray(reliability)[0], at)[:, 0]
        chosen = np.argsort(-score, kind="stable")[:count]
        found = _sample_maps(np.asarray(descriptors)[0], at[chosen])
        found /= np.maximum(np.linalg.norm(found, axis=1, keepdims=True), 1e-12)
        return Keypoints(at[chosen].astype(np.float64) * [width / _SIDE, height / _SIDE], found)

    def match(
        self, first: Keypoints, first_size: tuple[int, int], second: Keypoints, second_size: tuple[int, int]
    ) -> npt.NDArray[np.int64]:
        """(M, 2) indices of keypoints that show the same, the surest first. Sizes are (width, height)."""
        if min(len(first.points), len(second.points)) < 2:
            return np.zeros((0, 2), np.int64)
        inputs = {
            "kpts0": _normalize_points(first.points, first_size)[None],
            "kpts1": _normalize_points(second.points, second_size)[None],
            "desc0": first.descriptors[None],
            "desc1": second.descriptors[None],
        }
        matches, scores = (np.asarray(output) for output in self.matcher.run(None, inputs))
        return matches[np.argsort(-scores, kind="stable")].astype(np.int64)


def load_network(features: Path, matcher: Path, threads: int = 2) -> Xfeat:
    """Raises WeightsError where a file is damaged or another network."""
    onnxruntime, sessions = _import_onnxruntime(), []
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # idle threads sleep
    for path, inputs in ((features, {"input"}), (matcher, {"kpts0", "kpts1", "desc0", "desc1"})):
        try:
            session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
        except Exception as error:  # onnxruntime's own exceptions have no common public base
            raise WeightsError(f"{path} is damaged or not an ONNX file; fetch it again ({error})") from error
        if {entry.name for entry in session.get_inputs()} != inputs:
            raise WeightsError(f"{path} is another network: its inputs must be {', '.join(sorted(inputs))}")
        sessions.append(session)
    return Xfeat(*sessions)


def _compute_heatmap(logits: Float32) -> Float32:
    """(640, 640) probability of a keypoint at each pixel, from logits (65, 80, 80); the last one says "none here"."""
    odds = np.exp(logits - logits.max(0))
    share = (odds / odds.sum(0))[:-1]
    cells = share.reshape(_CELL, _CELL, *logits.shape[1:]).transpose(2, 0, 3, 1)
    return np.ascontiguousarray(cells.reshape(_SIDE, _SIDE), np.float32)


def _sample_maps(maps: Float32, at: Float32) -> Float32:
    """(M, C): maps (C, 80, 80) of cells at pixels (M, 2) of the square."""
    if not len(at):
        return np.zeros((0, len(maps)), np.float32)
    x, y = (at / _CELL - 0.5).astype(np.float32).T
    layers = [
        cv2.remap(layer, x[:, None], y[:, None], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE) for layer in maps
    ]
    return np.asarray(layers, np.float32).reshape(len(maps), -1).T


def _normalize_points(points: Float64, size: tuple[int, int]) -> Float32:
    """Pixels as LighterGlue takes them: from the middle, in halves of the longer side."""
    return ((points - np.array(size) / 2) / (max(size) / 2)).astype(np.float32)
