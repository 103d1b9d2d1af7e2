"""Photographs by a lens that bends lines and is not told: `python -m tests.bench bent --out bent.json`.

Scenes whose photographs were all taken by a pinhole are bent by radial coefficients k1 and, where it is told, k2,
training and held-out photographs alike. `balanced` makes a scene with the distortion that registration estimates taken
out of the photographs ("straight"), and of the same cameras with the photographs as they are ("as photographed"). Held-
out photographs are scored as their scene shows them: straight, or as they are. There only pixels count that the
straight ones show, too; in SSIM and LPIPS the others count as well rendered, which favours the scenes of photographs as
they are.

Scenes as they came follow: how far the estimated distortion moves a corner, and whether photographs are straightened.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.extras.evaluate.dataset import EvaluationScene, Split
from splatnode.extras.evaluate.methods import Start, extract_start_config, find_start
from splatnode.extras.evaluate.protocol import PerceptualNetworks
from splatnode.extras.evaluate.stability.perturbations import TrialImage, distort_image
from splatnode.recon.config import preset
from splatnode.recon.estimation import Reconstruction, estimate_depth, load_prior
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.registration.registration import corner_shift, undistort_keyframes, undistort_pixels
from tests.bench.quality.real_sets import last, measure, timed

SETS = (
    "fountain_p11:6:-0.1",
    "fountain_p11:6:-0.25",
    "llff_fern:6:-0.1",
    "llff_fern:6:-0.25",
    "fountain_p11:6:-0.25:0.1",
    "llff_fern:6:-0.25:0.1",
    "fountain_p11:6:0",
    "llff_fern:6:0",
    "llff_flower:6:0",
    "fox:12:0",
    "sceaux:6:0",
    "tum_fr3_office:6:0",
    "castle_p30:6:0",
)
EVERY = 2  # of the held-out photographs
SIDE = 512  # pixels at which shifts are told
CONFIG = preset("balanced")


@dataclass(frozen=True)
class Row:
    scene: str
    views: int
    k1: float  # by which the photographs were bent
    k2: float  # likewise
    verdict: str
    estimated_k1: float | None  # None: no cameras
    estimated_k2: float | None
    corner_shift_px: float | None  # of SIDE, as estimated, away from the middle
    straightened: bool  # whether it was taken out of the photographs
    kind: str = "as it came"  # straight; as photographed
    psnr: float | None = None
    ssim: float | None = None
    lpips: float | None = None
    focal_error_pct: float | None = None
    rotation_error_deg: float | None = None
    centre_error_pct: float | None = None
    num_gaussians: int | None = None
    seconds: float | None = None  # of the processor, from depth on


@dataclass(frozen=True, eq=False)
class Bent(EvaluationScene):
    """A scene whose photographs were bent, and their true cameras with them."""

    photos: Mapping[str, TrialImage] = field(default_factory=dict)  # by name, bent
    seen_by: tuple[Intrinsics, Intrinsics] | None = None  # a lens and the pinhole of its straight photographs

    def image(self, name: str) -> npt.NDArray[np.uint8]:
        return self.photos[name].image

    def load_masked_image(self, name: str) -> tuple[npt.NDArray[np.uint8], npt.NDArray[np.bool_]]:
        """All of it counts; or, with `seen_by`, what the straight photograph shows."""
        image = self.image(name)
        if self.seen_by is None:
            return image, np.ones(image.shape[:2], bool)
        lens, pinhole = self.seen_by
        height, width = image.shape[:2]
        pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
        shown = undistort_pixels(pixels, lens.resized(width, height), pinhole)
        inside = np.all((shown >= 0) & (shown <= (pinhole.width, pinhole.height)), axis=1)
        return image, inside.reshape(height, width)


def bent(scene: EvaluationScene, names: Sequence[str], k1: float, k2: float) -> Bent:
    """The photographs of these names as a lens with these radial coefficients shows them."""
    photos = {name: distort_image(TrialImage(name, scene.image(name), scene.cameras[name]), k1, k2) for name in names}
    cameras = {name: photo.camera for name, photo in photos.items() if photo.camera is not None}
    return Bent(scene.name, scene.paths, cameras, None, photos)


def as_photographed(estimate: Reconstruction) -> Reconstruction:
    """The same cameras, of which nothing is known but that they are pinholes."""
    if estimate.registration is None:
        raise ValueError("there are no cameras")
    cameras = tuple(replace(camera, radial=np.zeros(2)) for camera in estimate.registration.cameras)
    known = replace(estimate, registration=replace(estimate.registration, cameras=cameras), pointmaps={})
    return estimate_depth(known, load_prior(CONFIG))


def told(scene: EvaluationScene, views: int, k1: float, k2: float, estimate: Reconstruction) -> Row:
    """What was estimated of the lens."""
    registration, code = estimate.registration, estimate.verdict.code.value
    if registration is None or not estimate.publishable:
        return Row(scene.name, views, k1, k2, code, None, None, None, False)
    camera = registration.cameras[0]
    frame = estimate.graph.keyframes[camera.index].frame
    lens = lens_of(estimate, frame)
    straight = undistort_keyframes(estimate.graph, registration)[0] is not estimate.graph
    shift = SIDE * corner_shift(lens)
    found = (round(coefficient, 4) for coefficient in camera.radial.tolist())
    return Row(scene.name, views, k1, k2, code, *found, round(shift, 2), straight)


def lens_of(estimate: Reconstruction, frame: Frame) -> Intrinsics:
    """The lens of the first camera, as it was estimated."""
    if estimate.registration is None:
        raise ValueError("there are no cameras")
    camera = estimate.registration.cameras[0]
    focal, (cx, cy) = camera.focal, camera.principal.tolist()
    return Intrinsics(frame.width, frame.height, focal, focal, cx, cy, "estimated", (*camera.radial.tolist(), 0.0, 0.0))


def scored(start: Start, kind: str, scene: Bent, split: Split, networks: PerceptualNetworks, known: Row) -> Row:
    snapshot, row, seconds = timed(partial(last, start, CONFIG), scene, split, networks)
    return replace(
        known,
        kind=kind,
        straightened=any(camera.lens is not None for camera in snapshot.cameras),
        psnr=row.psnr,
        ssim=row.ssim,
        lpips=row.lpips_alex,
        focal_error_pct=row.focal_error_pct,
        rotation_error_deg=row.rotation_error_deg,
        centre_error_pct=row.centre_error_pct,
        num_gaussians=row.num_gaussians,
        seconds=round(seconds, 1),
    )


def rows(scene: EvaluationScene, split: Split, rest: Sequence[str], networks: PerceptualNetworks) -> list[Row]:
    k1, k2, *_ = (*map(float, rest), 0.0)
    if not k1:
        work = IncrementalReconstruction(extract_start_config(CONFIG))
        for frame in scene.frames(split.train):
            work.add_frame(frame)
        return [told(scene, len(split.train), k1, k2, work.estimate_thoroughly())]
    split = replace(split, test=split.test[::EVERY])
    place = bent(scene, (*split.train, *split.test), k1, k2)
    start = find_start(place.frames(split.train), extract_start_config(CONFIG))
    known = told(scene, len(split.train), k1, k2, start.estimate)
    if not known.straightened or start.estimate.registration is None:
        return [known]
    graph, _ = undistort_keyframes(start.estimate.graph, start.estimate.registration)
    straight = graph.keyframes[start.estimate.registration.cameras[0].index]
    if straight.lens is None or straight.frame.intrinsics is None:
        raise AssertionError("a straightened keyframe has its lens and its pinhole")
    seen = replace(place, seen_by=(straight.lens, straight.frame.intrinsics))
    other = replace(start, estimate=as_photographed(start.estimate))
    return [
        scored(start, "straight", place, split, networks, known),
        scored(other, "as photographed", seen, split, networks, known),
    ]


def in_words(row: Row) -> str:
    estimated = f"{row.scene} {row.views}, bent by {row.k1:g}, {row.k2:g}: {row.verdict}"
    if row.corner_shift_px is not None:
        estimated += f", estimated {row.estimated_k1:+.4f}, {row.estimated_k2:+.4f}, {row.corner_shift_px:+.1f} px"
    if row.psnr is None or row.ssim is None:
        return f"{estimated}, {'straightened' if row.straightened else 'as they are'}"
    return f"{estimated}, {row.kind}: {row.psnr:.2f} dB, SSIM {row.ssim:.3f}, focal {row.focal_error_pct:.1f} %"


def main() -> None:
    measure("bent", __doc__, SETS, "SCENE:VIEWS:K1[:K2]", rows, in_words)


if __name__ == "__main__":
    main()
