"""The view graph and the scene as messages for the checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, TypeVar

import msgspec
import numpy as np
import numpy.typing as npt
import torch

from splatnode.capture.frame import Intrinsics
from splatnode.capture.messaging.wire import Message
from splatnode.recon.frames.keyframe import Features, Keyframe
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.straightened import undistort_keyframe
from splatnode.recon.scene import light
from splatnode.recon.scene.gaussians import Gaussians
from splatnode.recon.scene.scene import Scene, TrainingView

T = TypeVar("T")
Numbers = dict[str, bool | int | float | None]


class GraphRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arrays: those of each keyframe's features, then those of each pair, in the order of their fields."""

    names: list[str]
    features: list[Numbers]
    pairs: list[tuple[int, int, Numbers]]
    pending: list[tuple[int, int]]  # that have not been compared


class SceneRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arrays: Ts_world_camera (C, 4, 4), Ks (C, 3, 3), then those of the Gaussians in the order of their fields."""

    views: list[str]  # their names
    iterations: int
    final: bool
    lenses: list[Intrinsics | None] = []  # estimated, of each view; empty: of none
    gains: list[tuple[float, float, float] | None] = []  # of each view's photograph over its image; empty: of none
    falloffs: list[float] = []  # of each view's lens; empty: none dims its corners
    headroom: float = 1.0
    consistent_depth: list[float | None] = []  # share of each view's pixels; empty: not known of any


def make_graph_message(graph: ViewGraph) -> tuple[GraphRecord, list[npt.NDArray]]:
    """Header and arrays of the message that holds `graph`."""
    features = [flatten_dataclass(keyframe.features) for keyframe in graph.keyframes]
    pairs = {key: flatten_dataclass(pair) for key, pair in graph.pairs.items()}
    header = GraphRecord(
        names=[keyframe.name for keyframe in graph.keyframes],
        features=[numbers for numbers, _ in features],
        pairs=[(*key, numbers) for key, (numbers, _) in pairs.items()],
        pending=sorted(graph.pending),
    )
    return header, [array for _, arrays in (*features, *pairs.values()) for array in arrays]


@dataclass(frozen=True, eq=False)
class SavedGraph:
    """Features and pairs by the names of their keyframes."""

    features: dict[str, Features]
    pairs: dict[tuple[str, str], TwoView]
    pending: list[tuple[str, str]]


def parse_graph(message: Message[GraphRecord]) -> SavedGraph:
    """Parses the message of `make_graph_message`. Raises ValueError where another version wrote it."""
    names, arrays = message.header.names, iter(message.arrays)
    features = [unflatten_dataclass(Features, numbers, arrays) for numbers in message.header.features]
    pairs = {
        (names[i], names[j]): unflatten_dataclass(TwoView, numbers, arrays) for i, j, numbers in message.header.pairs
    }
    pending = [(names[i], names[j]) for i, j in message.header.pending]
    return SavedGraph(dict(zip(names, features, strict=True)), pairs, pending)


def make_scene_message(scene: Scene, final: bool) -> tuple[SceneRecord, list[npt.NDArray]]:
    """Header and arrays of the message that holds `scene`; `final`: it is finished."""
    views = [view.name for view in scene.views]
    cameras = [torch.stack([view.T_world_camera for view in scene.views]), torch.stack([v.K for v in scene.views])]
    gaussians = [getattr(scene.gaussians, field.name) for field in fields(Gaussians)]
    lenses = [view.lens for view in scene.views]
    gains = [view.exposure and view.exposure.gains for view in scene.views]
    falloffs = [view.exposure.falloff if view.exposure else 0.0 for view in scene.views]
    shares = [view.consistent_depth for view in scene.views]
    header = SceneRecord(views, scene.iterations, final, lenses, gains, falloffs, scene.headroom, shares)
    return header, [tensor.numpy() for tensor in (*cameras, *gaussians)]


def parse_scene(message: Message[SceneRecord], keyframes: Mapping[str, Keyframe]) -> Scene | None:
    """The scene that was saved; None where a frame of it is gone. Raises ValueError as `parse_graph`."""
    header = message.header
    if any(name not in keyframes for name in header.views):
        return None
    if len(message.arrays) != 2 + len(fields(Gaussians)):
        raise ValueError(f"a scene of {len(message.arrays)} arrays is of another version")
    Ts_world_camera, Ks, *gaussians = (torch.from_numpy(np.array(array)) for array in message.arrays)
    lenses = header.lenses or [None] * len(header.views)
    gains = header.gains or [None] * len(header.views)
    falloffs = header.falloffs or [0.0] * len(header.views)
    views = tuple(
        _make_view(
            keyframes[name] if lens is None else undistort_keyframe(keyframes[name], lens), own, T_world_camera, K
        )
        for name, lens, own, T_world_camera, K in zip(
            header.views, lenses, zip(gains, falloffs, strict=True), Ts_world_camera, Ks, strict=True
        )
    )
    shares = header.consistent_depth or [None] * len(views)
    views = tuple(replace(view, consistent_depth=share) for view, share in zip(views, shares, strict=True))
    return Scene(views, Gaussians(*gaussians), header.iterations, headroom=header.headroom)


def _make_view(
    keyframe: Keyframe,
    told: tuple[tuple[float, float, float] | None, float],
    T_world_camera: torch.Tensor,
    K: torch.Tensor,
) -> TrainingView:
    """`told`: the photograph's gains, and its lens's falloff."""
    image, exposure = light.compensate_image(keyframe.image, *told)
    shown = keyframe.name, keyframe.frame.frame_id, image
    return TrainingView(*shown, T_world_camera, K, mask=keyframe.mask, exposure=exposure, lens=keyframe.lens)


def flatten_dataclass(value: Any) -> tuple[Numbers, list[npt.NDArray]]:
    """A flat dataclass as its numbers and its arrays."""
    content = {field.name: getattr(value, field.name) for field in fields(value)}
    arrays = [part for part in content.values() if isinstance(part, np.ndarray)]
    return {name: _convert_number(part) for name, part in content.items() if not isinstance(part, np.ndarray)}, arrays


def _convert_number(number: Any) -> bool | int | float | None:
    return number.item() if isinstance(number, np.generic) else number


def unflatten_dataclass(kind: type[T], numbers: Numbers, arrays: Any) -> T:
    """Inverse of `flatten_dataclass`; takes from `arrays` as many as it needs. Raises ValueError where they do not fit."""
    names = [field.name for field in fields(kind)]  # pyright: ignore[reportArgumentType]
    if not set(numbers) <= set(names):
        raise ValueError(f"a {kind.__name__} with {', '.join(sorted(numbers))} is of another version")
    try:
        return kind(**numbers, **{name: next(arrays) for name in names if name not in numbers})
    except (StopIteration, RuntimeError) as error:
        raise ValueError(f"arrays of a {kind.__name__} are missing") from error
