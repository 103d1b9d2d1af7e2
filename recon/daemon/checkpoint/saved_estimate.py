"""What is known of a scene's cameras and depths, as messages for the checkpoint: a restart need not find it again."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import fields, replace
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.messaging.wire import Message
from splatnode.capture.process.records import record_of
from splatnode.recon.daemon.checkpoint.saved import Numbers, flatten_dataclass, unflatten_dataclass
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.registration.register import RegisteredCamera, Registration
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.verification.evidence import Evidence

OF_REGISTRATION = ("points", "observed_by", "observed_point", "observed_pixels")
OF_POINTMAP = ("depth", "confidence", "normal", "T_world_camera", "K", "unchecked")


class ReconstructionRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arrays: those of each camera in the order of their fields, then OF_REGISTRATION."""

    names: list[str]  # of the keyframes, as the cameras number them
    proven: list[str]
    verdict: Verdict
    evidence: Evidence
    cameras: list[Numbers]
    inlier_ratios: list[tuple[int, int, float]]
    numbers: Numbers  # of the registration


class FallbacksRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Fallbacks that gained nothing, as recon.memory.Memory has them."""

    fruitless: list[tuple[str, str]]


class PointmapsRecord(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Arrays: OF_POINTMAP for each; depths as half floats, confidence and normals in 256 steps.

    `unchecked` is empty where there is none.
    """

    names: list[str]


def make_reconstruction_message(
    estimate: Reconstruction, proven: Collection[str]
) -> tuple[ReconstructionRecord, list[npt.NDArray]]:
    """Makes the message, without depth. Raises ValueError where cameras or evidence are missing."""
    registration, evidence = estimate.registration, estimate.evidence
    if registration is None or evidence is None:
        raise ValueError("only an estimate with cameras and evidence is kept")
    cameras = [flatten_dataclass(camera) for camera in registration.cameras]
    kept = {field.name: getattr(registration, field.name) for field in fields(registration)}
    record = ReconstructionRecord(
        names=estimate.graph.names,
        proven=sorted(proven),
        verdict=estimate.verdict,
        evidence=record_of(msgspec.to_builtins(evidence, enc_hook=lambda number: number.item()), Evidence),
        cameras=[numbers for numbers, _ in cameras],
        inlier_ratios=[(int(i), int(j), float(ratio)) for (i, j), ratio in registration.inlier_ratios.items()],
        numbers={name: float(value) for name, value in kept.items() if isinstance(value, (int, float))},
    )
    arrays = [array for _, of_camera in cameras for array in of_camera]
    return record, [*arrays, *(kept[name] for name in OF_REGISTRATION)]


def parse_reconstruction(message: Message[ReconstructionRecord], graph: ViewGraph) -> Reconstruction:
    """Parses a message of `make_reconstruction_message`. Raises ValueError where another version wrote it."""
    header, arrays = message.header, iter(message.arrays)
    cameras = tuple(_parse_camera(numbers, arrays) for numbers in header.cameras)
    inlier_ratios = {(i, j): ratio for i, j, ratio in header.inlier_ratios}
    content: dict[str, Any] = {"cameras": cameras, "inlier_ratios": inlier_ratios, **header.numbers}
    try:
        registration = Registration(**content, **dict(zip(OF_REGISTRATION, arrays, strict=True)))
    except TypeError as error:
        raise ValueError("an estimate of another version") from error
    return Reconstruction(graph, registration, header.evidence, header.verdict)


def _parse_camera(numbers: Numbers, arrays: Iterator[npt.NDArray]) -> RegisteredCamera:
    """Parses a camera; up to version 6 a lens had one radial coefficient, a number."""
    camera = unflatten_dataclass(RegisteredCamera, numbers, arrays)
    if "radial" not in numbers:
        return camera
    return replace(camera, radial=np.array([numbers["radial"], 0.0], np.float64))


def make_pointmaps_message(pointmaps: Mapping[str, Pointmap]) -> tuple[PointmapsRecord, list[npt.NDArray]]:
    arrays = []
    for pointmap in pointmaps.values():
        depth = pointmap.depth.astype(np.float16).view(np.uint16)
        confidence = np.rint(255 * pointmap.confidence).astype(np.uint8)
        normal = np.rint(127 * pointmap.normal + 128).astype(np.uint8)
        unchecked = np.zeros((0, 0), np.float16) if pointmap.unchecked is None else pointmap.unchecked
        arrays += [depth, confidence, normal, pointmap.T_world_camera, pointmap.K, unchecked.view(np.uint16)]
    return PointmapsRecord(list(pointmaps)), arrays


def parse_pointmaps(message: Message[PointmapsRecord], keyframes: Mapping[str, Keyframe]) -> dict[str, Pointmap]:
    """The point maps of those keyframes that there are. Raises ValueError as `parse_reconstruction`."""
    names, arrays = message.header.names, message.arrays
    if len(arrays) != len(OF_POINTMAP) * len(names):
        raise ValueError(f"{len(names)} point maps with {len(arrays)} arrays are of another version")
    found = {}
    for index, name in enumerate(names):
        if name not in keyframes:
            continue
        depth, confidence, normal, T_world_camera, K, unchecked = arrays[len(OF_POINTMAP) * index :][: len(OF_POINTMAP)]
        found[name] = Pointmap(
            name=name,
            frame_id=keyframes[name].frame.frame_id,
            depth=np.asarray(depth.view(np.float16), np.float32),
            confidence=np.asarray(confidence / 255, np.float32),
            normal=np.asarray((normal - 128.0) / 127, np.float32),
            T_world_camera=np.array(T_world_camera),
            K=np.array(K),
            unchecked=np.array(unchecked).view(np.float16) if unchecked.size else None,
        )
    return found
