"""View graphs, registrations and evidence made by hand, and verdicts on them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.capture.frame import Frame
from splatnode.recon.keyframes import Features, Keyframe
from splatnode.recon.matching import view_graph as matching
from splatnode.recon.matching.pair_matching import TwoView
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration.registration import RegisteredCamera, Registration
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification.decision import DecisionConfig, decide
from splatnode.recon.verification.evidence import CameraEvidence, CycleConsistency, Evidence, Reflection, WeakestLink
from splatnode.recon.verification.refit import Distortion, Errors, PoseErrors

PLAIN, RICH = 20, 2000  # features
SURE = PoseErrors(Errors(0.05, 0.05, 0.05), Errors(0.001, 0.001, 0.001))


def keyframe(index: int, num_features: int = RICH, size: tuple[int, int] = (64, 48)) -> Keyframe:
    image = np.zeros((size[1], size[0], 3), np.uint8)
    features = Features(
        points=np.zeros((num_features, 2)),
        descriptors=np.zeros((num_features, 128), np.uint8),
        point_of=np.arange(num_features),
        tilt=np.ones(num_features),
    )
    return Keyframe(Frame(index, f"{index}.png", index, image, None), image, features)


def pair(matches: int = 200, turned: bool = False) -> TwoView:
    return TwoView(
        matches=np.zeros((matches, 2), np.int64),
        points1=np.zeros((matches, 2)),
        points2=np.full((matches, 2), 5.0),
        num_candidates=2 * matches,
        log10_nfa=-100.0,
        num_homography=matches if turned else matches // 2,
        num_rotation=matches if turned else matches // 10,
        focal_ratio=1.0,
    )


def graph(num_frames: int, pairs: dict[tuple[int, int], TwoView], plain: tuple[int, ...] = ()) -> ViewGraph:
    keyframes = tuple(keyframe(i, PLAIN if i in plain else RICH) for i in range(num_frames))
    return ViewGraph(matching.MatchingConfig(), keyframes, pairs)


def all_pairs(num_frames: int, turned: tuple[tuple[int, int], ...] = ()) -> dict[tuple[int, int], TwoView]:
    return {(i, j): pair(turned=(i, j) in turned) for j in range(num_frames) for i in range(j)}


def registration(indices: tuple[int, ...]) -> Registration:
    """Cameras a step apart on a line. What the verdict needs to know of them is in the evidence."""
    cameras = []
    for index in indices:
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = 0.2 * index
        principal, still = np.array([32.0, 24.0]), np.zeros((3, 3))
        of_pose = T_world_camera, 0, 64.0, principal, np.zeros(2), 0.05, 0.005, still
        cameras.append(RegisteredCamera(index, *of_pose, focal_sigma=0.01))
    return Registration(
        cameras=tuple(cameras),
        points=np.zeros((0, 3)),
        observed_by=np.zeros(0, np.int64),
        observed_point=np.zeros(0, np.int64),
        observed_pixels=np.zeros((0, 2)),
        inlier_ratios={},
        focal_sigma=0.01,
        median_angle_deg=10.0,
        rms_px=0.3,
    )


def camera(index: int, **what: object) -> CameraEvidence:
    """A camera about which there is no doubt, but for `what`."""
    return replace(
        CameraEvidence(f"{index}.png", 1.0, 200, 0.7, 0.5, 1.0, SURE, Errors(0.01, 0.01, 0.01), False), **what
    )


def unsure(rotation: float = 0.05, centre: float = 0.001) -> PoseErrors:
    """Errors of these sizes, degrees and in the distance to the scene, as every source says."""
    return PoseErrors(Errors(rotation, rotation, rotation), Errors(centre, centre, centre))


def evidence(
    indices: tuple[int, ...], doubtful: dict[int, dict[str, object]] | None = None, **what: object
) -> Evidence:
    """Evidence for cameras about which there is no doubt, but for `doubtful` ones and `what` concerns all."""
    lens = {"focal": what["focal"]} if "focal" in what else {}
    good = Evidence(
        cameras=tuple(camera(index, **lens, **(doubtful or {}).get(index, {})) for index in indices),
        inlier_ratio=1.0,
        weakest_link=WeakestLink((f"{indices[-1]}.png",), shared_points=500, matches=200, inliers=200.0),
        disconnected=(),
        reflection=Reflection(("0.png",), -0.2),
        flatness=0.5,
        mirrored_cost=10.0,
        cycles=CycleConsistency(1, 0.1, 0.1, 0.1, 0.5),
        median_angle_deg=10.0,
        rms_px=0.3,
        focal=Errors(0.01, 0.01, 0.01),
        travel=0.2,
        freed=(),
        distortion=Distortion(0.0, 1.0),
    )
    return replace(good, **what)


def verdict(count: int, doubtful: dict[int, dict[str, object]] | None = None, **what: object) -> Verdict:
    """Of `count` frames that were all placed."""
    indices = tuple(range(count))
    return decide(
        graph(count, all_pairs(count)), registration(indices), evidence(indices, doubtful, **what), DecisionConfig()
    )


def refused(given: Verdict | None, code: Code) -> Verdict:
    assert given is not None and given.code == code and not given.publishable
    assert given.message.endswith(".") and given.advice.endswith(".")
    return given


def names(*indices: int) -> tuple[str, ...]:
    return tuple(f"{index}.png" for index in indices)
