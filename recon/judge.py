"""The verdict on a view graph and what was made of it, before anything is published."""

from __future__ import annotations

import msgspec

from recon.registration.register import Registration
from recon.verdict import Code, Verdict
from recon.view_graph import ViewGraph


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    min_cameras: int = 3  # with fewer, an unknown focal length cannot be told from the motion
    min_features: int = 150  # frames with fewer show too little texture
    turned_share: float = 0.8  # share of pairs that show no parallax at which the camera has only turned
    min_angle_deg: float = 1.5  # median of the points' widest viewing angles
    min_agreement: float = 0.8  # share of all pairwise matches that the cameras must explain
    max_rotation_sigma_deg: float = 0.7
    max_centre_sigma_rel: float = 0.05


def judge(graph: ViewGraph, registration: Registration | None, config: Config) -> Verdict:
    """OK or OK_PARTIAL with `publishable`, or the reason why there is no scene."""
    names = [keyframe.name for keyframe in graph.keyframes]
    if len(names) < config.min_cameras:
        return Verdict(
            Code.TOO_FEW_VIEWS,
            f"{len(names)} usable frame{'s' if len(names) != 1 else ''}: at least {config.min_cameras} are needed.",
            "Take more photographs of the same place, each from a step further to the side.",
            tuple(names),
        )
    plain = [keyframe.name for keyframe in graph.keyframes if len(keyframe.features.points) < config.min_features]
    if not graph.pairs:
        if len(plain) > len(names) / 2:
            return Verdict(
                Code.LOW_TEXTURE,
                f"{len(plain)} of {len(names)} frames show too little texture to be matched.",
                "Let more structured things into the picture, or step back.",
                tuple(plain),
            )
        return _no_overlap(names, "No two frames show enough of the same things.")
    turned = [pair for pair, view in graph.pairs.items() if view.turned_only]
    if len(turned) >= config.turned_share * len(graph.pairs):
        return Verdict(
            Code.NO_PARALLAX,
            f"The camera only turned: {len(turned)} of {len(graph.pairs)} overlapping pairs show no parallax.",
            "Step at least 20 cm to the side between photographs instead of turning on the spot.",
            tuple(sorted({names[i] for pair in turned for i in pair})),
        )
    largest = graph.components()[0]
    if registration is None or len(registration.cameras) < config.min_cameras:
        found = 0 if registration is None else len(registration.cameras)
        if len(largest) < config.min_cameras:
            return _no_overlap(names, f"Only {len(largest)} of {len(names)} frames overlap.")
        return _no_overlap(names, f"Only {found} of {len(names)} frames could be placed with certainty.")
    if registration.median_angle_deg < config.min_angle_deg:
        return Verdict(
            Code.BASELINE_TOO_SMALL,
            f"The views are too close together: points are seen under {registration.median_angle_deg:.1f} degrees.",
            "Move further to the side between photographs: about a tenth of the distance to the scene.",
            tuple(names),
        )
    explained = sum(share * len(graph.pairs[pair].matches) for pair, share in registration.agreement.items())
    matched = sum(len(graph.pairs[pair].matches) for pair in registration.agreement)
    if explained < config.min_agreement * matched:
        contradicting = [pair for pair, share in registration.agreement.items() if share < 0.5]
        return Verdict(
            Code.AMBIGUOUS,
            f"The frames contradict each other: only {100 * explained / matched:.0f} % of their matches fit together.",
            "Add photographs between those named; look out for repeated or mirrored structures and moving things.",
            tuple(sorted({names[i] for pair in contradicting for i in pair})),
        )
    uncertain = [
        names[camera.index]
        for camera in registration.cameras
        if camera.rotation_sigma_deg > config.max_rotation_sigma_deg
        or camera.centre_sigma_rel > config.max_centre_sigma_rel
    ]
    if uncertain:
        return Verdict(
            Code.BASELINE_TOO_SMALL,
            f"The positions of {len(uncertain)} cameras are too uncertain to build on.",
            "Add photographs from further to the side, with more of the scene in common.",
            tuple(uncertain),
        )
    placed = {names[camera.index] for camera in registration.cameras}
    missing = tuple(name for name in names if name not in placed)
    if missing:
        return Verdict(
            Code.OK_PARTIAL,
            f"{len(placed)} of {len(names)} frames were placed; {len(missing)} share too little with them.",
            f"Add a photograph between the others and {missing[0]}.",
            missing,
            publishable=True,
        )
    return Verdict(Code.OK, f"All {len(names)} frames were placed.", "", (), publishable=True)


def _no_overlap(names: list[str], message: str) -> Verdict:
    return Verdict(
        Code.NO_OVERLAP,
        message,
        "Take photographs that share at least half of their picture with the next one.",
        tuple(names),
    )
