"""The verdict on a view graph and what was made of it, before anything is published.

Every limit lies between what right and wrong registrations of real photographs showed (tests/bench/poses.py): the
figures beside the limits are the extremes of both.
"""

from __future__ import annotations

import msgspec
import numpy as np

from recon.registration.register import Registration
from recon.registration.two_view import TwoView
from recon.verdict import Code, Verdict
from recon.view_graph import ViewGraph, connected


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    min_cameras: int = 3  # with fewer, an unknown focal length cannot be told from the motion
    min_features: int = 150  # frames with fewer show too little texture
    static_px: float = 1.0  # median motion of a pair's matches, at 1024 px, below which the camera stood still
    turned_share: float = 0.8  # share of pairs that show no parallax at which the camera has only turned
    planar_share: float = 0.9  # of a pair's matches on one plane; entry_p10, a facade, reaches 0.84
    min_angle_deg: float = 1.5  # median of the points' widest viewing angles; right from 3.1
    min_agreement: float = 0.78  # of all matches that the cameras explain; right from 0.82, wrong up to 0.76
    strong_link: int = 60  # explained matches of a pair; unrelated places reach 39 by chance
    enough_links: int = 120  # explained matches of several pairs; unrelated places reach 81, a right answer has 166
    min_link_agreement: float = 0.85  # of fewer that alone hold two groups together; two places reach 0.6
    blurred_px: float = 0.7  # residual of blurred images; right above it only with nearly full agreement
    blurred_agreement: float = 0.95
    max_rotation_sigma_deg: float = 1.5  # right up to 1.1, wrong from 3.6
    max_centre_sigma_rel: float = 0.025  # right up to 0.018, wrong from 0.047
    min_confirmed: int = 5  # points of a camera that two others see too; right from 8, wrong up to 8
    max_focal_sigma: float = 0.08  # of log focal; right up to 0.073, wrong from 0.13


def judge(graph: ViewGraph, registration: Registration | None, config: Config) -> Verdict:
    """OK, or another code that is publishable, or the reason why there is no scene."""
    refusal = _too_little(graph, config) or _no_motion(graph, config)
    if refusal is not None:
        return refusal
    if registration is None or len(registration.cameras) < config.min_cameras:
        return _not_placed(graph, registration, config)
    return (
        _contradicted(graph, registration, config)
        or _uncertain(graph, registration, config)
        or _accepted(graph, registration)
    )


def _too_little(graph: ViewGraph, config: Config) -> Verdict | None:
    names = [keyframe.name for keyframe in graph.keyframes]
    if len(names) < config.min_cameras:
        return Verdict(
            Code.TOO_FEW_VIEWS,
            f"{len(names)} usable frame{'s' if len(names) != 1 else ''}: at least {config.min_cameras} are needed.",
            "Take more photographs of the same place, each from a step further to the side.",
            tuple(names),
        )
    if graph.pairs:
        return None
    plain = tuple(keyframe.name for keyframe in graph.keyframes if len(keyframe.features.points) < config.min_features)
    if len(plain) > len(names) / 2:
        return Verdict(
            Code.LOW_TEXTURE,
            f"{len(plain)} of {len(names)} frames show too little texture to be matched.",
            "Let more structured things into the picture, or step back.",
            plain,
        )
    return _no_overlap(names, "No two frames show enough of the same things.")


def _no_motion(graph: ViewGraph, config: Config) -> Verdict | None:
    """The camera stood still, or only turned, or all that it saw is a plane."""
    names = [keyframe.name for keyframe in graph.keyframes]

    def frames(pairs: list[tuple[int, int]]) -> tuple[str, ...]:
        return tuple(sorted({names[i] for pair in pairs for i in pair}))

    num_pairs = len(graph.pairs)
    still = [pair for pair, view in graph.pairs.items() if _motion_px(graph, pair, view) < config.static_px]
    if len(still) == num_pairs:
        return Verdict(
            Code.STATIC_CAMERA,
            "The camera did not move: the frames that overlap are copies of each other.",
            "Step to the side between photographs, about a tenth of the distance to the scene.",
            frames(still),
        )
    turned = _turned(graph)
    if len(turned) >= config.turned_share * num_pairs:
        return _no_parallax(graph, turned)
    planar = [
        pair for pair, view in graph.pairs.items() if view.num_homography >= config.planar_share * len(view.matches)
    ]
    if len(planar) == num_pairs:
        return Verdict(
            Code.PLANAR_ONLY,
            "Everything that the frames have in common lies in one plane: focal length and motion stay open.",
            "Let things at other distances into the picture, or give the camera's calibration.",
            frames(planar),
        )
    return None


def _turned(graph: ViewGraph) -> list[tuple[int, int]]:
    return [pair for pair, view in graph.pairs.items() if view.turned_only]


def _no_parallax(graph: ViewGraph, turned: list[tuple[int, int]]) -> Verdict:
    return Verdict(
        Code.NO_PARALLAX,
        f"The camera only turned: {len(turned)} of {len(graph.pairs)} overlapping pairs show no parallax.",
        "Step at least 20 cm to the side between photographs instead of turning on the spot.",
        tuple(sorted({graph.keyframes[i].name for pair in turned for i in pair})),
    )


def _motion_px(graph: ViewGraph, pair: tuple[int, int], view: TwoView) -> float:
    """Median motion of a pair's matches at 1024 pixels on the longer side."""
    frame = graph.keyframes[pair[0]].frame
    motion = np.linalg.norm(view.points2 - view.points1, axis=1)
    return float(np.median(motion)) * 1024.0 / max(frame.width, frame.height)


def _not_placed(graph: ViewGraph, registration: Registration | None, config: Config) -> Verdict:
    names = [keyframe.name for keyframe in graph.keyframes]
    components = graph.components()
    if len(components[0]) < config.min_cameras:
        return _no_overlap(names, f"Only {len(components[0])} of {len(names)} frames overlap.")
    turned = _turned(graph)
    if 2 * len(turned) >= len(graph.pairs):
        return _no_parallax(graph, turned)
    found = 0 if registration is None else len(registration.cameras)
    return _no_overlap(names, f"Only {found} of {len(names)} frames could be placed with certainty.")


def _contradicted(graph: ViewGraph, registration: Registration, config: Config) -> Verdict | None:
    """The cameras do not explain what the frames have in common."""
    names = [keyframe.name for keyframe in graph.keyframes]
    explained = sum(share * len(graph.pairs[pair].matches) for pair, share in registration.agreement.items())
    agreement = explained / max(1, sum(len(graph.pairs[pair].matches) for pair in registration.agreement))
    if registration.rms_px > config.blurred_px and agreement < config.blurred_agreement:
        return Verdict(
            Code.BLUR,
            f"The frames fit together only to {registration.rms_px:.1f} pixels: they are blurred, or things moved.",
            "Hold the camera still for each photograph, or give it more light.",
            tuple(names[camera.index] for camera in registration.cameras),
        )
    if agreement < config.min_agreement:
        contradicting = [pair for pair, share in registration.agreement.items() if share < 0.5]
        return Verdict(
            Code.AMBIGUOUS,
            f"The frames contradict each other: only {100 * agreement:.0f} % of their matches fit together.",
            "Add photographs between those named; look out for repeated or mirrored structures and moving things.",
            tuple(sorted({names[i] for pair in contradicting for i in pair})),
        )
    loose = _loosely_held(graph, registration, config)
    if loose:
        return Verdict(
            Code.SPLIT,
            f"{len(loose)} frames may show another place: only a few contradicted matches hold them to the others.",
            "Add photographs that connect the places, or take them one after the other.",
            tuple(names[i] for i in loose),
        )
    return None


def _loosely_held(graph: ViewGraph, registration: Registration, config: Config) -> list[int]:
    """Cameras outside the largest group that strong pairs connect, if what joins them to it contradicts itself.

    The share that a pair explains does not tell alone: pairs of a right answer may explain half of their matches each
    where structures repeat, but they are many, or strong.
    """
    explained = {pair: share * len(graph.pairs[pair].matches) for pair, share in registration.agreement.items()}
    strong = [pair for pair, matches in explained.items() if matches >= config.strong_link]
    loose = []
    for group in connected([camera.index for camera in registration.cameras], strong)[1:]:
        across = [pair for pair in explained if (pair[0] in group) != (pair[1] in group)]
        matched = sum(len(graph.pairs[pair].matches) for pair in across)
        held_by = sum(explained[pair] for pair in across)
        if held_by < min(config.enough_links, config.min_link_agreement * matched):
            loose += group
    return loose


def _uncertain(graph: ViewGraph, registration: Registration, config: Config) -> Verdict | None:
    """The cameras explain the matches, but so would others."""
    names = [keyframe.name for keyframe in graph.keyframes]
    if registration.median_angle_deg < config.min_angle_deg:
        return Verdict(
            Code.BASELINE_TOO_SMALL,
            f"The views are too close together: points are seen under {registration.median_angle_deg:.1f} degrees.",
            "Move further to the side between photographs: about a tenth of the distance to the scene.",
            tuple(names),
        )
    uncertain = tuple(
        names[camera.index]
        for camera in registration.cameras
        if camera.rotation_sigma_deg > config.max_rotation_sigma_deg
        or camera.centre_sigma_rel > config.max_centre_sigma_rel
    )
    if uncertain:
        return Verdict(
            Code.BASELINE_TOO_SMALL,
            f"The positions of {len(uncertain)} cameras are too uncertain to build on.",
            "Add photographs from further to the side, with more of the scene in common.",
            uncertain,
        )
    if registration.focal_sigma > config.max_focal_sigma:
        return Verdict(
            Code.FOCAL_SUSPECT,
            f"The focal length is uncertain by {100 * registration.focal_sigma:.0f} %.",
            "Give the camera's calibration, or photograph from further to the side instead of only forwards.",
            tuple(names[camera.index] for camera in registration.cameras),
        )
    times_seen = np.bincount(registration.observed_point, minlength=len(registration.points))
    by_third = times_seen[registration.observed_point] >= 3
    confirmed = np.bincount(registration.observed_by[by_third], minlength=len(names))
    unconfirmed = tuple(
        names[camera.index] for camera in registration.cameras if confirmed[camera.index] < config.min_confirmed
    )
    if unconfirmed:
        return Verdict(
            Code.AMBIGUOUS,
            f"{len(unconfirmed)} frames share points with one other only: nothing confirms where they are.",
            "Add photographs between those named and their neighbours.",
            unconfirmed,
        )
    return None


def _accepted(graph: ViewGraph, registration: Registration) -> Verdict:
    names = [keyframe.name for keyframe in graph.keyframes]
    placed = {camera.index for camera in registration.cameras}
    missing = [i for i in range(len(names)) if i not in placed]
    if not missing:
        return Verdict(Code.OK, f"All {len(names)} frames were placed.", "", (), publishable=True)
    left_out = tuple(names[i] for i in missing)
    summary = f"{len(placed)} of {len(names)} frames were placed"
    apart = [part for part in graph.components() if not placed & set(part)]
    if any(len(part) > 1 for part in apart):
        return Verdict(
            Code.SPLIT,
            f"{summary}; others show a place of their own: "
            + "; ".join(", ".join(names[i] for i in part) for part in apart)
            + ".",
            "Add photographs that connect the places, or take them one after the other.",
            left_out,
            publishable=True,
        )
    if len(apart) == len(missing) == 1 and len(placed) > 3:
        return Verdict(
            Code.OUTLIER_VIEW,
            f"{summary}; {left_out[0]} shows nothing of what the others show.",
            "Leave it out, or add a photograph between it and the others.",
            left_out,
            publishable=True,
        )
    return Verdict(
        Code.OK_PARTIAL,
        f"{summary}; {len(missing)} share too little with them.",
        f"Add a photograph between the others and {left_out[0]}.",
        left_out,
        publishable=True,
    )


def _no_overlap(names: list[str], message: str) -> Verdict:
    return Verdict(
        Code.NO_OVERLAP,
        message,
        "Take photographs that share at least half of their picture with the next one.",
        tuple(names),
    )
