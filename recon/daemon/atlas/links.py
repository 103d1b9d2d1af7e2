"""How two scenes lie to each other: by cameras that both have, or by a bridge of photographs that show the same."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.recon.geometry import Similarity, align_cameras, angles_deg, compute_rms_radius

MIN_SHARED = 3  # cameras that two scenes must share, so that one that is wrong shows
# What no link is surer of, however well its few cameras agree: what the scenes themselves are wrong by.
LEAST_DEG, LEAST_RELATIVE = 0.1, 0.003  # of the rotation; of the scale, and of the position over the cameras' spread
MOST_DEG, MOST_RELATIVE = 3.0, 0.1  # that cameras may differ by and still lie alike, likewise

Array = npt.NDArray[np.float64]
Cameras = Mapping[str, Array]  # T_world_camera (4, 4) by the names of the photographs


class EdgeKind(enum.Enum):
    CHAIN = "chain"  # the one scene goes on where the other was full: they have photographs in common
    LOOP = "loop"  # the camera came back: photographs of the one show what those of the other show


class PoseGraphEdge(msgspec.Struct, frozen=True, kw_only=True):
    """A point x of scene `other` lies at scale * rotation @ x + translation in `scene`."""

    kind: EdgeKind = EdgeKind.CHAIN
    scene: str  # scene_id
    other: str
    scale: float
    rotation: tuple[tuple[float, ...], ...]  # (3, 3), row by row
    translation: tuple[float, ...]  # (3,), in the unit of `scene`
    shared: tuple[str, ...]  # photographs that both scenes have a camera of, or that bridge them
    rotation_deg: float  # by how much those cameras' directions differ afterwards, at most
    centre_percent: float | None  # RMS of what their positions differ by, of their spread; None: they do not move
    centre: tuple[float, ...] = (0.0, 0.0, 0.0)  # (3,) the mean of their positions, in `scene`
    sigma_deg: float = LEAST_DEG  # standard deviations: of the rotation,
    sigma_scale: float = LEAST_RELATIVE  # of the logarithm of the scale,
    sigma_position: float = LEAST_RELATIVE  # and of the position of `centre`, in the unit of `scene`
    why: str = ""  # it was taken
    retracted: str | None = None  # why it does not count after all

    @property
    def similarity(self) -> Similarity:
        """From the world of `other` to that of `scene`."""
        return Similarity(self.scale, np.array(self.rotation), np.array(self.translation))


@dataclass(frozen=True, eq=False)
class _Alignment:
    """One set of cameras laid on another."""

    similarity: Similarity
    rotation_deg: float  # most that a direction differs by afterwards
    centre_rms: float  # of what the positions differ by, in the target's unit
    extent: float  # of the positions in the target, likewise
    sigma_deg: float
    sigma_relative: float  # of the logarithm of the scale; of the mean position over `extent`

    @property
    def is_consistent(self) -> bool:
        """Whether both sets lie alike."""
        return self.rotation_deg <= MOST_DEG and self.centre_rms <= MOST_RELATIVE * self.extent


def make_chain_edge(scene: str, other: str, mine: Cameras, theirs: Cameras) -> PoseGraphEdge | None:
    """Makes the edge between two scenes by shared cameras. None if they share fewer than MIN_SHARED."""
    shared = [name for name in mine if name in theirs]
    if len(shared) < MIN_SHARED:
        return None
    target = np.stack([mine[name] for name in shared])
    fit = _align(np.stack([theirs[name] for name in shared]), target)
    why = f"{len(shared)} photographs are in both"
    return _make_edge(EdgeKind.CHAIN, scene, other, fit.similarity, [fit], target, shared, why)


def make_loop_edge(
    scene: str, other: str, mine: Cameras, theirs: Cameras, bridge: tuple[Cameras, Cameras], why: str
) -> PoseGraphEdge | None:
    """Makes the edge of a loop: `bridge` has cameras of both scenes in one world, first those of `scene`.

    None where fewer than MIN_SHARED of either have a camera in their scene, too, or have it elsewhere there.
    """
    names = [[name for name in ends if name in cameras] for ends, cameras in zip(bridge, (mine, theirs), strict=True)]
    if min(map(len, names)) < MIN_SHARED:
        return None
    target = np.stack([mine[name] for name in names[0]])
    to_mine = _align(np.stack([bridge[0][name] for name in names[0]]), target)
    to_theirs = _align(np.stack([bridge[1][name] for name in names[1]]), np.stack([theirs[name] for name in names[1]]))
    if not (to_mine.is_consistent and to_theirs.is_consistent):
        return None
    similarity = to_mine.similarity.after(to_theirs.similarity.inverse())
    return _make_edge(
        EdgeKind.LOOP, scene, other, similarity, [to_mine, to_theirs], target, [*names[0], *names[1]], why
    )


def transfer_edge(link: PoseGraphEdge, scene: str, before: Cameras, now: Cameras) -> PoseGraphEdge | None:
    """The link, after one of its scenes was made again: from the world in which its cameras lay `before` to that of
    `now`. None where they lie to each other otherwise now, or have too few in common.
    """
    names = [name for name in before if name in now]
    if len(names) < MIN_SHARED:
        return None
    fit = _align(np.stack([before[name] for name in names]), np.stack([now[name] for name in names]))
    if not fit.is_consistent:
        return None
    to_now, there, centre, position = fit.similarity, link.similarity, link.centre, link.sigma_position
    if link.scene == scene:
        there = to_now.after(there)
        centre = tuple(to_now(np.array(centre)).tolist())
        position *= to_now.scale
    else:
        there = there.after(to_now.inverse())
    return msgspec.structs.replace(
        link,
        scale=there.scale,
        rotation=tuple(tuple(row) for row in there.rotation.tolist()),
        translation=tuple(there.translation.tolist()),
        centre=centre,
        sigma_deg=max(link.sigma_deg, fit.sigma_deg),
        sigma_scale=max(link.sigma_scale, fit.sigma_relative),
        sigma_position=position,
    )


def _align(source: Array, target: Array) -> _Alignment:
    """Cameras `source` (C, 4, 4) laid on `target`."""
    found = align_cameras(source, target)
    turned = angles_deg(found.rotation @ source[:, :3, :3], target[:, :3, :3])
    rms = float(np.sqrt(((found(source[:, :3, 3]) - target[:, :3, 3]) ** 2).sum(1).mean()))
    extent = max(compute_rms_radius(target[:, :3, 3]), 1e-12)
    root = np.sqrt(len(source))
    relative = rms / extent / root
    sigma_deg = max(float(np.sqrt((turned**2).mean())) / root, LEAST_DEG)
    return _Alignment(found, float(turned.max()), rms, extent, sigma_deg, max(relative, LEAST_RELATIVE))


def _make_edge(
    kind: EdgeKind, scene: str, other: str, similarity: Similarity, fits: list[_Alignment], target: Array, names: list[str],
    why: str,
) -> PoseGraphEdge:  # fmt: skip
    relative = float(np.sqrt(sum(fit.sigma_relative**2 for fit in fits)))
    moving = all(fit.extent > 1e-9 for fit in fits)
    differ = max(fit.centre_rms / fit.extent for fit in fits)
    return PoseGraphEdge(
        kind=kind,
        scene=scene,
        other=other,
        scale=similarity.scale,
        rotation=tuple(tuple(row) for row in similarity.rotation.tolist()),
        translation=tuple(similarity.translation.tolist()),
        shared=tuple(names),
        rotation_deg=max(fit.rotation_deg for fit in fits),
        centre_percent=100 * differ if moving else None,
        centre=tuple(target[:, :3, 3].mean(0).tolist()),
        sigma_deg=float(np.sqrt(sum(fit.sigma_deg**2 for fit in fits))),
        sigma_scale=relative,
        sigma_position=relative * fits[0].extent,
        why=why,
    )
