"""What ties cameras that took their images together in the bundle adjustment: a pose a frame set, a mount a camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]
Index = npt.NDArray[np.int64]

_FIXED = -1.0  # in place of the information of a mount that is the rig's own frame


@dataclass(frozen=True, eq=False)
class RigConstraint:
    """The constraint that C cameras stand as their mounts on the rig say: S frame sets and M mounts."""

    set_of_camera: Index  # (C,) -1: this camera is in no frame set
    mount_of_camera: Index  # (C,) -1 likewise
    sigmas: Array  # (C, 2) between camera and rig: of a turn about each axis, radians, and of a shift along each
    set_rotations: Array  # (S, 3, 3) world to rig
    set_translations: Array  # (S, 3)
    mount_rotations: Array  # (M, 3, 3) rig to camera
    mount_translations: Array  # (M, 3)
    is_fixed: npt.NDArray[np.bool_]  # (M,) whether the mount is the rig's own frame
    # (M, 3, 3), (M, 3), (M, 2) of given mounts: rotations, centres in the rig, and sigmas as above; inf: not known
    given_rotations: Array
    given_centres: Array
    given_sigmas: Array

    @property
    def num_sets(self) -> int:
        return len(self.set_rotations)

    @property
    def num_mounts(self) -> int:
        return len(self.mount_rotations)

    @property
    def holds_scale(self) -> bool:
        """Whether given mounts say how long a unit is."""
        return bool(np.isfinite(self.given_sigmas[:, 1]).any())

    def copy(self) -> RigConstraint:
        """Returns it with parameters of its own, which the core changes in place."""
        names = ("set_rotations", "set_translations", "mount_rotations", "mount_translations")
        return replace(self, **{name: np.array(getattr(self, name), dtype=np.float64, order="C") for name in names})

    def relabel(self, old: Index) -> RigConstraint:
        """Camera i is tied as camera `old[i]` was."""
        of = {name: getattr(self, name)[old] for name in ("set_of_camera", "mount_of_camera", "sigmas")}
        return replace(self, **of)

    def pack(self, num_cameras: int, noise_px: float) -> list[npt.NDArray[np.generic]]:
        """Returns the constraint as `Bundle` of recon/core/bundle_cost.h has it, for `num_cameras` cameras."""
        of_set, of_mount, sigmas = self.set_of_camera, self.mount_of_camera, self.sigmas
        if self is NO_RIG:
            of_set = of_mount = np.full(num_cameras, -1)
            sigmas = np.full((num_cameras, 2), np.inf)
        given = noise_px**2 / self.given_sigmas**2
        given[self.is_fixed] = _FIXED
        return [
            *(
                np.ascontiguousarray(each, dtype=np.float64)
                for each in (self.set_rotations, self.set_translations, self.mount_rotations, self.mount_translations)
            ),
            *(np.ascontiguousarray(each, dtype=np.int32) for each in (of_set, of_mount)),
            *(
                np.ascontiguousarray(each, dtype=np.float64)
                for each in (noise_px**2 / sigmas**2, self.given_rotations, self.given_centres, given)
            ),
        ]


_NONE, _NO_ROTATIONS, _NO_POINTS = np.zeros(0, np.int64), np.zeros((0, 3, 3)), np.zeros((0, 3))
_NO_SIGMAS = np.zeros((0, 2))
NO_RIG = RigConstraint(
    _NONE, _NONE, _NO_SIGMAS, _NO_ROTATIONS, _NO_POINTS, _NO_ROTATIONS, _NO_POINTS, np.zeros(0, bool),
    _NO_ROTATIONS, _NO_POINTS, _NO_SIGMAS,
)  # fmt: skip
