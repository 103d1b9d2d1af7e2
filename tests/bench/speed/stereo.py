"""How good and how fast dense stereo is with the true cameras: `python -m tests.bench stereo fountain_p11 sceaux`.

The reference are SIFT points of the larger images, matched between all views, triangulated with the true cameras and
kept where every ray agrees: sparse, biased to textured places, but independent of the method. Coverage is the share of
pixels with a depth among those whose nearest reference depth puts them inside a second view: occluded pixels, bare
ground and the sky count against it. The same among pixels close to a reference point leaves most of those out.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.extras.priors.patchmatchnet import WEIGHTS, NetworkStereo, load_network
from splatnode.recon.keyframes import resize_image
from splatnode.recon.networks import find
from splatnode.recon.priors.classical import DepthEstimator
from splatnode.recon.priors.stereo import (
    DepthMap,
    SparsePoints,
    StereoConfig,
    StereoView,
    estimate_depth_maps,
    estimate_depth_range,
)

Float64 = npt.NDArray[np.float64]
LONGER_SIDE = 512  # of the images that stereo works on
REPROJECTION_PX = 1.0  # largest residual of a reference point, pixels of the large image
NEAR_PX = 16.0  # how far a pixel may be from a reference point to count as close
RELATIVE_SIGMA = 0.004  # largest expected relative error of a reference depth, for 0.3 px of image noise


@dataclass(frozen=True, eq=False)
class Photo:
    """An image of a scene with its true camera."""

    name: str
    image: npt.NDArray[np.uint8]  # (H, W, 3) RGB
    K: Float64
    T_world_camera: Float64
    points: Float64  # (M, 2) SIFT
    descriptors: npt.NDArray[np.float32]  # (M, 128)


def read_photos(scene: Path, names: list[str]) -> list[Photo]:
    cameras = {camera["name"]: camera for camera in json.loads((scene / "cameras.json").read_text())["images"]}
    sift = cv2.SIFT.create(nfeatures=5000, contrastThreshold=0.02)
    photos = []
    for name in names:
        image = cv2.cvtColor(cv2.imread(str(scene / "images" / name)), cv2.COLOR_BGR2RGB)
        keypoints, descriptors = sift.detectAndCompute(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), None)
        T_camera_world = np.eye(4)
        T_camera_world[:3, :3], T_camera_world[:3, 3] = cameras[name]["R"], cameras[name]["t"]
        points = np.array([keypoint.pt for keypoint in keypoints]) + 0.5
        descriptors = np.sqrt(descriptors / descriptors.sum(1, keepdims=True))
        photos.append(
            Photo(name, image, np.array(cameras[name]["K"]), np.linalg.inv(T_camera_world), points, descriptors)
        )
    return photos


def reference_depths(photo: Photo, others: list[Photo]) -> tuple[Float64, Float64]:
    """(M, 2) pixels and (M,) depths of points of `photo` triangulated with `others`.

    A match gives a depth along the photo's own ray, and its expected error. Kept are points with a small expected error
    on which all matches within reach agree; their depth is the mean weighted by precision.
    """
    precision = np.zeros(len(photo.points))
    weighted = np.zeros(len(photo.points))
    squares = np.zeros(len(photo.points))
    for other in others:
        index, depth, sigma = _pair_depths(photo, other)
        np.add.at(precision, index, 1 / sigma**2)
        np.add.at(weighted, index, np.log(depth) / sigma**2)
        np.add.at(squares, index, np.log(depth) ** 2 / sigma**2)
    found = precision > 1 / RELATIVE_SIGMA**2
    mean = weighted[found] / precision[found]
    disagreement = np.sqrt(np.maximum(squares[found] / precision[found] - mean**2, 0))
    agreeing = disagreement < 0.01
    return photo.points[found][agreeing], np.exp(mean[agreeing])


def _pair_depths(photo: Photo, other: Photo) -> tuple[npt.NDArray[np.intp], Float64, Float64]:
    """Indices of matched points, their depths and relative standard deviations."""
    first, second = _mutual_matches(photo.descriptors, other.descriptors)
    T_other_photo = np.linalg.inv(other.T_world_camera) @ photo.T_world_camera
    here, there = photo.points[first], other.points[second]
    a = np.c_[here, np.ones(len(here))] @ (other.K @ T_other_photo[:3, :3] @ np.linalg.inv(photo.K)).T
    b = other.K @ T_other_photo[:3, 3]
    # there = (a z + b) / (.): least squares in the one unknown z after cross-multiplication.
    p = a[:, :2] - there * a[:, 2:]
    q = there * b[2] - b[:2]
    z = (p * q).sum(1) / np.maximum((p * p).sum(1), 1e-12)
    point = a * z[:, None] + b
    error = np.linalg.norm(point[:, :2] / point[:, 2:] - there, axis=1)
    step = 1e-4
    moved = a * (z * (1 + step))[:, None] + b
    pixels_per_relative = np.linalg.norm(moved[:, :2] / moved[:, 2:] - point[:, :2] / point[:, 2:], axis=1) / step
    sigma = 0.3 / np.maximum(pixels_per_relative, 1e-9)
    good = (z > 0) & (point[:, 2] > 0) & (error < REPROJECTION_PX) & (sigma < 0.05)
    return first[good], z[good], sigma[good]


def _mutual_matches(a: npt.NDArray[np.float32], b: npt.NDArray[np.float32]) -> tuple:
    similarity = a @ b.T
    best = similarity.argmax(1)
    rows = np.arange(len(a))
    top = similarity[rows, best]
    similarity_without = similarity.copy()
    similarity_without[rows, best] = -1
    ratio = np.sqrt((2 - 2 * np.minimum(top, 1)) / np.maximum(2 - 2 * similarity_without.max(1), 1e-9))
    keep = (similarity.argmax(0)[best] == rows) & (ratio < 0.8)
    return rows[keep], best[keep]


def stereo_view(photo: Photo, depths: Float64, longer_side: int) -> StereoView:
    image = resize_image(photo.image, longer_side)
    scale = np.diag([image.shape[1] / photo.image.shape[1], image.shape[0] / photo.image.shape[0], 1.0])
    return StereoView(image, scale @ photo.K, photo.T_world_camera, estimate_depth_range(depths))


def perturbed(view: StereoView, angle_deg: float, generator: np.random.Generator) -> StereoView:
    """The view turned by `angle_deg` about a random axis through its centre."""
    axis = generator.normal(size=3)
    rotation, _ = cv2.Rodrigues(axis / np.linalg.norm(axis) * np.radians(angle_deg))
    T_world_camera = view.T_world_camera.copy()
    T_world_camera[:3, :3] = T_world_camera[:3, :3] @ rotation
    return replace(view, T_world_camera=T_world_camera)


def seen_twice(
    views: list[StereoView], index: int, points: Float64, depths: Float64
) -> tuple[npt.NDArray[np.bool_], npt.NDArray[np.bool_]]:
    """(h, w) pixels that the nearest reference depth puts into another view's image; (h, w) the ones close to it."""
    view = views[index]
    height, width = view.image.shape[:2]
    elsewhere = np.ones((height, width), np.uint8)
    x, y = np.clip(points.astype(int), 0, [width - 1, height - 1]).T
    elsewhere[y, x] = 0
    distance, labels = cv2.distanceTransformWithLabels(elsewhere, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    by_label = np.zeros(labels.max() + 1)
    by_label[labels[y, x]] = depths
    depth = by_label[labels].ravel()
    u, v = np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5)
    rays = np.stack([u.ravel(), v.ravel(), np.ones(u.size)], 1) @ np.linalg.inv(view.K).T
    world = (rays * depth[:, None]) @ view.T_world_camera[:3, :3].T + view.T_world_camera[:3, 3]
    result = np.zeros(u.size, bool)
    for other in (*views[:index], *views[index + 1 :]):
        T_camera_world = np.linalg.inv(other.T_world_camera)
        px, py, pz = other.K @ (T_camera_world[:3, :3] @ world.T + T_camera_world[:3, 3:])
        other_height, other_width = other.image.shape[:2]
        result |= (pz > 0) & (px >= 0) & (py >= 0) & (px < other_width * pz) & (py < other_height * pz)
    seen = result.reshape(height, width)
    return seen, seen & (distance < NEAR_PX)


def sparsification(errors: Float64, confidence: Float64) -> tuple[Float64, float, float]:
    """Mean error of the most confident 100, 90, ... 10 %; area under that curve; the same for perfect ranking."""
    fractions = np.linspace(1.0, 0.1, 10)
    by_confidence = errors[np.argsort(-confidence, kind="stable")]
    by_error = np.sort(errors)
    counts = np.maximum((fractions * len(errors)).astype(int), 1)
    curve = np.array([by_confidence[:count].mean() for count in counts])
    return curve, float(curve.mean()), float(np.mean([by_error[:count].mean() for count in counts]))


@dataclass(frozen=True, eq=False)
class Case:
    """Views of a scene with their reference points, at the size that stereo works on."""

    views: list[StereoView]
    points: list[Float64]  # (M, 2) each
    depths: list[Float64]  # (M,) each
    seen_twice: list[npt.NDArray[np.bool_]]  # (h, w) each
    seen_twice_close: list[npt.NDArray[np.bool_]]  # (h, w) each, of these the ones close to a reference point


def make_case(scene: Path, names: list[str], reference_names: list[str], longer_side: int = LONGER_SIDE) -> Case:
    photos = {photo.name: photo for photo in read_photos(scene, reference_names)}
    references = [
        reference_depths(photos[name], [photo for photo in photos.values() if photo.name != name]) for name in names
    ]
    views = [
        stereo_view(photos[name], depths, longer_side) for name, (_, depths) in zip(names, references, strict=True)
    ]
    points = [
        points * np.array(view.image.shape[1::-1]) / np.array(photos[name].image.shape[1::-1])
        for name, view, (points, _) in zip(names, views, references, strict=True)
    ]
    depths = [depths for _, depths in references]
    seen = [seen_twice(views, i, points[i], depths[i]) for i in range(len(views))]
    return Case(views, points, depths, [all_of_them for all_of_them, _ in seen], [close for _, close in seen])


def measure(case: Case, maps: list[DepthMap]) -> dict:
    """Errors at the reference points that a second view can see, coverage, calibration and ranking."""
    errors, confidences, total = [], [], 0
    for points, depths, visible, depth_map in zip(case.points, case.depths, case.seen_twice, maps, strict=True):
        x, y = points.astype(int).T
        found = visible[y, x] & (depth_map.depth[y, x] > 0)
        total += int(visible[y, x].sum())
        errors.append(np.abs(depth_map.depth[y, x][found] / depths[found] - 1))
        confidences.append(depth_map.confidence[y, x][found])
    error, confidence = np.concatenate(errors), np.concatenate(confidences)
    known = [depth_map.depth > 0 for depth_map in maps]
    sure = [depth_map.confidence > 0.5 for depth_map in maps]
    curve, area, best_area = sparsification(np.minimum(error, 0.1), confidence)
    return {
        "points": total,
        "median_relative_error": float(np.median(error)),
        "p90_relative_error": float(np.percentile(error, 90)),
        "share_within_1pct": float((error < 0.01).mean()),
        "share_within_1pct_of_all": float((error < 0.01).sum() / total),
        "points_missing": 1 - len(error) / total,
        "coverage": _share(known, case.seen_twice),
        "coverage_confident": _share(sure, case.seen_twice),
        "coverage_close": _share(known, case.seen_twice_close),
        "mean_confidence": float(confidence.mean()),
        "sparsification": [round(float(value), 6) for value in curve],
        "sparsification_area": area,
        "sparsification_area_best": best_area,
    }


def _share(masks: list[npt.NDArray[np.bool_]], among: list[npt.NDArray[np.bool_]]) -> float:
    return float(sum((m & a).sum() for m, a in zip(masks, among, strict=True)) / sum(a.sum() for a in among))


def run(
    case: Case,
    config: StereoConfig,
    *,
    seed: int = 0,
    pose_error_deg: float = 0.0,
    seeded: float = 0.0,
    method: DepthEstimator = estimate_depth_maps,
) -> tuple:
    """(depth maps, measurements). `seeded` is the share of reference points given as sparse points."""
    generator = np.random.default_rng(seed)
    views = [perturbed(view, pose_error_deg, generator) for view in case.views] if pose_error_deg else case.views
    sparse = None
    if seeded:
        chosen = [generator.random(len(depths)) < seeded for depths in case.depths]
        sparse = [SparsePoints(p[c], d[c]) for p, d, c in zip(case.points, case.depths, chosen, strict=True)]
    wall, processor = time.perf_counter(), time.process_time()
    maps = method(views, config, seed=seed, sparse=sparse)
    seconds = {"wall": time.perf_counter() - wall, "cpu": time.process_time() - processor}
    return maps, {"seconds": seconds, **measure(case, maps)}


def _patchmatchnet() -> DepthEstimator:
    return NetworkStereo(load_network(find(*WEIGHTS))).estimate_depth_maps


METHODS: dict[str, Callable[[], DepthEstimator]] = {
    "classical": lambda: estimate_depth_maps,
    "patchmatchnet": _patchmatchnet,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scenes", nargs="+")
    parser.add_argument("--split", default="train6", help="which views of splits.json (train3, train6, train12)")
    parser.add_argument("--shared", type=Path, default=Path("../shared"), help="folder with scenes/")
    parser.add_argument("--pose-error-deg", type=float, default=0.0, help="turn every camera by this much")
    parser.add_argument("--seeded", type=float, default=0.0, help="share of reference points given as sparse points")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--method", choices=METHODS, default="classical")
    parser.add_argument("--out", type=Path, help="JSON file to write")
    arguments = parser.parse_args()
    splits = json.loads((arguments.shared / "scenes" / "splits.json").read_text())
    rows = []
    for name in arguments.scenes:
        names = splits[name][arguments.split]
        case = make_case(arguments.shared / "scenes" / name, names, sorted({*names, *splits[name]["test"]}))
        _, row = run(
            case,
            StereoConfig(),
            seed=arguments.seed,
            pose_error_deg=arguments.pose_error_deg,
            seeded=arguments.seeded,
            method=METHODS[arguments.method](),
        )
        asked = {"split": arguments.split, "method": arguments.method, "pose_error_deg": arguments.pose_error_deg}
        rows.append({"scene": name, **asked, **row})
        print(json.dumps(rows[-1]))
    if arguments.out:
        arguments.out.write_text(json.dumps({"rows": rows}, indent=1))


if __name__ == "__main__":
    main()
