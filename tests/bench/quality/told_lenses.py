"""Cameras of real photographs that a known lens bends, and is told: `python -m tests.bench told_lenses --out FILE`.

The photographs of each set are resampled as a radial lens and as an equidistant fisheye would show them, enlarged just
enough that nothing is missing. The reconstruction gets them with that calibration. Errors are those of the cameras
against the true ones, beside those of the photographs as they came, of which the intrinsics are told, too.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import cv2
import numpy as np

from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.lenses import project, unproject
from splatnode.extras.evaluate.dataset import EvaluationScene, Split
from splatnode.extras.evaluate.protocol import CameraErrors, PerceptualNetworks, compare_cameras
from splatnode.extras.evaluate.stability.perturbations import TrialImage, distort_image
from splatnode.recon.config import preset
from splatnode.recon.pipeline import run
from splatnode.recon.result.snapshot import Snapshot
from tests.bench.quality.real_sets import measure
from tests.bench.quality.unknown_lenses import corner_moves_pct

SETS = ("fountain_p11:6", "llff_fern:6", "sceaux:6", "fox:12")
RADIALS = ((-0.25, 0.0), (-0.25, 0.1), (0.1, 0.0))


@dataclass(frozen=True)
class Row:
    scene: str
    views: int
    lens: str
    verdict: str
    corner_moves_pct: float | None  # of its distance from the middle
    rotation_error_deg: float | None
    centre_error_pct: float | None
    seconds: float


def as_it_came(photo: TrialImage) -> TrialImage:
    return replace(photo, intrinsics=_told(photo))


def radial(photo: TrialImage, k1: float, k2: float) -> TrialImage:
    bent = distort_image(photo, k1, k2)
    return replace(bent, intrinsics=replace(_told(bent), distortion=(k1, k2, 0.0, 0.0)))


def fisheye(photo: TrialImage) -> TrialImage:
    """As an equidistant fisheye shows it whose corners look where the photograph's do."""
    pinhole = _told(photo)
    height, width = photo.image.shape[:2]
    across = np.hypot(width / 2.0, height / 2.0) / pinhole.fx
    focal = pinhole.fx * across / float(np.arctan(across))
    told = replace(pinhole, fx=focal, fy=focal, model="fisheye")
    pixels = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), -1).reshape(-1, 2)
    source = project(unproject(pixels, told), pinhole) - 0.5
    columns, rows = source.astype(np.float32).reshape(height, width, 2).transpose(2, 0, 1)
    image = cv2.remap(photo.image, columns, rows, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE).astype(np.uint8)
    return replace(photo, image=image, intrinsics=told)


LENSES: dict[str, Callable[[TrialImage], TrialImage]] = {
    "as it came": as_it_came,
    **{f"radial {k1:+g} {k2:+g}": partial(radial, k1=k1, k2=k2) for k1, k2 in RADIALS},
    "fisheye": fisheye,
}


def rows(scene: EvaluationScene, split: Split, _: Sequence[str], networks: PerceptualNetworks) -> list[Row]:
    photos = [TrialImage(name, scene.image(name), scene.cameras[name]) for name in split.train]
    found = []
    for lens, bent in LENSES.items():
        shown = [bent(photo) for photo in photos]
        frames = [Frame(i, each.name, i, each.image, each.intrinsics) for i, each in enumerate(shown)]
        begun = time.process_time()
        snapshot = run(frames, preset("preview"))
        seconds = round(time.process_time() - begun, 1)
        code, moved = snapshot.verdict.code.value, corner_moves_pct(frames[0].intrinsics or _told(photos[0]))
        errors = _errors(snapshot, scene) if len(snapshot.cameras) > 1 else None
        off = (None, None) if errors is None else (errors.rotation_deg, errors.centre_pct)
        found.append(Row(scene.name, len(photos), lens, code, moved, *off, seconds))
    return found


def _told(photo: TrialImage) -> Intrinsics:
    """The true intrinsics of a photograph that a pinhole took."""
    assert photo.camera is not None
    return photo.camera.intrinsics_for(photo.image.shape[1], photo.image.shape[0])


def _errors(snapshot: Snapshot, scene: EvaluationScene) -> CameraErrors:
    true = [scene.cameras[camera.name] for camera in snapshot.cameras]
    Ts = np.stack([camera.T_world_camera for camera in snapshot.cameras])
    Ks = np.stack([camera.K for camera in snapshot.cameras])  # lenses were told: their errors say nothing
    return compare_cameras(Ts, np.stack([camera.T_world_camera for camera in true]), Ks, Ks)


def in_words(row: Row) -> str:
    if row.rotation_error_deg is None:
        return f"{row.scene} {row.views}, {row.lens}: {row.verdict}"
    errors = f"{row.rotation_error_deg:.3f} degrees, {row.centre_error_pct:.3f} %"
    return f"{row.scene} {row.views}, {row.lens} ({row.corner_moves_pct:.0f} %): {row.verdict}, {errors}"


def main() -> None:
    measure("told_lenses", __doc__, SETS, "SCENE:VIEWS", rows, in_words)


if __name__ == "__main__":
    main()
