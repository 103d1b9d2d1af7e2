"""Rigs in files: rig.yaml, COLMAP's rig_config.json, or a camchain of Kalibr.

Sources of the formats: COLMAP's page on rigs, Kalibr's wiki on its YAML formats. rig.yaml is our own:

    cameras:
      front: {T_rig_camera: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}
      left: {T_rig_camera: [...], sigma_m: 0.002, sigma_deg: 0.1}

Lengths are metres, cameras look along z, x right, y down. Of a camera without T_rig_camera nobody knows where it is.
With T_base_camera in place of T_rig_camera the rig's frame is the robot's base: x forward, y left, z up. One camera is
enough then.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture.lens_file import UnusableLens, read_lenses
from splatnode.capture.process.config import MAX_BYTES, ConfigError, parse_yaml, record_of
from splatnode.capture.process.files import read_text
from splatnode.capture.process.text import LONGEST_NAME, guard_untrusted, sanitize_text
from splatnode.capture.rig import SIGMA_DEG, SIGMA_M, Rig, RigCamera

Array = npt.NDArray[np.float64]

_READ = "a rig: rig.yaml, COLMAP's rig_config.json, or Kalibr's camchain"


_OF_COLMAP = (
    "Each has image_prefix, and cam_from_rig_rotation [w, x, y, z] and cam_from_rig_translation [x, y, z] unless it is "
    "the ref_sensor"
)
_OF_KALIBR = (
    "There must be cam0, cam1 and so on, each but the first with T_cn_cnm1, a matrix (4, 4) of its pose against the "
    "camera before"
)


class UnusableRig(ValueError):
    """A file that gives no rig; the text says what was expected."""


class _Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    T_rig_camera: tuple[tuple[float, ...], ...] | None = None
    T_base_camera: tuple[tuple[float, ...], ...] | None = None
    sigma_m: float = SIGMA_M
    sigma_deg: float = SIGMA_DEG
    metric: bool = True


def read_rig(path: Path) -> Rig:
    """Returns the rig that a file gives. Raises UnusableRig."""
    shown = sanitize_text(str(path))
    text = read_text(path, MAX_BYTES, UnusableRig, shown, _READ)
    with guard_untrusted(UnusableRig, shown):
        try:
            content = parse_yaml(text, shown)  # JSON is YAML
        except ConfigError as error:  # on several lines, of which the first says it; it names the file already
            raise UnusableRig(f"{sanitize_text(' '.join(str(error).split()))}; it must give {_READ}") from error
        if isinstance(content, list):
            return _parse_colmap(shown, content)
        if isinstance(content, Mapping) and "cameras" in content:
            return _parse_own(shown, content)
        if isinstance(content, Mapping) and "cam0" in content:
            return _parse_kalibr(path, shown, content)
    raise UnusableRig(f"{shown} must give {_READ}; it has neither `cameras`, nor cam0, nor a list of rigs")


def _parse_own(shown: str, content: Mapping[str, Any]) -> Rig:
    cameras = content["cameras"]
    if not isinstance(cameras, Mapping):
        raise UnusableRig(
            f"{shown}: cameras must be a mapping of camera ids to T_rig_camera, got {type(cameras).__name__}"
        )
    found = [_parse_own_camera(shown, str(name), each) for name, each in cameras.items()]
    on_base, on_rig = ([str(name) for name, each in cameras.items() if isinstance(each, Mapping) and each.get(key)]
                       for key in ("T_base_camera", "T_rig_camera"))  # fmt: skip
    if on_base and on_rig:
        raise UnusableRig(
            f"{shown}: {sanitize_text(on_base[0], LONGEST_NAME)} has T_base_camera and "
            f"{sanitize_text(on_rig[0], LONGEST_NAME)} T_rig_camera: give all cameras the one or the other"
        )
    return _make_rig(shown, found, bool(on_base))


def _parse_own_camera(shown: str, name: str, given: Any) -> RigCamera:
    with _name_camera(shown, name):
        camera = record_of({} if given is None else given, _Camera)
        if not camera.metric and camera.T_rig_camera is not None:
            raise ValueError("it has no metres: its scene had none. Measure it, or leave T_rig_camera out")
        T = camera.T_base_camera or camera.T_rig_camera
        return RigCamera(name, _flatten(T), camera.sigma_m, camera.sigma_deg)


@contextlib.contextmanager
def _name_camera(shown: str, name: object, expected: str = "") -> Iterator[None]:
    """Makes what is wrong in here an UnusableRig that names the file and the camera, and what was expected of it."""
    try:
        yield
    except UnusableRig:
        raise
    except (KeyError, IndexError, TypeError, ValueError, np.linalg.LinAlgError, msgspec.ValidationError) as error:
        said = f"it has no {error}" if isinstance(error, KeyError) else sanitize_text(error).replace("`", "")
        raise UnusableRig(f"{shown}: camera {sanitize_text(name, 60)!r}: {said}{expected}") from error


def _make_rig(shown: str, cameras: Sequence[RigCamera], is_base: bool = False) -> Rig:
    try:
        return Rig(tuple(cameras), is_base)
    except ValueError as error:
        raise UnusableRig(f"{shown}: {error}") from error


def _flatten(rows: Sequence[Sequence[float]] | None) -> tuple[float, ...] | None:
    return None if rows is None else tuple(float(number) for row in rows for number in row)


def _parse_colmap(shown: str, content: list[Any]) -> Rig:
    """The first rig: cameras are called as the folders of their images are."""
    if len(content) != 1:
        raise UnusableRig(f"{shown} must have one rig, it has {len(content)}; leave the one that took the images")
    listed = content[0].get("cameras") if isinstance(content[0], Mapping) else None
    if not isinstance(listed, list) or not all(isinstance(each, Mapping) for each in listed):
        raise UnusableRig(f"{shown} must have one rig with `cameras`, a list of mappings. {_OF_COLMAP}")
    return _make_rig(shown, [_parse_colmap_camera(shown, number, given) for number, given in enumerate(listed)])


def _parse_colmap_camera(shown: str, number: int, given: Mapping[str, Any]) -> RigCamera:
    with _name_camera(shown, given.get("image_prefix", number), f". {_OF_COLMAP}"):
        name = sanitize_text(PurePosixPath(str(given["image_prefix"])).name, LONGEST_NAME)
        T_camera_rig = np.eye(4)
        if not given.get("ref_sensor", False):
            if "cam_from_rig_rotation" not in given:
                return RigCamera(name)
            w, x, y, z = map(float, given["cam_from_rig_rotation"])
            T_camera_rig[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
            T_camera_rig[:3, 3] = [float(number) for number in given["cam_from_rig_translation"]]
        return RigCamera(name, _invert(T_camera_rig))


def _parse_kalibr(path: Path, shown: str, content: Mapping[str, Any]) -> Rig:
    """Cameras are called cam0, cam1 and so on, as their lenses are; the rig is cam0."""
    try:
        lenses = read_lenses(path).by_key
    except UnusableLens as error:  # it names the file already
        raise UnusableRig(str(error)) from error
    T_camera_rig, found = np.eye(4), []
    for name in (f"cam{number}" for number in range(len(content))):
        with _name_camera(shown, name, f". {_OF_KALIBR}"):
            given = content.get(name, {})
            if name != "cam0":
                T_camera_rig = np.reshape([float(x) for row in given["T_cn_cnm1"] for x in row], (4, 4)) @ T_camera_rig
            found.append(RigCamera(name, _invert(T_camera_rig), intrinsics=lenses.get(name)))
    return _make_rig(shown, found)


def _invert(T: Array) -> tuple[float, ...]:
    return tuple(np.linalg.inv(T).ravel().tolist())


def format_rig(cameras: Sequence[tuple[str, Array, float, float]], metric: bool) -> str:
    """Formats rig.yaml of cameras by id, T_rig_camera (4, 4), and sigmas of position and orientation (degrees)."""
    lines = ["# Cameras on their rig: metres" if metric else "# Cameras on their rig: no metric unit", "cameras:"]
    for name, T, sigma, sigma_deg in cameras:
        rows = ", ".join("[" + ", ".join(f"{number:.9g}" for number in row) + "]" for row in T)
        lines.append(f"  {msgspec.json.encode(name).decode()}:")
        lines.append(f"    T_rig_camera: [{rows}]")
        lines.append(f"    sigma_m: {max(sigma, 1e-9):.6g}")
        lines.append(f"    sigma_deg: {max(sigma_deg, 1e-9):.6g}")
        lines += [] if metric else ["    metric: false"]
    return "\n".join(lines) + "\n"
