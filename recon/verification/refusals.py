"""The refusals, in words: each says what was found, and what to do about it."""

from __future__ import annotations

from collections.abc import Sequence

from splatnode.recon.frames.screening import Rejected
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification.lens import FreedLens

Names = Sequence[str]

_NEARER = "Take photographs that share at least half of their picture with the next one."
_APART = "Add photographs that connect the places, or take them one after the other."
_SIDEWAYS = "Move further to the side between photographs: about a tenth of the distance to the scene."


def too_few(names: Names, least: int, rejected: Sequence[Rejected]) -> Verdict:
    left_out = f"; {len(rejected)} more were left out ({rejected[0].name}: {rejected[0].reason})" if rejected else ""
    return Verdict(
        Code.TOO_FEW_VIEWS,
        f"{len(names)} usable frame{'s' if len(names) != 1 else ''}: at least {least} are needed{left_out}.",
        "Take more photographs of the same place, each from a step further to the side.",
        tuple(names),
    )


def only_copies(names: Names) -> Verdict:
    return Verdict(
        Code.STATIC_CAMERA,
        "The camera did not move: the frames that overlap are copies of each other.",
        "Step to the side between photographs, about a tenth of the distance to the scene.",
        tuple(names),
    )


def all_blurred(names: Names, reason: str) -> Verdict:
    return Verdict(
        Code.BLUR,
        f"{len(names)} frames are too blurred to work with ({names[0]}: {reason}).",
        "Hold the camera still for each photograph, or give it more light.",
        tuple(names),
    )


def without_texture(names: Names, count: int) -> Verdict:
    return Verdict(
        Code.LOW_TEXTURE,
        f"{len(names)} of {count} frames show too little texture to be matched.",
        "Let more structured things into the picture, or step back.",
        tuple(names),
    )


def no_overlap(names: Names, found: str) -> Verdict:
    return Verdict(Code.NO_OVERLAP, found, _NEARER, tuple(names))


def no_parallax(names: Names, found: str) -> Verdict:
    return Verdict(
        Code.NO_PARALLAX,
        f"The camera only turned: {found}.",
        "Step at least 20 cm to the side between photographs instead of turning on the spot.",
        tuple(names),
    )


def planar(names: Names) -> Verdict:
    return Verdict(
        Code.PLANAR_ONLY,
        "Everything that the frames have in common lies in one plane: focal length and motion stay open.",
        "Let things at other distances into the picture, or give the camera's calibration.",
        tuple(names),
    )


def blurred(names: Names, width_px: float) -> Verdict:
    return Verdict(
        Code.BLUR,
        f"The frames do not fit together: their edges are up to {width_px:.0f} pixels wide.",
        "Hold the camera still for each photograph, or give it more light.",
        tuple(names),
    )


def wrong_focal(names: Names, lenses: Sequence[FreedLens]) -> Verdict:
    worst = max(lenses, key=lambda lens: abs(lens.found / lens.given - 1.0))
    return Verdict(
        Code.FOCAL_SUSPECT,
        f"The given focal length of {worst.given:.0f} pixels contradicts the frames: they ask for {worst.found:.0f}, "
        f"{100 * (worst.found / worst.given - 1.0):+.0f} %.",
        "Check the calibration and the image size that it belongs to, or leave it out: it is estimated then.",
        tuple(names),
    )


def wrong_given_focal(names: Names, given: float, voted: float) -> Verdict:
    return Verdict(
        Code.FOCAL_SUSPECT,
        f"With the given focal length of {given:.0f} pixels the frames find no place; pairs of them ask for about "
        f"{voted:.0f}, {100 * (voted / given - 1.0):+.0f} %.",
        "Check the calibration and the image size that it belongs to, or leave it out: it is estimated then.",
        tuple(names),
    )


def distorted(names: Names, corner_shift: float) -> Verdict:
    return Verdict(
        Code.FOCAL_SUSPECT,
        f"The lens bends the picture: its corners are {100 * corner_shift:.0f} % further off than a straight lens puts "
        "them.",
        "Calibrate the camera and give the distortion coefficients, or remove the distortion before.",
        tuple(names),
    )


def uncertain_focal(names: Names, sigma: float) -> Verdict:
    return Verdict(
        Code.FOCAL_SUSPECT,
        f"The focal length is uncertain by {100 * sigma:.0f} %.",
        "Give the camera's calibration, or photograph from further to the side instead of only forwards.",
        tuple(names),
    )


def mixed_cameras(names: Names, count: int) -> Verdict:
    return Verdict(
        Code.MIXED_CAMERAS,
        f"{len(names)} of {count} frames have another size than most, and their lens cannot be told.",
        "Leave them out, give their calibration, or take all photographs with one camera, uncropped.",
        tuple(names),
    )


def apart(names: Names) -> Verdict:
    return Verdict(
        Code.SPLIT,
        f"{len(names)} frames may show another place: almost nothing that can be confirmed joins them to the others.",
        _APART,
        tuple(names),
    )


def contradicting(names: Names, agreement: float) -> Verdict:
    return Verdict(
        Code.AMBIGUOUS,
        f"The frames contradict each other: only {100 * agreement:.0f} % of their matches fit together.",
        "Add photographs between those named; look out for repeated or mirrored structures and moving things.",
        tuple(names),
    )


def unconfirmed(names: Names) -> Verdict:
    return Verdict(
        Code.AMBIGUOUS,
        f"{len(names)} frames could stand elsewhere: too little of them is confirmed by two others.",
        "Add photographs between those named and their neighbours.",
        tuple(names),
    )


def moving(names: Names, agreement: float) -> Verdict:
    return Verdict(
        Code.MOVING_SCENE,
        f"One flat thing fits, and the rest does not fit with it ({100 * agreement:.0f} % of the matches): it may have "
        "moved.",
        "Wait until nothing moves in the picture, or keep what moves out of it.",
        tuple(names),
    )


def mirrored(names: Names) -> Verdict:
    return Verdict(
        Code.AMBIGUOUS,
        "The frames can be read in two ways, one the mirror image of the other in depth.",
        "Go nearer, or photograph from further to the side.",
        tuple(names),
    )


def reflected(names: Names) -> Verdict:
    return Verdict(
        Code.AMBIGUOUS,
        f"{len(names)} frames show the place the wrong way round: turned left to right, they match the others better.",
        "Leave out photographs that were mirrored, or turn them back.",
        tuple(names),
    )


def too_close(names: Names, found: str) -> Verdict:
    return Verdict(Code.BASELINE_TOO_SMALL, found, _SIDEWAYS, tuple(names))


def diverged(names: Names, before: float, after: float) -> Verdict:
    """`before` and `after` are the losses over the photographs that the scene began with and that it ended with."""
    return Verdict(
        Code.DIVERGED,
        f"The refinement ruined the scene: it misses the photographs by {after:.2g}, and began with {before:.2g}.",
        "Take smaller steps (optimize.rates), or a preset as it is.",
        tuple(names),
    )
