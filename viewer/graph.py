"""A map as a graph: its scenes, how they are linked, and how much of each is loaded. Its lines and its words."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

FULL = 0  # the level of a scene that is shown as it is; 1, 2 ... are coarser
NOTHING = -1  # of a scene that is not loaded

_MOST_PLACES = 14  # that the panel lists
_MOST_LINKS = 8  # loops, and what was retracted
_DASHES = 9  # of a line that no longer counts
_MARK = 0.015  # half the size of a scene's mark, in parts of the scene's depth, which is about 1


@dataclass(frozen=True, eq=False)
class GraphNode:
    """A scene of the map, or a place that is in no map: that has no centre."""

    scene_id: str
    verdict: str
    good: bool  # whether its scene is shown
    centre: Array | None  # (3,) the middle of its cameras
    num_gaussians: int  # that are loaded
    level: int  # FULL, coarser, or NOTHING


@dataclass(frozen=True, eq=False)
class GraphEdge:
    """A link between two scenes of the map."""

    scene: str
    other: str
    ends: Array  # (2, 3) the middles of the cameras
    loop: bool  # the place was found again
    retracted: str | None  # why the link no longer counts; None: it does


@dataclass(frozen=True, eq=False)
class Graph:
    nodes: tuple[GraphNode, ...]  # the nearest first
    edges: tuple[GraphEdge, ...]
    which: int  # the map's number, from 0 on
    maps: int  # how many there are
    merged: bool  # whether what is shown was merged


def edge_lines(edges: tuple[GraphEdge, ...], *, loop: bool, retracted: bool) -> Array:
    """(M, 2, 3) the lines of one kind of links: whole, or dashed where they no longer count."""
    ends = [edge.ends for edge in edges if edge.loop is loop and (edge.retracted is not None) is retracted]
    whole = np.array(ends, np.float64).reshape(-1, 2, 3)
    return _dash_lines(whole) if retracted else whole


def node_marks(nodes: tuple[GraphNode, ...], *, good: bool) -> Array:
    """(M, 2, 3) an octahedron around the middle of each scene of one kind that has one."""
    centres = np.array([node.centre for node in nodes if node.centre is not None and node.good is good])
    tips = _MARK * np.concatenate([np.eye(3), -np.eye(3)])
    pairs = [(a, b) for a in range(6) for b in range(a + 1, 6) if b != a + 3]
    edges = np.array([[tips[a], tips[b]] for a, b in pairs])
    return (centres.reshape(-1, 1, 1, 3) + edges[None]).reshape(-1, 2, 3)


def place_lines(graph: Graph) -> list[str]:
    """The places with what was found of each and how much of it is loaded, and the links that are no mere chain."""
    title = f"map {graph.which + 1} of {graph.maps} (m: the next)" if graph.maps > 1 else "one map"
    seams = "merged" if graph.merged else "not merged: splatnode merge makes clean seams"
    lines = [f"{title}, {seams}"]
    lines += [f"{node.scene_id} {node.verdict}: {_detail(node)}" for node in graph.nodes[:_MOST_PLACES]]
    further = len(graph.nodes) - _MOST_PLACES
    lines += [f"and {further} further away"] * (further > 0)
    special = [edge for edge in graph.edges if edge.loop or edge.retracted is not None]
    for edge in special[:_MOST_LINKS]:
        kind = "loop" if edge.loop else "chain"
        why = f", taken back: {edge.retracted}" if edge.retracted is not None else ""
        lines.append(f"{kind} {edge.scene} to {edge.other}{why}")
    return lines


def _detail(node: GraphNode) -> str:
    if node.level == NOTHING:
        return "not loaded" if node.good else "no scene"
    how = "full detail" if node.level == FULL else f"coarse, level {node.level}"
    return f"{node.num_gaussians} Gaussians, {how}"


def _dash_lines(lines: Array) -> Array:
    """Every other part of the lines (M, 2, 3)."""
    at = np.linspace(0.0, 1.0, 2 * _DASHES)
    start, step = lines[:, :1], lines[:, 1:] - lines[:, :1]
    points = start + at[None, :, None] * step  # (M, 2 dashes, 3)
    return points.reshape(-1, 2, 3)
