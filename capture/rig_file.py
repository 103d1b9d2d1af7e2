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

from collections.abc import Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture.lens_file import read_lenses
from splatnode.capture.process.config_text import MAX_BYTES, parse_yaml
from splatnode.capture.process.files import read_text
from splatnode.capture.process.records import record_of
from splatnode.capture.process.text import LONGEST_NAME, guard_untrusted, sanitize_text
from splatnode.capture.rig import SIGMA_DEG, SIGMA_M, Rig, RigCamera

Array = npt.NDArray[np.float64]

_READ = "a rig: rig.yaml, COLMAP's rig_config.json, or Kalibr's camchain"


class UnusableRig(ValueError):
    """A file that gives no rig; the text says what was expected."""


class _Camera(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    T_rig_camera: tuple[tuple[float, ...], ...] | None = None
    T_base_camera: tuple[tuple[float, ...], ...] | None = None
    sigma_m: float = SIGMA_M
    sigma_deg: float = SIGMA_DEG
    metric: bool = True


class _File(msgspec.Struct, frozen=True):
    cameras: dict[str, _Camera]


def read_rig(path: Path) -> Rig:
    """Returns the rig that a file gives. Raises UnusableRig."""
    shown = sanitize_text(str(path))
    text = read_text(path, MAX_BYTES, UnusableRig, shown, _READ)
    with guard_untrusted(UnusableRig, shown):
        content = parse_yaml(text, shown)  # JSON is YAML
        if isinstance(content, list):
            return _parse_colmap(shown, content)
        if isinstance(content, Mapping) and "cameras" in content:
            return _parse_own(shown, content)
        if isinstance(content, Mapping) and "cam0" in content:
            return _parse_kalibr(path, shown, content)
    raise UnusableRig(f"{shown} must give {_READ}; it has neither `cameras`, nor cam0, nor a list of rigs")


def _parse_own(shown: str, content: Mapping[str, Any]) -> Rig:
    try:
        cameras = record_of(content, _File).cameras
        if any(not camera.metric and camera.T_rig_camera is not None for camera in cameras.values()):
            raise ValueError("it has no metres: its scene had none. Measure it, or leave T_rig_camera out")
        on_base = [name for name, camera in cameras.items() if camera.T_base_camera is not None]
        on_rig = [name for name, camera in cameras.items() if camera.T_rig_camera is not None]
        if on_base and on_rig:
            raise ValueError(
                f"{sanitize_text(on_base[0], LONGEST_NAME)} has T_base_camera and "
                f"{sanitize_text(on_rig[0], LONGEST_NAME)} T_rig_camera: give all cameras the one or the other"
            )
        known = {name: each.T_base_camera or each.T_rig_camera for name, each in cameras.items()}
        found = tuple(RigCamera(name, _flatten(known[name]), each.sigma_m, each.sigma_deg)
                      for name, each in cameras.items())  # fmt: skip
        return Rig(found, is_base=bool(on_base))
    except (ValueError, msgspec.ValidationError) as error:
        raise UnusableRig(f"{shown}: {error}") from error


def _flatten(rows: Sequence[Sequence[float]] | None) -> tuple[float, ...] | None:
    return None if rows is None else tuple(float(number) for row in rows for number in row)


def _parse_colmap(shown: str, content: list[Any]) -> Rig:
    """The first rig: cameras are called as the folders of their images are."""
    if len(content) != 1:
        raise UnusableRig(f"{shown} must have one rig, it has {len(content)}; leave the one that took the images")
    try:
        found = []
        for given in content[0]["cameras"]:
            name = sanitize_text(PurePosixPath(str(given["image_prefix"])).name, LONGEST_NAME)
            T_camera_rig = np.eye(4)
            if not given.get("ref_sensor", False):
                if "cam_from_rig_rotation" not in given:
                    found.append(RigCamera(name))
                    continue
                w, x, y, z = map(float, given["cam_from_rig_rotation"])
                T_camera_rig[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
                T_camera_rig[:3, 3] = [float(number) for number in given["cam_from_rig_translation"]]
            found.append(RigCamera(name, _invert(T_camera_rig)))
        return Rig(tuple(found))
    except (KeyError, TypeError, ValueError) as error:
        raise UnusableRig(
            f"{shown} must have one rig with `cameras`, each with image_prefix, and cam_from_rig_rotation [w, x, y, z] "
            f"and cam_from_rig_translation [x, y, z] unless it is the ref_sensor: {sanitize_text(error)}"
        ) from error


def _parse_kalibr(path: Path, shown: str, content: Mapping[str, Any]) -> Rig:
    """Cameras are called cam0, cam1 and so on, as their lenses are; the rig is cam0."""
    lenses = read_lenses(path).by_key
    try:
        T_camera_rig, found = np.eye(4), []
        for number in range(len(content)):
            given = content[f"cam{number}"]
            if number:
                T_camera_rig = np.reshape([float(x) for row in given["T_cn_cnm1"] for x in row], (4, 4)) @ T_camera_rig
            name = f"cam{number}"
            found.append(RigCamera(name, _invert(T_camera_rig), intrinsics=lenses.get(name)))
        return Rig(tuple(found))
    except (KeyError, TypeError, ValueError) as error:
        raise UnusableRig(
            f"{shown} must have cam0, cam1 and so on, each but the first with T_cn_cnm1, a matrix (4, 4) of its pose "
            f"against the camera before: {sanitize_text(error)}"
        ) from error


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
