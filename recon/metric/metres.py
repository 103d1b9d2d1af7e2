"""A scene in metres, by all that was measured; where that cannot be had it stays relative, and its scale says why."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.capture.process.text import LONGEST_TEXT
from splatnode.recon.geometry import Similarity
from splatnode.recon.metric.depth_scale import estimate_scale_from_depth
from splatnode.recon.metric.evidence import NOTHING, Evidence
from splatnode.recon.metric.markers import estimate_scale_from_markers
from splatnode.recon.metric.measurement import (
    Measurement,
    MetricConfig,
    combine_measurements,
    estimate_scale_from_distance,
    make_metric_views,
)
from splatnode.recon.metric.odometry import (
    PoseAlignment,
    PoseSigmas,
    align_to_poses,
    estimate_scale_from_motions,
    estimate_up,
)
from splatnode.recon.metric.stereo import (
    MetricDepth,
    StereoPair,
    estimate_scale_from_network,
    estimate_scale_from_stereo,
)
from splatnode.recon.networks.depth_anything import load_metric
from splatnode.recon.result.placement import Placement
from splatnode.recon.result.snapshot import GivenCameraPose, InGivenWorld, Snapshot, format_rounded_up
from splatnode.recon.result.verdict import Scale, join_sentences

# Of the scene's size: a grid as coarse as its coordinates may be. A render then has 40 dB against the same elsewhere.
MOST_STEP = 1e-3


def apply_metric_scale(snapshot: Snapshot, config: MetricConfig, evidence: Evidence = NOTHING) -> Snapshot:
    """The snapshot with lengths in metres where `config` gives them a unit; as it is where nothing was asked for.

    `evidence` is what its photographs tell of what `config` asks for. A source that can say nothing is left out where
    another can. Where sources contradict each other the scene stays relative. Where poses are among what counts, the
    world is theirs. Gravity, where it came with photographs, tells where up is.
    """
    measured = _apply_metric_scale(snapshot, config, evidence)
    up = estimate_up(make_metric_views(measured), evidence.gravities)
    return measured if up is None else replace(measured, up=up)


def _apply_metric_scale(snapshot: Snapshot, config: MetricConfig, evidence: Evidence) -> Snapshot:
    said, aligned = _collect_measurements(snapshot, config, evidence) if len(snapshot.cameras) else ([], None)
    if evidence.depths and len(snapshot.cameras):
        others = [each for each in said if isinstance(each, Measurement)]
        told, checks = estimate_scale_from_depth(
            make_metric_views(snapshot), snapshot.landmarks, evidence.depths, others
        )
        said, snapshot = said + told, replace(snapshot, depth_checks=checks)
    if not said:
        return snapshot
    measurements = [each for each in said if isinstance(each, Measurement)]
    silent = [each for each in said if isinstance(each, str)]
    agreed = combine_measurements(measurements) if measurements else join_sentences(silent)
    if isinstance(agreed, str):
        return replace(snapshot, scale=Scale(False, agreed))
    low, high = agreed.interval_95
    known = join_sentences([each.source for each in measurements], LONGEST_TEXT // 2)
    source = join_sentences([f"{known}, known to {format_rounded_up(100 * (high - 1.0))} %", *silent])
    unit = agreed.metres_per_unit
    to_metres = Similarity(unit, np.eye(3), np.zeros(3)) if aligned is None else aligned.rescale(unit)
    metric = _transform_snapshot(snapshot, to_metres)
    if aligned is not None:
        metric = _add_given_poses(metric, config, evidence)
    return replace(metric, scale=Scale(True, source, (low, high)))


def _collect_measurements(
    snapshot: Snapshot, config: MetricConfig, evidence: Evidence
) -> tuple[list[Measurement | str], PoseAlignment | None]:
    """Collects what each scale source measures, or why it cannot; and the alignment to given poses."""
    said: list[Measurement | str] = [
        estimate_scale_from_distance(snapshot.cameras, baseline, config.baseline_sigma) for baseline in config.baselines
    ]
    if config.marker_size_m is not None:
        said += estimate_scale_from_markers(
            make_metric_views(snapshot), evidence.sightings, config.marker_size_m, config.marker_size_sigma_m
        )
    aligned = None
    if snapshot.given is not None:
        found = _align_to_given_world(snapshot, snapshot.given)
        aligned = None if isinstance(found, str) else found
        said.append(found if isinstance(found, str) else found.unit)
    elif evidence.poses is not None or evidence.tracked:
        given = evidence.poses or {}  # which are meant where the photographs came with others
        tracked = {name: pose for name, pose in evidence.tracked.items() if name not in given}
        poses = {**{name: pose.matrix for name, pose in tracked.items()}, **given}
        sigmas = PoseSigmas(config.poses_sigma_m, config.poses_sigma_deg, config.poses_drift)
        own = {name: (pose.sigma_m, pose.sigma_deg) for name, pose in tracked.items()}
        found = align_to_poses(make_metric_views(snapshot), poses, sigmas, own)
        if isinstance(found, PoseAlignment) and (offset := _explain_too_far(snapshot, found)):
            found = offset
        aligned = None if isinstance(found, str) else found
        said += [found] if isinstance(found, str) else [found.unit, *found.told]
    if snapshot.rig is not None and snapshot.rig.metres_per_unit is not None:
        known = f"the given rig of {snapshot.rig.num_given} cameras"
        said.append(Measurement(snapshot.rig.metres_per_unit, snapshot.rig.scale_sigma, known))
    said += estimate_scale_from_motions(make_metric_views(snapshot), evidence.motions, config.odometry_scale_sigma)
    for (baseline_m, sigma_m), pairs in _group_stereo_pairs(config, evidence).items():
        said.append(
            estimate_scale_from_stereo(make_metric_views(snapshot), snapshot.landmarks, pairs, baseline_m, sigma_m)
        )
    if config.depth_network:
        said.append(_estimate_scale_from_network(snapshot, config.depth_network_sigma))
    return said, aligned


def _align_to_given_world(snapshot: Snapshot, given: InGivenWorld) -> PoseAlignment | str:
    """Aligns to the poses that hold the cameras, whose world these are in already, but for its unit and place."""
    to_world = Similarity(given.scale, given.rotation, given.translation)
    centre = np.stack([camera.T_world_camera[:3, 3] for camera in snapshot.cameras]).mean(0)
    unit = Measurement(
        given.scale, given.scale_sigma, f"poses of {given.num_poses} photographs, which hold the cameras"
    )
    aligned = PoseAlignment(unit, to_world, centre, ())
    return _explain_too_far(snapshot, aligned) or aligned


def _explain_too_far(snapshot: Snapshot, aligned: PoseAlignment) -> str:
    """Why the world of the poses cannot be the scene's: its origin is too far away, as in a map of a country.

    Empty where it can. A coordinate of a Gaussian has 24 bits: so far out the scene would stand on a coarse grid.
    """
    means = snapshot.gaussians.means
    if not len(means):
        return ""
    farthest = float(np.abs(aligned.to_world(aligned.centre)).max())
    size = aligned.unit.metres_per_unit * float(np.median(np.linalg.norm(means - aligned.centre, axis=1)))
    step = float(np.spacing(np.float32(farthest)))
    if step <= MOST_STEP * size:
        return ""
    return (
        f"the given poses lie {farthest:.3g} m from their origin, where 32-bit numbers are {step:.2g} m apart: too "
        "coarse for this scene. Subtract one position, as the first, from all of them"
    )


def _group_stereo_pairs(config: MetricConfig, evidence: Evidence) -> dict[tuple[float, float], list[StereoPair]]:
    """The stereo pairs by how far apart their cameras are, and its standard deviation, metres."""
    usual = None if config.stereo_baseline_m is None else (config.stereo_baseline_m, config.stereo_baseline_sigma_m)
    rigs: dict[tuple[float, float], list[StereoPair]] = {} if usual is None else {usual: []}
    for pair in evidence.pairs:
        own = usual if pair.baseline is None else (pair.baseline.metres, pair.baseline.sigma_m)
        if own is not None:
            rigs.setdefault(own, []).append(pair)
    return rigs


def _estimate_scale_from_network(snapshot: Snapshot, sigma: float) -> Measurement | str:
    loaded = load_metric()
    if loaded is None:
        return "no weights of the metric network: splatnode weights list tells where they are had"
    return estimate_scale_from_network(snapshot, MetricDepth(loaded.name, loaded), sigma)


def _add_given_poses(snapshot: Snapshot, config: MetricConfig, evidence: Evidence) -> Snapshot:
    """The snapshot in the world of given poses, with these beside its cameras."""
    given = {
        name: GivenCameraPose(pose.matrix, pose.sigma_m, pose.sigma_deg) for name, pose in evidence.tracked.items()
    }
    given |= {name: GivenCameraPose(T, *config.poses_sigmas) for name, T in (evidence.poses or {}).items()}
    cameras = tuple(replace(camera, given=given.get(camera.name)) for camera in snapshot.cameras)
    return replace(snapshot, cameras=cameras)


def _transform_snapshot(snapshot: Snapshot, by: Similarity) -> Snapshot:
    """The snapshot, with all lengths in it, in the world that `by` leads to, in metres."""
    placement, factor = Placement(by.scale, by.rotation, by.translation), np.float32(by.scale)
    landmarks = snapshot.landmarks and snapshot.landmarks.transform(by.scale, by.rotation, by.translation, metric=True)
    return replace(
        snapshot,
        cameras=tuple(map(placement.transform_camera, snapshot.cameras)),
        gaussians=placement.transform_gaussians(snapshot.gaussians),
        landmarks=landmarks,
        given=None,
        rig=None if snapshot.rig is None else snapshot.rig.rescale(by.scale),
        depths={name: (depth * factor).astype(np.float16) for name, depth in snapshot.depths.items()},
    )
