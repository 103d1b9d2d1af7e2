"""A scene in the frame of reference that was asked for; where that is not known, a refusal that says what is missing.

Nothing is taken for granted: a base frame needs the mount of the first camera and metres, an odometry frame needs given
poses or motions, an upright frame needs gravity or a floor.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import numpy.typing as npt

from splatnode.capture.odometry import Gravity, make_rigid
from splatnode.recon.metric.evidence import Evidence
from splatnode.recon.metric.measurement import MetricConfig, make_metric_views
from splatnode.recon.metric.odometry import PoseAlignment, PoseSigmas, align_to_poses, estimate_up
from splatnode.recon.occupancy.grid import TILT, UNSURE_DEG, find_floor, level
from splatnode.recon.result.placement import Placement
from splatnode.recon.result.reference_frame import FrameName, ReferenceFrame, encode_matrix, parse_frame_name
from splatnode.recon.result.snapshot import GaussianArrays, Snapshot, find_confirmed
from splatnode.recon.result.verdict import Code, Up, Verdict

Array = npt.NDArray[np.float64]

MOST_DEG = 10.0  # standard deviation of up by gravity, beyond which it tells no upright frame
# Standard deviation of a floor's normal against gravity: how level floors are, and how well their plane is found
FLOOR_SIGMA_DEG = 1.0
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
    return _Found(_invert(snapshot.cameras[0].T_world_camera))


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
    return _Found(mount @ _invert(first.T_world_camera), source)


def _find_odometry(snapshot: Snapshot, config: MetricConfig, evidence: Evidence) -> _Found | _Missing:
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
    own = {name: (max(each.sigma_m, config.poses_sigma_m), max(each.sigma_deg, config.poses_sigma_deg))
           for name, each in evidence.motions.items() if name in poses}  # fmt: skip
    aligned = align_to_poses(
        make_metric_views(snapshot), poses, PoseSigmas(config.poses_sigma_m, config.poses_sigma_deg, 0.0), own
    )
    if not isinstance(aligned, PoseAlignment):
        return _Missing(f"the motions do not tell it: {aligned}", USE_FIRST)
    rigid, T = aligned.rescale(1.0), np.eye(4)
    T[:3, :3], T[:3, 3] = rigid.rotation, rigid.translation
    return _Found(T, f"motions of {len(poses)} images since they began")


def _chain_motions(snapshot: Snapshot, evidence: Evidence) -> dict[str, Array] | _Missing:
    """T_start_camera (4, 4) by image of the one chain of motions: from the base at its start where all mounts are told.

    One chain is of one camera. Else the start is the camera's own frame.
    """
    told = {each.name: evidence.motions[each.name] for each in snapshot.cameras if each.name in evidence.motions}
    chains = sorted({each.chain for each in told.values()})
    if len(told) < 2 or len(chains) != 1:
        return _Missing(
            f"{len(told)} images of the scene have motions, of {len(chains)} chains: two images of one chain are the "
            "least, and several chains have no frame in common",
            f"Give poses, or motions of one camera. {USE_FIRST}",
        )
    if all(name in evidence.mounts for name in told):
        return {name: evidence.mounts[name] @ each.matrix for name, each in told.items()}
    return {name: each.matrix for name, each in told.items()}


def _find_upright(snapshot: Snapshot, _config: MetricConfig, _evidence: Evidence) -> _Found | _Missing:
    """At the first camera, z against gravity or away from the floor; gravity counts where it is known well."""
    up, floor = snapshot.up, _find_floor_up(snapshot)
    if up is None or up.sigma_deg > UNSURE_DEG:
        up = floor or up
    elif floor is not None and (apart := measure_angle_deg(up, floor)) > CONTRADICTED_DEG:
        up = replace(up, source=f"{up.source}, which {floor.source} contradicts by {apart:.0f} degrees: check its sign")
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
    return Up((x, y, z), FLOOR_SIGMA_DEG, known)


def make_upright_frame(T_world_camera: Array, up: Array) -> Array:
    """T_upright_world (4, 4): at the camera, x along its view and y to its left, both level; z along `up` (3,)."""
    forward = T_world_camera[:3, 2] - (T_world_camera[:3, 2] @ up) * up
    if np.linalg.norm(forward) < _STRAIGHT:  # it looks straight up or down: its upper edge tells ahead
        forward = -T_world_camera[:3, 1] + (T_world_camera[:3, 1] @ up) * up
    x = forward / np.linalg.norm(forward)
    T_world_upright = np.eye(4)
    T_world_upright[:3, :3] = np.stack([x, np.cross(up, x), up], 1)
    T_world_upright[:3, 3] = T_world_camera[:3, 3]
    return _invert(T_world_upright)


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
    is_told = config.gravity is not None and not any(each.name in evidence.gravities for each in snapshot.cameras)
    return replace(up, source="gravity as it was told for the first image") if up is not None and is_told else up


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


def _invert(T: Array) -> Array:
    inverse = np.eye(4)
    inverse[:3, :3], inverse[:3, 3] = T[:3, :3].T, -T[:3, :3].T @ T[:3, 3]
    return inverse
