"""Three cameras on a rig in the built-in building, against truth: `python -m tests.bench rigs --out FILE [--sets N]`.

The cameras' lenses are told. The rig is estimated from the frame sets alone, and given with .5 cm and .5 degrees, with
errors drawn as these say. A mount's pose on the rig is compared with the true one after the best similarity of all
cameras: right is within .1 degrees and .3 % of the distance to the scene, and within its bounds. COLMAP's incremental
mapper with its rig mode, which must be given a rig, is beside it where pycolmap is installed.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture.image_file import encode_png
from splatnode.capture.process.terminal import say
from splatnode.capture.rig import Rig, RigCamera
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction, estimate_cameras, load_prior
from splatnode.recon.geometry import align_cameras
from splatnode.recon.pipeline import estimate_frame_cameras
from splatnode.recon.replay_source import DRAWN_SIGMA_DEG, DRAWN_SIGMA_M, hold_rig
from splatnode.recon.threads import Clock
from tests.support.rig_walk import RigWalk, make_rig_walk, true_mounts

Array = npt.NDArray[np.float64]

SETS, SIZE = 30, (320, 240)
MOST_DEG, MOST_PERCENT = 0.1, 0.3
_WIDE = 1.96 * np.sqrt(3.0)  # bounds of an error's three components together, in sigmas


@dataclass(frozen=True)
class Row:
    """One mount. Bounds are None where the method claims none."""

    method: str
    camera: str
    degrees: float
    percent: float  # of the distance to the scene
    bound_deg: float | None
    bound_percent: float | None
    placed: int  # images
    seconds: float
    verdict: str

    @property
    def is_right(self) -> bool:
        return self.degrees <= MOST_DEG and self.percent <= MOST_PERCENT

    @property
    def holds(self) -> bool | None:
        """Whether the errors are within the bounds."""
        if self.bound_deg is None or self.bound_percent is None:
            return None
        return self.degrees <= self.bound_deg and self.percent <= self.bound_percent


def draw_rig(seed: int) -> Rig:
    """The true rig as static transforms have it: with errors."""
    generator, cameras = np.random.default_rng(seed), []
    for camera, T in true_mounts().items():
        turn = Rotation.from_rotvec(np.radians(DRAWN_SIGMA_DEG) * generator.normal(size=3)).as_matrix()
        T[:3, :3], T[:3, 3] = T[:3, :3] @ turn, T[:3, 3] + DRAWN_SIGMA_M * generator.normal(size=3)
        cameras.append(RigCamera(camera, tuple(T.ravel().tolist()), DRAWN_SIGMA_M, DRAWN_SIGMA_DEG))
    return Rig(tuple(cameras))


def compare_mounts(
    mounts: Mapping[str, Array], reference: str, found: Array, true: Array
) -> Iterator[tuple[str, float, float, float]]:
    """Of each other mount: its camera, degrees and metres of its error; and the metres of a unit, by all cameras."""
    scale, known = align_cameras(found, true).scale, true_mounts()
    for camera, T in mounts.items():
        truly = np.linalg.inv(known[reference]) @ known[camera]
        degrees = np.degrees(Rotation.from_matrix(T[:3, :3].T @ truly[:3, :3]).magnitude())
        yield camera, float(degrees), float(np.linalg.norm(scale * T[:3, 3] - truly[:3, 3])), scale


def score(method: str, estimate: Reconstruction, walk: RigWalk, seconds: float) -> list[Row]:
    rig, registration = estimate.rig, estimate.registration
    if rig is None or registration is None:
        return [Row(method, "", np.inf, np.inf, None, None, 0, seconds, estimate.verdict.code.value)]
    names = estimate.graph.names
    found = np.stack([camera.T_world_camera for camera in registration.cameras])
    true = np.stack([walk.poses[names[camera.index]] for camera in registration.cameras])
    mounts = {mount.camera_id: mount for mount in reversed(rig.mounts[1:])}
    poses = {camera: mount.T_rig_camera for camera, mount in mounts.items()}
    rows = []
    for camera, degrees, metres, unit in compare_mounts(poses, rig.mounts[0].camera_id, found, true):
        mount = mounts[camera]  # the distance to the scene is the unit
        bounds = float(_WIDE * mount.sigma_deg), float(100 * _WIDE * mount.sigma)
        code, percent = estimate.verdict.code.value, 100 * metres / unit
        rows.append(Row(method, camera, degrees, percent, *bounds, len(found), seconds, code))
    return rows


def run_colmap(walk: RigWalk, rig: Rig, distance_m: float) -> list[Row]:
    """COLMAP's rig mode, with the same lens and the same given rig. Rows have no bounds."""
    import pycolmap

    began = time.perf_counter()
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    with TemporaryDirectory(prefix="splatnode-bench-") as name:
        folder = Path(name)
        _write_images(walk, folder / "images")
        lens = walk.frames[0].intrinsics
        if lens is None:
            raise ValueError("the lenses of the walk must be told")
        reader = pycolmap.ImageReaderOptions()
        reader.camera_model, reader.camera_params = "PINHOLE", f"{lens.fx},{lens.fy},{lens.cx},{lens.cy}"
        database = folder / "database.db"
        pycolmap.extract_features(
            database, folder / "images", camera_mode=pycolmap.CameraMode.PER_FOLDER, reader_options=reader
        )
        (folder / "rig.json").write_text(json.dumps([{"cameras": list(_format_colmap(rig))}]))
        with pycolmap.Database.open(database) as opened:
            pycolmap.apply_rig_config(pycolmap.read_rig_config(folder / "rig.json"), opened)
        pycolmap.match_exhaustive(database, device=pycolmap.Device.cpu)
        options = pycolmap.IncrementalPipelineOptions()
        options.random_seed = 0
        models = pycolmap.incremental_mapping(database, folder / "images", folder / "models", options)
        seconds = time.perf_counter() - began
        if not models:
            return [Row("colmap", "", np.inf, np.inf, None, None, 0, seconds, "no model")]
        model = max(models.values(), key=lambda each: each.num_reg_images())
        return list(_score_colmap(model, walk, distance_m, seconds))


def _write_images(walk: RigWalk, folder: Path) -> None:
    for frame in walk.frames:
        path = folder / frame.camera_id / frame.name.removeprefix(f"{frame.camera_id}_")
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(encode_png(frame.image))


def _format_colmap(rig: Rig) -> Iterator[dict[str, Any]]:
    first = rig.cameras[0].matrix
    for camera in rig.cameras:
        if camera.matrix is None or first is None:
            raise ValueError("every camera of the rig must have a pose")
        T = np.linalg.inv(camera.matrix) @ first
        x, y, z, w = Rotation.from_matrix(T[:3, :3]).as_quat().tolist()
        given = {"cam_from_rig_rotation": [w, x, y, z], "cam_from_rig_translation": T[:3, 3].tolist()}
        pose = {"ref_sensor": True} if camera is rig.cameras[0] else given
        yield {"image_prefix": f"{camera.camera_id}/", **pose}


def _score_colmap(model: Any, walk: RigWalk, distance_m: float, seconds: float) -> Iterator[Row]:
    worlds: dict[str, Array] = {}
    for image in model.images.values():
        if image.has_pose:
            T = np.eye(4)
            T[:3] = image.cam_from_world().matrix()
            worlds[image.name.replace("/", "_")] = np.linalg.inv(T)
    names = sorted(worlds)
    sets = {name.rpartition("_")[2] for name in names}
    whole = next(each for each in sorted(sets) if all(f"{camera}_{each}" in worlds for camera in true_mounts()))
    base = np.linalg.inv(worlds[f"front_{whole}"])
    mounts = {camera: base @ worlds[f"{camera}_{whole}"] for camera in true_mounts() if camera != "front"}
    found, true = np.stack([worlds[name] for name in names]), np.stack([walk.poses[name] for name in names])
    for camera, degrees, metres, _ in compare_mounts(mounts, "front", found, true):
        percent = 100 * metres / distance_m
        yield Row("colmap", camera, degrees, percent, None, None, len(names), seconds, "")


def table(rows: Sequence[Row]) -> Iterator[str]:
    for row in rows:
        bounds = "" if row.bound_deg is None else f" (bounds {row.bound_deg:.3f} and {row.bound_percent:.3f})"
        held = {None: "no bounds", True: "within", False: "BEYOND"}[row.holds]
        errors = f"{row.degrees:.3f} degrees, {row.percent:.3f} % of the distance{bounds}"
        judged = f"{'right' if row.is_right else 'NOT RIGHT'}, {held}"
        work = f"{row.placed} images, {row.seconds:.0f} s {row.verdict}"
        yield f"{row.method:10s} {row.camera:6s} {errors}: {judged}; {work}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="JSON file")
    parser.add_argument("--sets", type=int, default=SETS)
    parser.add_argument("--seed", type=int, default=0, help="of the errors of the given rig")
    arguments = parser.parse_args()
    walk, rig = make_rig_walk(arguments.sets, size=SIZE, lens_told=True), draw_rig(arguments.seed)
    config, began = ReconstructionConfig(no_fallbacks=True), time.perf_counter()
    alone, _ = estimate_frame_cameras(walk.frames, load_prior(config), config, Clock())
    rows = score("estimated", alone, walk, time.perf_counter() - began)
    began = time.perf_counter()  # the matches are there
    given = estimate_cameras(alone.graph, (), hold_rig(config, rig))
    rows += score("given", given, walk, time.perf_counter() - began)
    _write(arguments.out, arguments.sets, rows, "")
    if importlib.util.find_spec("pycolmap") is None:
        said = "pycolmap is not installed: COLMAP's rig mode is not beside it"
    elif given.rig is None or given.rig.metres_per_unit is None:
        said = "the rig told no metres: COLMAP's rig mode is not beside it"
    else:
        said = ""
        rows += run_colmap(walk, rig, given.rig.metres_per_unit)
    _write(arguments.out, arguments.sets, rows, said)
    for line in [*table(rows), *filter(None, [said])]:
        say(line)


def _write(out: Path, sets: int, rows: Sequence[Row], said: str) -> None:
    told = {"sets": sets, "table": list(table(rows)), "said": said, "rows": [asdict(row) for row in rows]}
    out.write_text(json.dumps(told, indent=1) + "\n")


if __name__ == "__main__":
    main()
