"""A scene in metres, by all that was measured; where that cannot be had it stays relative, and its scale says why."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import numpy.typing as npt

from splatnode.capture.depth_image import DepthImage
from splatnode.capture.frame import DroppedFrame, Frame, GivenPose, Gravity, Motion, make_rigid
from splatnode.capture.lenses import straighten_depth
from splatnode.capture.process.terminal import ProgressStep, Tell, ignore_progress
from splatnode.capture.process.text import LONGEST_TEXT
from splatnode.recon.geometry import Similarity, invert_pose
from splatnode.recon.metric.depth_fit import (
    DepthFit,
    DepthView,
    fit_depth_images,
    has_too_few_points,
    merge_lens,
    name_depth_images,
)
from splatnode.recon.metric.measurement import (
    MAX_DEVIATION,
    MarkerDetection,
    Measurement,
    MetricConfig,
    MetricView,
    combine_measurements,
    compute_scale_sigma,
    detect_markers,
    estimate_scale_from_distance,
    estimate_scale_from_markers,
    make_metric_views,
)
from splatnode.recon.metric.odometry import (
    PoseAlignment,
    PoseSigmas,
    align_to_motions,
    align_to_poses,
    estimate_scale_from_motions,
    estimate_up,
)
from splatnode.recon.metric.stereo import (
    MetricDepth,
    StereoPair,
    estimate_scale_from_network,
    estimate_scale_from_stereo,
    make_own_pair,
)
from splatnode.recon.networks.depth_anything import load_metric
from splatnode.recon.occupancy import TILT, UNSURE_DEG, find_floor, level
from splatnode.recon.result.placement import Placement
from splatnode.recon.result.snapshot import (
    DepthCheck,
    DepthCode,
    GaussianArrays,
    GivenCameraPose,
    InGivenWorld,
    Landmarks,
    Snapshot,
    find_confirmed,
    format_rounded_up,
)
from splatnode.recon.result.verdict import (
    FIRST_CAMERA,
    Code,
    FrameName,
    ReferenceFrame,
    Scale,
    Up,
    Verdict,
    encode_matrix,
    join_sentences,
    parse_frame_name,
)

# What photographs themselves tell of metres, gathered before the scene is known.


@dataclass(frozen=True, eq=False)
class CameraDepth:
    """A depth image, and the id of the camera that it is beside; empty: there is one."""

    camera_id: str
    depth: DepthImage


@dataclass(frozen=True, eq=False)
class Evidence:
    """The scale evidence found in images, whether or not they get cameras."""

    sightings: tuple[MarkerDetection, ...] = ()  # of printed markers
    # T_world_camera (4, 4) in metres that others estimated, by photograph; None: no poses were given
    poses: Mapping[str, npt.NDArray[np.float64]] | None = None
    pairs: tuple[StereoPair, ...] = ()  # of stereo cameras
    tracked: Mapping[str, GivenPose] = field(default_factory=dict)  # that came with the photographs, by photograph
    motions: Mapping[str, Motion] = field(default_factory=dict)  # likewise
    gravities: Mapping[str, Gravity] = field(default_factory=dict)  # likewise
    depths: Mapping[str, CameraDepth] = field(default_factory=dict)  # of depth cameras, likewise
    # T_base_camera (4, 4) in metres: where the photograph's camera stands on the robot's base, likewise
    mounts: Mapping[str, npt.NDArray[np.float64]] = field(default_factory=dict)

    def merge(self, further: Evidence) -> Evidence:
        """Returns this evidence merged with that of further images."""
        poses = self.poses if further.poses is None else {**(self.poses or {}), **further.poses}
        sightings, pairs = (*self.sightings, *further.sightings), (*self.pairs, *further.pairs)
        tracked, motions = {**self.tracked, **further.tracked}, {**self.motions, **further.motions}
        gravities, depths = {**self.gravities, **further.gravities}, {**self.depths, **further.depths}
        mounts = {**self.mounts, **further.mounts}
        return Evidence(sightings, poses, pairs, tracked, motions, gravities, depths, mounts)


NOTHING = Evidence()


def gather_evidence(
    frames: Iterable[Frame | DroppedFrame], config: MetricConfig, tell: Tell = ignore_progress
) -> Evidence:
    """Gathers the markers that `config` asks for, and the poses, motions, gravity, mounts, right and depth images.

    Raises ValueError where intrinsics cannot be used.
    """
    known = [each for each in frames if isinstance(each, Frame)]
    came = Evidence(
        tracked={each.name: each.given_pose for each in known if each.given_pose is not None},
        motions={each.name: each.motion for each in known if each.motion is not None},
        gravities={each.name: each.gravity for each in known if each.gravity is not None},
        depths={each.name: CameraDepth(each.camera_id, depth) for each in known if (depth := straighten_depth(each))},
        pairs=tuple(pair for pair in map(make_own_pair, known) if pair is not None),
        mounts={each.name: mount for each in known if (mount := each.mount) is not None},
    )
    if config.marker_size_m is None:
        return came
    tell(ProgressStep("looking for markers"))
    return replace(came, sightings=tuple(detect_markers(known, config.marker_dictionary)))


MOST_SCALE_ERROR = 0.1  # of the logarithm of a depth camera's unit, beside other sources, for it alone to be to blame

# The unit by depth images: their depths over those of the scene's points, checked by the images and other sources.


def estimate_scale_from_depth(
    views: Mapping[str, MetricView],
    landmarks: Landmarks | None,
    depths: Mapping[str, CameraDepth],
    others: Sequence[Measurement],
) -> tuple[list[Measurement | str], tuple[DepthCheck, ...]]:
    """The unit by the depth images of each camera, or why there is none; and the judgement on each camera's.

    `others` is what further sources measured. Where these agree, and depths have another unit by MAX_DEVIATION standard
    deviations, the depth camera is named with its error, and gives no unit.
    """
    if not depths:
        return [], ()
    if landmarks is None:
        message = f"depth images of {len(depths)} photographs were given, and the scene has no points to compare with"
        return [message], (DepthCheck(DepthCode.UNTESTED, message),)
    fits = fit_depth_images(
        [
            _make_depth_view(name, view, landmarks, depths[name])
            for name, view in views.items()
            if name in depths and name in landmarks.names
        ]
    )
    of_scene = compute_scale_sigma(list(views.values()))
    agreed = combine_measurements(others) if others else None
    results = [measure_by_depth(fit, of_scene, agreed if isinstance(agreed, Measurement) else None) for fit in fits]
    return [said for said, _ in results], tuple(check for _, check in results)


def _make_depth_view(name: str, view: MetricView, landmarks: Landmarks, own: CameraDepth) -> DepthView:
    number = landmarks.names.index(name)
    points = landmarks.points[np.unique(landmarks.point_of[landmarks.photograph_of == number])]
    in_camera = (points - view.centre) @ view.T_world_camera[:3, :3]
    lens = merge_lens(view.focal, view.radial, view.shift, own.depth)
    return DepthView(name, own.camera_id, in_camera, own.depth, lens)


def measure_by_depth(
    fit: DepthFit, of_scene: float, agreed: Measurement | None
) -> tuple[Measurement | str, DepthCheck]:
    """The unit by the depth images of one camera, or why there is none, and the judgement on them.

    `of_scene` is the standard deviation of the logarithm of the scene's lengths, `agreed` what other sources measured.
    """
    check = fit.check
    if not fit.is_usable:
        return check.message, check
    who = name_depth_images(len(fit.names), fit.camera_id)
    measured = Measurement(fit.metres_per_unit, math.hypot(fit.sigma, of_scene), who)
    if agreed is None:
        return measured, check
    error = measured.metres_per_unit / agreed.metres_per_unit - 1.0
    spread = math.hypot(measured.sigma, agreed.sigma)
    if abs(math.log1p(error)) <= MAX_DEVIATION * spread:
        return measured, check
    if abs(math.log1p(error)) > MOST_SCALE_ERROR:  # no depth camera errs so much: which source does is not known
        factor = max(1.0 + error, 1.0 / (1.0 + error))
        message = (
            f"{who} and {agreed.source} contradict each other by a factor of {factor:.3g}, so no metres are given. "
            "Measure both again, and check their units"
        )
        return measured, replace(check, code=DepthCode.SCALE, message=message, scale_error=float(error))
    message = (
        f"{who} are {100 * abs(error):.1f} % too {'large' if error > 0 else 'small'} by {agreed.source} "
        f"({abs(math.log1p(error)) / spread:.1f} standard deviations), so they give no metres; their shape is used. "
        "Calibrate the depth camera, or measure the other again"
    )
    return message, replace(check, code=DepthCode.SCALE, message=message, scale_error=float(error))


# A scene in the frame of reference that was asked for; where that is not known, a refusal that says what is missing.
#
# Nothing is taken for granted: a base frame needs the mount of the first camera and metres, an odometry frame needs
# given poses or motions, an upright frame needs gravity or a floor.

Array = npt.NDArray[np.float64]

MOST_DEG = 10.0  # standard deviation of up by gravity, beyond which it tells no upright frame
FLOOR_SIGMA_DEG = 1.0  # how level floors are; to this comes how well their plane is found
BASE_SIGMA_DEG = 5.0  # of a base's z axis against gravity where nothing tells it: how level robots stand
FARTHEST_MOUNT_M = 20.0  # of a camera from its base; beyond, the mount is probably in millimetres, which is told
CONTRADICTED_DEG = 20.0  # between gravity and the floor, from which on this is told: a sign is wrong, or it is no floor
_STRAIGHT = 1e-3  # length of a camera's forward axis in the level plane, below which it looks straight up or down

USE_FIRST = "Or ask for frame: first_camera."
_GIVE_METRES = (
    "Give something that tells metres: a marker, a distance, poses, wheels, stereo, depth, or a rig of several "
    f"cameras. {USE_FIRST}"
)


class UnknownFrame(ValueError):
    """Nothing that was given tells the frame of reference; the text says what is missing and what to do."""


@dataclass(frozen=True, eq=False)
class _Missing:
    """Why a frame is not known, and what to do."""

    what: str
    advice: str


@dataclass(frozen=True, eq=False)
class _Found:
    """T_frame_world (4, 4), rigid, from the present world to the frame that was asked for."""

    T_frame_world: Array
    source: str | None = None
    sigma_deg: float | None = None


def check_frame(config: MetricConfig, evidence: Evidence, has_lengths: bool = False) -> None:
    """Raises UnknownFrame before the work where it is known already that the frame cannot be had.

    `has_lengths`: something beside both may tell metres, as a rig that is given.
    """
    if config.frame is None:
        return
    name = parse_frame_name(config.frame)
    missing = _find_missing_evidence(name, evidence)
    if missing is None and name is FrameName.BASE and not (has_lengths or _may_tell_metres(config, evidence)):
        missing = _Missing("nothing that was given tells metres, in which T_base_camera is", _GIVE_METRES)
    if missing is not None:
        raise UnknownFrame(f"frame: {config.frame} was asked for, and {missing.what}. {missing.advice}")


def _may_tell_metres(config: MetricConfig, evidence: Evidence) -> bool:
    asked = config.baselines, config.marker_size_m, config.depth_network
    return any((*asked, evidence.poses, evidence.tracked, evidence.motions, evidence.pairs, evidence.depths))


def _find_missing_evidence(name: FrameName, evidence: Evidence) -> _Missing | None:
    if name is FrameName.BASE and not evidence.mounts:
        return _Missing(
            "no image tells where its camera stands on the robot's base",
            "Give T_base_camera: in the camera's configuration, in rig.yaml (--rig), in an MCAP file's tf_static, or "
            f"as an argument. {USE_FIRST}",
        )
    if name is FrameName.ODOMETRY and not (evidence.poses or evidence.tracked or evidence.motions):
        return _Missing(
            "no image has a pose or a motion",
            f"Give --poses FILE, images with poses, or an MCAP file with odometry. {USE_FIRST}",
        )
    return None


def express_in_frame(snapshot: Snapshot, config: MetricConfig, evidence: Evidence) -> Snapshot:
    """The snapshot in the frame that was asked for, which its scale states; as it is where none was.

    A publishable snapshot whose frame is not known is refused as FRAME_UNKNOWN: it has no scene then.
    """
    if config.frame is None or not snapshot.cameras:
        return snapshot
    name = parse_frame_name(config.frame)
    found = _find_missing_evidence(name, evidence) or _FINDERS[name](snapshot, config, evidence)
    if isinstance(found, _Missing):
        return _refuse_frame(snapshot, name, found)
    moved = transform_rigidly(snapshot, make_rigid(found.T_frame_world))
    T_frame_first_camera = np.eye(4) if name is FrameName.FIRST_CAMERA else moved.cameras[0].T_world_camera
    frame = ReferenceFrame(name, found.source, found.sigma_deg, encode_matrix(T_frame_first_camera))
    up = moved.up
    if name is FrameName.BASE and up is None:
        up = Up((0.0, 0.0, 1.0), BASE_SIGMA_DEG, "the z axis of the robot's base, which is taken to stand level")
    if name is FrameName.UPRIGHT and found.sigma_deg is not None and found.source is not None:
        up = Up((0.0, 0.0, 1.0), found.sigma_deg, found.source)
    return replace(moved, up=up, scale=replace(moved.scale, frame=frame))


def _refuse_frame(snapshot: Snapshot, name: FrameName, missing: _Missing) -> Snapshot:
    message = f"The frame of reference {name.value} was asked for, and {missing.what}."
    verdict = Verdict(Code.FRAME_UNKNOWN, message, missing.advice, provisional=snapshot.verdict.provisional)
    return replace(
        snapshot,
        verdict=verdict,
        cameras=(),
        gaussians=GaussianArrays.empty(),
        images={},
        landmarks=None,
        depths={},
        rig=None,
        up=None,
        given=None,
    )


def _find_first_camera(snapshot: Snapshot, _config: MetricConfig, _evidence: Evidence) -> _Found:
    return _Found(invert_pose(snapshot.cameras[0].T_world_camera))


def _find_base(snapshot: Snapshot, _config: MetricConfig, evidence: Evidence) -> _Found | _Missing:
    """The base at the first image, by that image's camera."""
    first = snapshot.cameras[0]
    if first.name not in evidence.mounts:
        return _Missing(
            f"nobody tells where the camera of the first image, {first.name}, stands on the robot's base",
            f"Give T_base_camera of all cameras. {USE_FIRST}",
        )
    if not snapshot.scale.metric:
        why = f": {snapshot.scale.source}" if snapshot.scale.source else ""
        return _Missing(
            f"the scene has no metres, in which T_base_camera is{why}",
            _GIVE_METRES,
        )
    mount = evidence.mounts[first.name]
    source, away_m = f"T_base_camera of {first.name}", float(np.linalg.norm(mount[:3, 3]))
    if away_m > FARTHEST_MOUNT_M:
        source += f", which is {away_m:.0f} m from the base: T_base_camera is in metres, not in millimetres"
    return _Found(mount @ invert_pose(first.T_world_camera), source)


def _find_odometry(snapshot: Snapshot, _config: MetricConfig, evidence: Evidence) -> _Found | _Missing:
    """The world of given poses, where the scene lies already if they fit; else the start of its motions."""
    scale = snapshot.scale
    if scale.frame.name is FrameName.ODOMETRY:
        return _Found(np.eye(4), scale.frame.source)
    if evidence.poses or evidence.tracked or not scale.metric:
        why = scale.source or "they are not enough for metres"
        return _Missing(
            f"the poses or motions that were given do not tell it: {why}",
            f"Check that they are of the cameras, in metres, and two or more. {USE_FIRST}",
        )
    poses = _chain_motions(snapshot, evidence)
    if isinstance(poses, _Missing):
        return poses
    placement = align_to_motions(make_metric_views(snapshot), evidence.motions, poses)
    if isinstance(placement, str):
        return _Missing(f"the motions do not tell it: {placement}", USE_FIRST)
    rigid, T = placement.place(1.0), np.eye(4)
    T[:3, :3], T[:3, 3] = rigid.rotation, rigid.translation
    return _Found(T, f"motions of {len(poses)} images since they began")


def _chain_motions(snapshot: Snapshot, evidence: Evidence) -> dict[str, Array] | _Missing:
    """T_start_camera (4, 4) by image of the one chain of motions: from the base at its start where all mounts are told.

    One chain is of one camera. Else the start is the camera's own frame.
    """
    motions = {each.name: evidence.motions[each.name] for each in snapshot.cameras if each.name in evidence.motions}
    chains = sorted({each.chain for each in motions.values()})
    if len(motions) < 2 or len(chains) != 1:
        return _Missing(
            f"{len(motions)} images of the scene have motions, of {len(chains)} chains: two images of one chain are "
            "the least, and several chains have no frame in common",
            f"Give poses, or motions of one camera. {USE_FIRST}",
        )
    if all(name in evidence.mounts for name in motions):
        return {name: evidence.mounts[name] @ each.matrix for name, each in motions.items()}
    return {name: each.matrix for name, each in motions.items()}


def _find_upright(snapshot: Snapshot, _config: MetricConfig, _evidence: Evidence) -> _Found | _Missing:
    """At the first camera, z against gravity or away from the floor; gravity counts where it is known well."""
    up, floor = snapshot.up, _find_floor_up(snapshot)
    if up is None or up.sigma_deg > UNSURE_DEG:
        up = floor or up
    elif floor is not None and (apart := measure_angle_deg(up, floor)) > CONTRADICTED_DEG:
        source = f"{up.source}, which {floor.source} contradicts by {apart:.0f} degrees: check its sign"
        T_frame_world = make_upright_frame(snapshot.cameras[0].T_world_camera, np.array(up.direction))
        return _Found(T_frame_world, source, apart)  # either may be wrong: up is known no better
    if up is None or up.sigma_deg > MOST_DEG:
        known = "no image has gravity" if up is None else f"gravity is known to {up.sigma_deg:.2g} degrees alone"
        return _Missing(
            f"{known}, and no floor was found in what the images show",
            "Give gravity: in the images, as an MCAP file's IMU or a session's gravity, or as --gravity X,Y,Z (down in "
            f"the first camera's frame: x right, y down, z forward). {USE_FIRST}",
        )
    return _Found(
        make_upright_frame(snapshot.cameras[0].T_world_camera, np.array(up.direction)), up.source, up.sigma_deg
    )


def measure_angle_deg(up: Up, other: Up) -> float:
    """Degrees between two directions of up."""
    return float(np.degrees(np.arccos(np.clip(np.dot(up.direction, other.direction), -1.0, 1.0))))


def _find_floor_up(snapshot: Snapshot) -> Up | None:
    """Up by the floor among the surfaces that two images confirm."""
    confirmed = find_confirmed(snapshot.gaussians.source_frame)
    points = snapshot.gaussians.means[confirmed].astype(np.float64)
    Ts = np.stack([camera.T_world_camera for camera in snapshot.cameras])
    if not len(points):
        return None
    unit = float(np.median(np.linalg.norm(points - Ts[:, :3, 3].mean(0), axis=1)))
    floor = find_floor(points, Ts[:, :3, 3], level(Ts)[0], unit, TILT)
    if floor is None:
        return None
    x, y, z = (floor.normal / np.linalg.norm(floor.normal)).tolist()
    known = f"the floor, a plane through {100 * floor.share:.0f} % of the surface, with cameras taken as held upright"
    return Up((x, y, z), math.hypot(FLOOR_SIGMA_DEG, floor.tilt_deg), known)


def make_upright_frame(T_world_camera: Array, up: Array) -> Array:
    """T_upright_world (4, 4): at the camera, x along its view and y to its left, both level; z along `up` (3,)."""
    forward = T_world_camera[:3, 2] - (T_world_camera[:3, 2] @ up) * up
    if np.linalg.norm(forward) < _STRAIGHT:  # it looks straight up or down: its upper edge tells ahead
        forward = -T_world_camera[:3, 1] + (T_world_camera[:3, 1] @ up) * up
    x = forward / np.linalg.norm(forward)
    T_world_upright = np.eye(4)
    T_world_upright[:3, :3] = np.stack([x, np.cross(up, x), up], 1)
    T_world_upright[:3, 3] = T_world_camera[:3, 3]
    return invert_pose(T_world_upright)


_FINDERS = {
    FrameName.FIRST_CAMERA: _find_first_camera,
    FrameName.BASE: _find_base,
    FrameName.ODOMETRY: _find_odometry,
    FrameName.UPRIGHT: _find_upright,
}


def collect_gravities(snapshot: Snapshot, config: MetricConfig, evidence: Evidence) -> Mapping[str, Gravity]:
    """Collects gravity by image: what came with the images, and for the first one what was told."""
    if config.gravity is None or not snapshot.cameras:
        return evidence.gravities
    return {snapshot.cameras[0].name: Gravity(config.gravity), **evidence.gravities}


def find_up(snapshot: Snapshot, config: MetricConfig, evidence: Evidence) -> Up | None:
    """Up in the world of the cameras by gravity; None where it is not known."""
    up = estimate_up(make_metric_views(snapshot), collect_gravities(snapshot, config, evidence))
    is_config_gravity = config.gravity is not None and not any(
        each.name in evidence.gravities for each in snapshot.cameras
    )
    return (
        replace(up, source="gravity as it was told for the first image") if up is not None and is_config_gravity else up
    )


def transform_rigidly(snapshot: Snapshot, T: Array) -> Snapshot:
    """The snapshot in the frame that the rigid motion `T` (4, 4) leads to, with all that is in its world."""
    placement = Placement(1.0, T[:3, :3], T[:3, 3])
    landmarks = snapshot.landmarks and snapshot.landmarks.transform(
        1.0, T[:3, :3], T[:3, 3], metric=snapshot.landmarks.metric
    )
    up = snapshot.up
    if up is not None:
        x, y, z = (T[:3, :3] @ np.array(up.direction)).tolist()
        up = replace(up, direction=(x, y, z))
    return replace(
        snapshot,
        cameras=tuple(map(placement.transform_camera, snapshot.cameras)),
        gaussians=placement.transform_gaussians(snapshot.gaussians),
        landmarks=landmarks,
        up=up,
        given=None,  # it tells how the scene lay before
    )


# A scene in metres, by all that was measured; where that cannot be had it stays relative, and its scale says why.

# Of the scene's size: a grid as coarse as its coordinates may be. A render then has 40 dB against the same elsewhere.
MOST_STEP = 1e-3


def apply_metric_scale(snapshot: Snapshot, config: MetricConfig, evidence: Evidence = NOTHING) -> Snapshot:
    """The snapshot with lengths in metres where `config` gives them a unit; as it is where nothing was asked for.

    `evidence` is what its photographs tell of what `config` asks for. A source that can say nothing is left out where
    another can. Where sources contradict each other the scene stays relative. Where poses are among what counts, the
    world is theirs. Gravity, where it came with photographs, tells where up is. Last the scene is expressed in the
    frame of reference that `config` asks for; where that is not known it is refused.
    """
    measured = _apply_metric_scale(snapshot, config, evidence)
    up = find_up(measured, config, evidence)
    return express_in_frame(measured if up is None else replace(measured, up=up), config, evidence)


def _apply_metric_scale(snapshot: Snapshot, config: MetricConfig, evidence: Evidence) -> Snapshot:
    said, aligned = _collect_measurements(snapshot, config, evidence) if len(snapshot.cameras) else ([], None)
    if evidence.depths and len(snapshot.cameras):
        others = [each for each in said if isinstance(each, Measurement)]
        depth_results, checks = estimate_scale_from_depth(
            make_metric_views(snapshot), snapshot.landmarks, evidence.depths, others
        )
        if snapshot.given is not None and snapshot.given.from_depth:
            depth_results, checks = [], tuple(map(_describe_placing, checks))  # they give the unit already
        said, snapshot = said + depth_results, replace(snapshot, depth_checks=checks)
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
    return replace(metric, scale=Scale(True, source, (low, high), _describe_world(metric, aligned)))


def _describe_world(metric: Snapshot, aligned: PoseAlignment | None) -> ReferenceFrame:
    """The frame that the scene is in: that of given poses where it is aligned to them."""
    if aligned is None:
        return FIRST_CAMERA
    T = encode_matrix(metric.cameras[0].T_world_camera)
    return ReferenceFrame(FrameName.ODOMETRY, aligned.unit.source, None, T)


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
    if snapshot.given is not None and snapshot.given.from_depth:
        known = f"depth images of {snapshot.given.num_poses} photographs, which place the cameras"
        said.append(Measurement(snapshot.given.scale, snapshot.given.scale_sigma, known))
    elif snapshot.given is not None:
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
        said += [found] if isinstance(found, str) else [found.unit, *found.notes]
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


def _describe_placing(check: DepthCheck) -> DepthCheck:
    """The check of depth images that place the cameras: that points of the photographs are too few leaves them in."""
    if not has_too_few_points(check):
        return check
    message = (
        f"depth images place the cameras; {check.num_points} points of the images have a depth, too few for a test"
    )
    return replace(check, message=message)


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
