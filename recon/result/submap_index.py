"""places.json, read as the whole that it tells of: the scenes, how they are linked, and which lie in one world.

This is the reader of those who show or merge what a node has written; `recon.daemon.submap_index` writes it. It is
lenient with what an older node did not write: a link without a kind is one of a chain, and without `poses` the scenes
of a map are placed by their links.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import msgspec
import numpy as np

from splatnode.capture.process.config import record_in
from splatnode.capture.process.text import LONGEST_NAME, LONGEST_TEXT, guard_untrusted, is_printable
from splatnode.recon.result.export.limits import SceneFileError, read_json_file
from splatnode.recon.result.placement import IDENTITY, Placement

FILE = "places.json"
MOST_SCENES = 10_000
_TURNED = 1e-3  # largest difference of a rotation times its transpose from the identity

Finite = Annotated[float, msgspec.Meta(ge=-1e9, le=1e9)]
Factor = Annotated[float, msgspec.Meta(ge=1e-6, le=1e6)]
Name = Annotated[str, msgspec.Meta(min_length=1, max_length=LONGEST_NAME)]
Text = Annotated[str, msgspec.Meta(max_length=LONGEST_TEXT)]
Sigma = Annotated[float, msgspec.Meta(ge=0)]
Row = tuple[Finite, Finite, Finite]
Rotation = tuple[Row, Row, Row]


@dataclass(frozen=True)
class SubmapEntry:
    """A scene as places.json tells of it."""

    scene_id: str
    folder: Path | None  # with its result; None: there is none
    verdict: str
    message: str
    publishable: bool
    provisional: bool
    frames_used: tuple[str, ...]


@dataclass(frozen=True)
class SubmapEdge:
    """An edge of the pose graph between two scenes that overlap or follow one another."""

    scene: str
    other: str
    placement: Placement  # of `other` in the world of `scene`
    kind: str  # "chain": the next scene of one walk; "loop": a place that was found again
    retracted: str | None  # why it no longer counts; None: it does
    # Standard deviations of the placement: of its scale's logarithm, and of its rotation; None: the file does not tell
    sigma_scale: float | None = None
    sigma_deg: float | None = None


@dataclass(frozen=True)
class JoinedMap:
    """Scenes that lie in one world: that of the scene `name`, whose unit is that scene's."""

    name: str
    placements: Mapping[str, Placement]  # by scene_id, from the scene's world to the map's, in the order of the file


@dataclass(frozen=True)
class MapSet:
    """All that a node has made. Every scene is in exactly one map; one that is linked to none is a map of its own."""

    submaps: Mapping[str, SubmapEntry]  # by scene_id
    links: tuple[SubmapEdge, ...]
    maps: tuple[JoinedMap, ...]


def is_map_set(path: Path) -> bool:
    """Whether `path` is the folder of a node's results: scenes and their places.json, no scene itself."""
    return path.is_dir() and (path / FILE).is_file() and not (path / "scene.ply").exists()


def read_map_set(folder: Path) -> MapSet:
    """Reads places.json in `folder`. Raises FileNotFoundError, SceneFileError (names the file), OSError."""
    path = folder / FILE
    if not path.is_file():
        raise FileNotFoundError(
            f"{path} is not there. Give the folder that a node writes its scenes into (out of splatnode recon)"
        )
    data = read_json_file(path)
    with guard_untrusted(SceneFileError, str(path)):
        try:
            found = record_in(data, _File)
        except msgspec.MsgspecError as error:
            raise SceneFileError(f"{path} is not a places.json of splatnode, or is damaged: {error}") from error
        submaps = {submap.scene_id: _parse_submap(submap, folder, path) for submap in found.submaps}
        links = tuple(
            _parse_edge(link, path) for link in found.links if link.scene in submaps and link.other in submaps
        )
        placed = (
            _parse_poses(found.poses, submaps, path) if found.poses is not None else _chain_placements(submaps, links)
        )
        return MapSet(submaps, links, _group_maps(submaps, placed))


class _SubmapRecord(msgspec.Struct, frozen=True):
    scene_id: Name
    folder: Name | None = None
    verdict: Text = ""
    message: Text = ""
    publishable: bool = False
    provisional: bool = False
    frames_used: Annotated[tuple[Name, ...], msgspec.Meta(max_length=MOST_SCENES)] = ()


class _Sim3(msgspec.Struct, frozen=True, kw_only=True):
    scale: Factor
    rotation: Rotation
    translation: Row


class _EdgeRecord(_Sim3, frozen=True, kw_only=True):
    scene: Name
    other: Name
    kind: Text = "chain"
    retracted: Text | None = None
    sigma_scale: Sigma | None = None
    sigma_deg: Sigma | None = None


class _PoseRecord(_Sim3, frozen=True, kw_only=True):
    scene: Name
    map: Name


class _File(msgspec.Struct, frozen=True):
    submaps: Annotated[tuple[_SubmapRecord, ...], msgspec.Meta(max_length=MOST_SCENES)] = msgspec.field(name="places")
    links: Annotated[tuple[_EdgeRecord, ...], msgspec.Meta(max_length=10 * MOST_SCENES)] = ()
    poses: Annotated[tuple[_PoseRecord, ...], msgspec.Meta(max_length=MOST_SCENES)] | None = None


def _parse_submap(submap: _SubmapRecord, folder: Path, path: Path) -> SubmapEntry:
    texts = (submap.scene_id, submap.verdict, submap.message, *submap.frames_used)
    if not all(is_printable(text) for text in texts):
        raise SceneFileError(f"{path}: its texts must be printable")
    names = [submap.scene_id] if submap.folder is None else [submap.scene_id, submap.folder]
    if any("/" in name or "\0" in name or name in (".", "..") for name in names):
        raise SceneFileError(f"{path}: {submap.scene_id!a} must name a folder beside the file, not {submap.folder!a}")
    return SubmapEntry(
        submap.scene_id,
        None if submap.folder is None else folder / submap.folder,
        submap.verdict,
        submap.message,
        submap.publishable,
        submap.provisional,
        submap.frames_used,
    )


def _parse_placement(found: _Sim3, of: str, path: Path) -> Placement:
    rotation = np.array(found.rotation)
    if np.abs(rotation @ rotation.T - np.eye(3)).max() > _TURNED or np.linalg.det(rotation) < 0:
        raise SceneFileError(f"{path}: the rotation of {of} must be one")
    return Placement(found.scale, rotation, np.array(found.translation))


def _parse_edge(link: _EdgeRecord, path: Path) -> SubmapEdge:
    if not is_printable(link.kind) or not is_printable(link.retracted or ""):
        raise SceneFileError(f"{path}: its texts must be printable")
    placement = _parse_placement(link, f"the link {link.scene!a} to {link.other!a}", path)
    return SubmapEdge(link.scene, link.other, placement, link.kind, link.retracted, link.sigma_scale, link.sigma_deg)


def _parse_poses(
    poses: Sequence[_PoseRecord], submaps: Mapping[str, SubmapEntry], path: Path
) -> dict[str, tuple[str, Placement]]:
    unknown = sorted({pose.map for pose in poses} - set(submaps))
    if unknown:  # folders are named after maps
        raise SceneFileError(f"{path}: a map must be named after one of its scenes, not {unknown[0][:60]!a}")
    return {
        pose.scene: (pose.map, _parse_placement(pose, f"the pose of {pose.scene!a}", path))
        for pose in poses
        if pose.scene in submaps
    }


EdgesByScene = Mapping[str, Sequence[SubmapEdge]]  # by scene, the links of it that count


def group_edges(links: Iterable[SubmapEdge]) -> EdgesByScene:
    """The links that count, in their order, by both of their scenes."""
    found: dict[str, list[SubmapEdge]] = {}
    for link in links:
        if link.retracted is None:
            found.setdefault(link.scene, []).append(link)
            found.setdefault(link.other, []).append(link)
    return found


def walk_edges(first: str, links: EdgesByScene) -> Iterator[tuple[str, str, SubmapEdge]]:
    """How links lead to all other scenes from the first, along the fewest: the scene before, the scene, the link."""
    known, waiting = {first}, deque([first])
    while waiting:
        here = waiting.popleft()
        for link in links.get(here, ()):
            there = link.other if link.scene == here else link.scene
            if there not in known:
                known.add(there)
                waiting.append(there)
                yield here, there, link


def _chain_placements(
    submaps: Mapping[str, SubmapEntry], links: Iterable[SubmapEdge]
) -> dict[str, tuple[str, Placement]]:
    """Returns each scene's map and placement: a scene is placed by the first edge that reaches it."""
    those = group_edges(links)
    placed: dict[str, tuple[str, Placement]] = {}
    for first in submaps:
        if first in placed:
            continue
        placed[first] = first, IDENTITY
        for here, there, link in walk_edges(first, those):
            step = link.placement if link.scene == here else link.placement.inverse()
            placed[there] = first, placed[here][1].after(step)
    return placed


def _group_maps(
    submaps: Mapping[str, SubmapEntry], placed: Mapping[str, tuple[str, Placement]]
) -> tuple[JoinedMap, ...]:
    """In the order of their first scenes. A scene that has no place in a map is one of its own."""
    maps: dict[str, dict[str, Placement]] = {}
    for scene_id in submaps:
        name, placement = placed.get(scene_id, (scene_id, IDENTITY))
        maps.setdefault(name, {})[scene_id] = placement
    return tuple(JoinedMap(name, placements) for name, placements in maps.items())
