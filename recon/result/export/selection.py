"""Which Gaussians of a scene an export keeps: all, those that two photographs have seen, the near, those in a box."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.error import SceneFileError
from splatnode.recon.result.export.prepare import select_gaussians
from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.recon.result.sources import SHELL, find_confirmed

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
