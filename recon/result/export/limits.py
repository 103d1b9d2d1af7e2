"""The limits of scene files: how much they may hold, whatever they say, and what a Gaussian in them must satisfy."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import permutations, product
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.capture.process.files import read_bounded
from splatnode.recon.result.placement import matrices_from_quats, quats_from_matrices
from splatnode.recon.result.snapshot import MAX_COORDINATE, SHELL, GaussianArrays, find_confirmed
from splatnode.recon.result.verdict import Scale

# How much a scene file may hold, whatever it says of itself, and how its bytes are read.

# SceneFileError: a file that cannot be read as the scene it should hold.


class SceneFileError(ValueError):
    """The message names the file, what was expected in it and what was found."""


MAX_GAUSSIANS = 10_000_000
MAX_VALUES = 350_000_000  # numbers of all Gaussians: 5.6 million with spherical harmonics of degree 3
BYTES_A_VALUE = 16  # of memory at most while a scene is read, beside the file's bytes
MAX_SCENE_BYTES = 4_000_000_000
MAX_JSON_BYTES = 50_000_000  # of cameras.json and report.json
MAX_CAMERAS = 10_000
_OTHER_VALUES = 12  # of a Gaussian beside its colour: centre, rotation, extents, opacity, source


def check_count(num_gaussians: int, num_bases: int, name: str) -> None:
    """Raises SceneFileError, which names the file as `name`, where these are more Gaussians than can be read."""
    most = min(MAX_GAUSSIANS, MAX_VALUES // count_values(num_bases))
    if num_gaussians > most:
        raise SceneFileError(
            f"{name} promises {num_gaussians} Gaussians; at most {most} with {num_bases} coefficients a colour can be "
            "read. Prune it, or save it with spherical harmonics of a lower degree"
        )


def count_values(num_bases: int) -> int:
    """How many numbers one Gaussian has."""
    return _OTHER_VALUES + 3 * num_bases


def read_scene_file(path: Path) -> bytes:
    """Raises SceneFileError, OSError."""
    return read_bounded(path, MAX_SCENE_BYTES, SceneFileError, path.name)


def read_json_file(path: Path) -> bytes:
    """Raises SceneFileError, OSError."""
    return read_bounded(path, MAX_JSON_BYTES, SceneFileError, path.name)


# What a Gaussian must satisfy before it is written: viewers trust their input, so files hold only sane values.

SH_C0 = 0.5 / np.sqrt(np.pi)  # the constant basis function; splatnode.recon.scene has it too, but needs torch

_FARTHEST = 1000.0  # times the median distance from the scene's middle; beyond it a viewer frames nothing else
_SCALE_LIMITS = (1e-7, 10.0)  # times the same distance
_OPACITY_LIMITS = (1e-6, 1.0 - 1e-6)  # a logit of 0 or 1 is infinite


def sanitize_gaussians(gaussians: GaussianArrays) -> GaussianArrays:
    """The Gaussians with finite values and bounded extents: what every file of a result holds.

    A Gaussian with a value that is not finite, or whose centre is absurdly far away, is left out; extents and opacities
    are clamped; quaternions get unit length.
    """
    finite = np.isfinite(gaussians.opacities)
    for values in (gaussians.means, gaussians.quats, gaussians.scales, gaussians.sh):
        finite &= np.isfinite(values).all(axis=tuple(range(1, values.ndim)))
    finite &= (np.abs(gaussians.means) <= MAX_COORDINATE).all(axis=1)
    if not finite.any():
        return select_gaussians(gaussians, finite)
    middle = np.median(gaussians.means[finite], axis=0)
    with np.errstate(all="ignore"):
        distance = np.linalg.norm((gaussians.means - middle).astype(np.float64), axis=1)
    reach = float(np.median(distance[finite])) or 1.0
    kept = select_gaussians(gaussians, finite & (distance <= _FARTHEST * reach))
    with np.errstate(all="ignore"):
        length = np.linalg.norm(kept.quats, axis=1, keepdims=True)
    is_rotation = (length > 1e-12) & np.isfinite(length)
    identity = np.array([1.0, 0.0, 0.0, 0.0], np.float32)
    return GaussianArrays(
        means=kept.means,
        quats=np.where(is_rotation, kept.quats / np.maximum(length, 1e-12), identity).astype(np.float32),
        scales=np.clip(kept.scales, _SCALE_LIMITS[0] * reach, _SCALE_LIMITS[1] * reach).astype(np.float32),
        opacities=np.clip(kept.opacities, *_OPACITY_LIMITS).astype(np.float32),
        sh=kept.sh,
        source_frame=kept.source_frame,
    )


def select_gaussians(gaussians: GaussianArrays, index: npt.NDArray[np.bool_] | npt.NDArray[np.intp]) -> GaussianArrays:
    """The Gaussians at `index` (integers or a mask)."""
    return GaussianArrays(
        gaussians.means[index],
        gaussians.quats[index],
        gaussians.scales[index],
        gaussians.opacities[index],
        gaussians.sh[index],
        gaussians.source_frame[index],
    )


def compute_base_rgb(gaussians: GaussianArrays) -> npt.NDArray[np.uint8]:
    """(N, 3) colour without its view-dependent part."""
    return np.rint(np.clip(gaussians.sh[:, 0] * SH_C0 + 0.5, 0.0, 1.0) * 255.0).astype(np.uint8)


def make_unknown_source(num_gaussians: int) -> npt.NDArray[np.int32]:
    """(N,) -1: no scene format keeps the frame that a Gaussian came from."""
    return np.full(num_gaussians, -1, np.int32)


# The same Gaussians with their axes named anew, so that they are turned little: rotations that are coded in less.

_SIGNED = [np.diag(signs)[list(order)] for order in permutations(range(3)) for signs in product((1.0, -1.0), repeat=3)]
_NAMINGS = np.stack([matrix for matrix in _SIGNED if np.linalg.det(matrix) > 0])  # (24, 3, 3) turns of a cube


def minimize_rotations(gaussians: GaussianArrays) -> GaussianArrays:
    """The Gaussians, each with that order and sense of its axes for which it is turned least: by at most 62.8 degrees.

    Its quaternion has w of at least .85, and each other component within .39 of 0.
    """
    rotations = matrices_from_quats(gaussians.quats)
    naming = _NAMINGS[np.einsum("nij,kji->nk", rotations, _NAMINGS).argmax(1)]  # the largest trace
    return replace(
        gaussians,
        quats=quats_from_matrices(rotations @ naming).astype(np.float32),
        scales=np.einsum("ni,nij->nj", gaussians.scales, np.abs(naming).astype(np.float32)),
    )


# Text files of numbers, for formats that people can read.


def format_number_row(values: Sequence[float]) -> str:
    """The numbers with spaces between them, each so that it reads back exactly."""
    return " ".join(str(int(value)) if float(value).is_integer() else repr(float(value)) for value in values)


def format_text_file(head: str, lines: Sequence[str], scale: Scale) -> bytes:
    """The comment `head`, comments that state the unit and the frame, and the lines."""
    stated = [f"# unit: {scale.unit}", f"# scale: {scale.sentence}", f"# frame: {scale.frame.sentence}"]
    return ("\n".join([f"# {head}", *stated, *lines]) + "\n").encode()


# Which Gaussians of a scene an export keeps: all, those that two photographs have seen, the near, those in a box.

Corner = tuple[float, float, float]


@dataclass(frozen=True)
class Box:
    """A box with faces along the world's axes; both corners are in the file's frame and unit."""

    least: Corner
    most: Corner

    def __post_init__(self) -> None:
        for axis, least, most in zip("xyz", self.least, self.most, strict=True):
            if not least < most:
                raise ValueError(f"the box must have {axis}0 below {axis}1, got {least:g} and {most:g}")

    def contains(self, points: npt.NDArray[np.float32]) -> npt.NDArray[np.bool_]:
        """(N,) which of the points (N, 3) are in it."""
        inside = (points >= np.array(self.least)) & (points <= np.array(self.most))
        return np.asarray(inside.all(1))


@dataclass(frozen=True)
class Selection:
    only_seen: bool = False  # without what no two photographs confirm, and without the far shell
    box: Box | None = None  # those whose centre is in it; None: wherever they are
    no_background: bool = False  # without the far shell

    @property
    def is_everything(self) -> bool:
        return not self.needs_sources and self.box is None

    @property
    def needs_sources(self) -> bool:
        """Whether the Gaussians' source frames decide."""
        return self.only_seen or self.no_background

    def apply(self, gaussians: GaussianArrays, name: str) -> GaussianArrays:
        """Selects what is kept of `gaussians`, whose source frames must be known if `needs_sources`.

        Raises SceneFileError, which names the file as `name`, where nothing is.
        """
        if self.only_seen:
            gaussians = select_gaussians(gaussians, find_confirmed(gaussians.source_frame))
            if not len(gaussians):
                raise SceneFileError(f"{name} has no Gaussian that two photographs confirm: nothing would be left")
        if self.no_background:
            gaussians = select_gaussians(gaussians, gaussians.source_frame != SHELL)
            if not len(gaussians):
                raise SceneFileError(f"{name} is nothing but the far background: nothing would be left")
        if self.box is None or not len(gaussians):
            return gaussians
        kept = select_gaussians(gaussians, self.box.contains(gaussians.means))
        if not len(kept):
            least, most = (np.percentile(gaussians.means, percent, axis=0) for percent in (1, 99))
            raise SceneFileError(
                f"no Gaussian of {name} is in the box: nothing would be left. All but a hundredth of them lie between "
                f"{_format_corner(least)} and {_format_corner(most)} on each axis"
            )
        return kept


EVERYTHING = Selection()


def _format_corner(corner: npt.NDArray[np.floating]) -> str:
    return ",".join(f"{value:.3g}" for value in corner)
