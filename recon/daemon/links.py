"""How the scenes of one place lie to each other: by the cameras that two of them share."""

from __future__ import annotations

from collections.abc import Mapping

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import align_cameras, angles_deg, spread

MIN_SHARED = 3  # cameras that two scenes must share, so that one that is wrong shows

Array = npt.NDArray[np.float64]


class Link(msgspec.Struct, frozen=True):
    """A point x of scene `other` lies at scale * rotation @ x + translation in `scene`."""

    scene: str  # scene_id
    other: str
    scale: float
    rotation: tuple[tuple[float, ...], ...]  # (3, 3), row by row
    translation: tuple[float, ...]  # (3,), in the unit of `scene`
    shared: tuple[str, ...]  # photographs that both scenes have a camera of
    rotation_deg: float  # by how much the shared cameras' directions differ afterwards, at most
    centre_percent: float | None  # RMS of what their positions differ by, of their spread; None: they do not move


def link(scene: str, other: str, mine: Mapping[str, Array], theirs: Mapping[str, Array]) -> Link | None:
    """From the cameras T_world_camera (4, 4) of two scenes by the names of their photographs.

    None where they share fewer than MIN_SHARED.
    """
    shared = [name for name in mine if name in theirs]
    if len(shared) < MIN_SHARED:
        return None
    Ts_mine, Ts_theirs = (np.stack([cameras[name] for name in shared]) for cameras in (mine, theirs))
    found = align_cameras(Ts_theirs, Ts_mine)
    apart = found(Ts_theirs[:, :3, 3]) - Ts_mine[:, :3, 3]
    extent = spread(Ts_mine[:, :3, 3])
    return Link(
        scene=scene,
        other=other,
        scale=found.scale,
        rotation=tuple(tuple(row) for row in found.rotation.tolist()),
        translation=tuple(found.translation.tolist()),
        shared=tuple(shared),
        rotation_deg=float(angles_deg(found.rotation @ Ts_theirs[:, :3, :3], Ts_mine[:, :3, :3]).max()),
        centre_percent=100 * float(np.sqrt((apart**2).sum(1).mean())) / extent if extent > 0 else None,
    )
