"""Verification: what speaks for and against a registration, before anything is published.

The table of refusals: a code, one sentence that says what was found, and what to do about it.

`refuse` fills an entry in. An entry that only one check needs may stand beside that check instead of here.
"""

from __future__ import annotations

import string
from collections.abc import Sequence
from dataclasses import dataclass

import msgspec

from splatnode.capture.process.config import Internal
from splatnode.recon.result.verdict import Code, Verdict


class DecisionConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The limits of the verdict. Those without a measurement behind them say so."""

    # Before registration: frames and their pairs.
    min_cameras: Internal[int] = 2  # fewest cameras of a scene
    min_features: Internal[int] = 150  # fewest features of a frame that has enough texture
    # Median motion of a pair's matches below which the camera stood still, pixels at REFERENCE_SIDE
    static_px: Internal[float] = 1.0
    turned_share: Internal[float] = 0.8  # share of the pairs without parallax, from which on the camera has only turned
    # Of log focal, between a given one and the pairs' vote: so much explains why nothing could be placed
    voted_change: Internal[float] = 0.15

    # After registration: limits that decide by themselves.

    # That must hold two parts together; mirror images share 3, the loosest right answer 62
    min_link_points: Internal[int] = 20
    # Fewest points of a camera that two others see, too; 13 of 876 right answers have fewer, and 18 of 97 wrong ones
    min_confirmed: Internal[int] = 15
    # How small the plane may be in which all lies that a camera shares (measure_flat_patch); of 1429 registrations nine
    # have more, of which seven are wrong, and right answers have .42 at most
    max_flat_patch: Internal[float] = 0.6
    # Share of the matches that must agree with a camera that has a lens of its own; of 236 right answers 13 have less
    min_own_lens_ratio: Internal[float] = 0.85
    # Share of its picture that the matches of a camera beside two others or more must fill, where many contradict it
    small_part: Internal[float] = 0.1
    # Share of such a camera's matches that must agree; the two published ones that had less were 12 and 18 degrees off
    min_small_part_ratio: Internal[float] = 0.82
    # Gain of a group of frames when mirrored; right answers reach 0.25, mirrored frames 1
    max_reflection: Internal[float] = 0.4
    # Least cost of the scene mirrored in depth over its own; of 1175 registrations one was below 1.3, and wrong
    min_mirrored_cost: Internal[float] = 1.1
    # A flat thing that moves: facades, and meadows from afar, have 98 % of their points on one plane; a bare facade's
    # poses explain 85 % of its matches, those of a flat thing that moves 81 %.

    # Share of the points on one plane from which on it may be a flat thing that moves
    moving_flatness: Internal[float] = 0.99
    moving_inlier_ratio: Internal[float] = 0.845  # share of such a scene's matches that its poses must explain
    # Share of two cameras' points that shifted in a few pieces, where each pair has as much; pairs of photographs have
    # .26 at most, montages .79 at least
    max_shifted_share: Internal[float] = 0.6
    # Bounds beyond which nothing is known that a robot could use, and a scene is refused.
    max_rotation_deg: Internal[float] = 10.0  # largest 95 % bound of a camera's rotation
    # Largest 95 % bound of a camera's position, of the distance to the scene
    max_centre_percent: Internal[float] = 15.0
    max_travel_percent: Internal[float] = 50.0  # the same, of how far the camera moved: beyond, its depth is a guess
    # Bounds within which a scene is exact, which are those of a right answer; beyond, it is rough and says so.
    exact_rotation_deg: Internal[float] = 2.0  # largest bound of a camera's rotation for the verdict OK
    # Largest bound of a camera's position for it, of how far the camera moved
    exact_travel_percent: Internal[float] = 5.0
    # Largest bound of the focal length for it, by which the distance is uncertain, too
    exact_focal_percent: Internal[float] = 10.0
    # Largest bound of a position that the user accepts, of the distance to the scene; None: any
    max_position_error_percent: float | None = None
    # Least log-odds that published poses are right. A wrong registration weighs four right ones when they are fitted:
    # 0 is right four times as often as wrong, this 2.7 times
    min_log_odds: Internal[float] = -0.4

    # Given lenses: doubted when freeing them lowers the cost to `focal_gain` and changes them by more than this.

    # Largest cost with the lens free, over that with it held, which casts doubt on it
    focal_gain: Internal[float] = 0.8
    focal_change: Internal[float] = 0.04  # least change of log focal that does so, for a calibrated lens
    nominal_change: Internal[float] = 0.15  # least change of log focal for a nominal lens, as from EXIF
    held_back: Internal[float] = 0.03  # and by how much its prior held log focal back
    # Least shift of a picture's corner by further distortion, relative to its distance from the middle
    corner_shift: Internal[float] = 0.03
    # The same where the cost falls so far; of 1100 right answers the lowest ratio is .72
    sure_gain: Internal[float] = 0.6
    sure_corner_shift: Internal[float] = 0.01  # least shift of a corner then
    # Least cost with a lens for each image, over that with the lenses that were found
    least_own_lens_cost: Internal[float] = 0.4

    # What explains poses that are unlikely.
    blurred_px: Internal[float] = 5.0  # width of edges, at 640 pixels, that explains why frames do not fit
    # Share of all matches that a pure rotation explains; chosen, not measured
    explained_by_turning: Internal[float] = 0.6
    explained_by_plane: Internal[float] = 0.85  # share of all matches that one plane explains; chosen, not measured
    exposure_ratio: Internal[float] = 1.6  # of the brightest to the darkest exposure, from which on the report notes it


# The table of refusals: a code, one sentence that says what was found, and what to do about it.


@dataclass(frozen=True)
class Refusal:
    """One entry: `message` and `advice` are templates of `str.format`, whose fields the caller of `refuse` names.

    `{count:shows|show}` is the first word where `count` is 1, else the second.
    """

    code: Code
    message: str
    advice: str


class _Grammar(string.Formatter):
    """The templates of refusals are filled in by it."""

    def format_field(self, value: object, format_spec: str) -> str:
        singular, either, plural = format_spec.partition("|")
        return (singular if value == 1 else plural) if either else super().format_field(value, format_spec)


_GRAMMAR = _Grammar()


def refuse(refusal: Refusal, frames: Sequence[str], **values: object) -> Verdict:
    """The verdict that there is no scene, about the frames of these names. Raises KeyError for a field left open."""
    message, advice = (_GRAMMAR.format(text, **values) for text in (refusal.message, refusal.advice))
    return Verdict(refusal.code, message, advice, tuple(frames))


_STEADIER = "Hold the camera still for each photograph, or give it more light."
_CALIBRATION = "Check the calibration and the image size that it belongs to, or leave it out: it is estimated then."

TOO_FEW = Refusal(
    Code.TOO_FEW_VIEWS,
    "{usable}: at least {least} are needed{left_out}.",
    "Take more photographs of the same place, each from a step further to the side.",
)
ONLY_COPIES = Refusal(
    Code.STATIC_CAMERA,
    "The camera did not move: the photographs that overlap are copies of each other.",
    "Step to the side between photographs, about a tenth of the distance to the scene.",
)
ALL_BLURRED = Refusal(
    Code.BLUR,
    "{count} {count:photograph is|photographs are} too blurred to work with ({first}: {reason}).",
    _STEADIER,
)
BLURRED = Refusal(
    Code.BLUR,
    "The photographs do not fit together: their edges are up to {width_px:.0f} pixels wide.",
    _STEADIER,
)
WITHOUT_TEXTURE = Refusal(
    Code.LOW_TEXTURE,
    "{plain} of {count} photographs {plain:shows|show} too little texture to be matched.",
    "Let more structured things into the picture, or step back.",
)
NO_OVERLAP = Refusal(
    Code.NO_OVERLAP,
    "{found}",
    "Take photographs that share at least half of their picture with the next one.",
)
NO_PARALLAX = Refusal(
    Code.NO_PARALLAX,
    "The camera only turned, or moved along a flat wall: {found}.",
    "Step at least 20 cm to the side between photographs instead of turning on the spot, and let things at several "
    "distances into the picture.",
)
PLANAR = Refusal(
    Code.PLANAR_ONLY,
    "Everything that the photographs have in common lies in one plane: focal length and motion stay open.",
    "Let things at other distances into the picture, or give the camera's calibration.",
)
WRONG_FOCAL = Refusal(
    Code.FOCAL_SUSPECT,
    "The given focal length of {given:.0f} pixels contradicts the photographs: they ask for {found:.0f}, "
    "{change:+.0f} %.",
    _CALIBRATION,
)
WRONG_EXIF = Refusal(
    Code.FOCAL_SUSPECT,
    "The focal length that EXIF tells, {given:.0f} pixels, contradicts the photographs: they ask for {found:.0f}, "
    "{change:+.0f} %.",
    "Give the photographs as the camera stored them, neither cropped nor zoomed afterwards, or the lens by "
    "--intrinsics.",
)
WRONG_LENS = Refusal(
    Code.FOCAL_SUSPECT,
    "{refuted} of {count} photographs {refuted:contradicts|contradict} the lens that was given for them: they ask for "
    "other focal lengths, in the median {change:+.0f} %.",
    _CALIBRATION,
)
WRONG_FOCAL_BY_VOTE = Refusal(
    Code.FOCAL_SUSPECT,
    "With the given focal length of {given:.0f} pixels the photographs find no place; pairs of them ask for about "
    "{voted:.0f}, {change:+.0f} %.",
    _CALIBRATION,
)
DISTORTED = Refusal(
    Code.FOCAL_SUSPECT,
    "The lens bends the picture: its corners are {further:.0f} % further off than a straight lens puts them.",
    "Calibrate the camera and give the distortion coefficients, or remove the distortion before.",
)
UNKNOWN_FOCAL = Refusal(
    Code.FOCAL_SUSPECT,
    "The focal length is not known, which leaves the positions open to {centre:.0f} % of the distance to the scene and "
    "the directions to {rotation:.0f} degrees.",
    "Give the camera's calibration, or add photographs that look at the scene from other directions. Keep zoom and "
    "focus as they are and do not crop.",
)
UNCERTAIN_FOCAL = Refusal(
    Code.FOCAL_SUSPECT,
    "The focal length is known to {focal:.0f} % only, which leaves the positions open to {centre:.0f} % of the "
    "distance to the scene and the directions to {rotation:.0f} degrees.",
    UNKNOWN_FOCAL.advice,
)
MIXED_CAMERAS = Refusal(
    Code.MIXED_CAMERAS,
    "{others} of {count} photographs {others:has|have} a size of {others:its|their} own, and {others:its|their} lens "
    "cannot be told.",
    "Leave them out, give their calibration, or take all photographs with one camera, uncropped.",
)
APART = Refusal(
    Code.SPLIT,
    "{count} {count:photograph|photographs} may show another place: almost nothing that can be confirmed joins "
    "{count:it|them} to the others.",
    "Add photographs that connect the places, or take them one after the other.",
)
CONTRADICTING = Refusal(
    Code.AMBIGUOUS,
    "The photographs contradict each other: only {inliers:.0f} % of their matches fit together.",
    "Add photographs between those named; look out for repeated or mirrored structures and moving things.",
)
CONTRADICTED = Refusal(
    Code.AMBIGUOUS,
    "{name} contradicts the others: only {inliers:.0f} % of its matches fit with them.",
    "Leave it out, or add a photograph beside it; look out for repeated or mirrored structures and moving things.",
)
DISAGREEING = Refusal(
    Code.AMBIGUOUS,
    "Pairs of photographs disagree by {degrees:.0f} degrees, in the median, with the poses of all of them about the "
    "direction in which the camera moved.",
    "Add photographs from further to the side; if the lens bends lines, calibrate the camera.",
)
NO_COMMON_LENS = Refusal(
    Code.AMBIGUOUS,
    "{own} of {count} photographs {own:does|do} not have the lens that all were taken to share, as after a zoom, a "
    "crop or a change of focus, and with a lens for each the poses stay in doubt.",
    "Keep zoom and focus as they are and do not crop, or give the lens of each photograph by --intrinsics.",
)
UNFIT_LENS = Refusal(
    Code.AMBIGUOUS,
    "{name} does not have the lens that it was taken for, and with another only {inliers:.0f} % of its matches fit.",
    "Keep zoom and focus as they are and do not crop, or give the lens of {name} by --intrinsics.",
)
PAIR_OF_LENSES = Refusal(
    Code.FOCAL_SUSPECT,
    "Two photographs through different unknown lenses fit wrong focal lengths as well as right ones.",
    "Add a third photograph, or give the lens of one by --intrinsics.",
)
UNFIT_LENSES = Refusal(
    Code.AMBIGUOUS,
    "The photographs do not fit the lenses that were found for them: with a lens of its own for each, errors fall by "
    "{percent:.0f} %, but nothing tells which lenses are right.",
    NO_COMMON_LENS.advice,
)
SHEARED = Refusal(
    Code.AMBIGUOUS,
    "{name} is sheared by at least {percent:.1f} % beside the others, as by a rolling shutter while the camera turns.",
    "Leave it out, or take it again with the camera at rest.",
)
WEAKLY_JOINED = Refusal(
    Code.AMBIGUOUS,
    "The photographs fall into two parts that only {points} points join, and {inliers:.0f} % of the matches between "
    "them fit. The smaller part has {count} of them.",
    "Add photographs between the two parts, and beside the one named.",
)
SMALL_PART = Refusal(
    Code.AMBIGUOUS,
    "What {name} shares with the others fills only {percent:.0f} % of its picture: too little to tell where it stands.",
    "Add a photograph between {name} and its neighbours.",
)
MOVING = Refusal(
    Code.MOVING_SCENE,
    "One flat thing fits, and the rest does not fit with it ({inliers:.0f} % of the matches): it may have moved.",
    "Wait until nothing moves in the picture, or keep what moves out of it.",
)
MONTAGE = Refusal(
    Code.MOVING_SCENE,
    "{percent:.0f} % of what any two photographs share is in at most {pieces} pieces that only shifted, without any "
    "change of perspective, as in montages, collages and on screens with windows.",
    "Give the photographs as the camera took them; where it moved along flat walls, add one from nearer.",
)
FLAT_PATCH = Refusal(
    Code.MOVING_SCENE,
    "What {name} shares with the others is one flat thing that fills {percent:.0f} % of its picture: it may hang or "
    "stand elsewhere, as posters, screens and vehicles do.",
    "Keep it out of the picture, or let more of what stands still into {name}.",
)
INSET = Refusal(
    Code.MOVING_SCENE,
    "What {name} shares with the others fills {percent:.0f} % of its picture, through an unusual lens of its own: it "
    "may be a picture in its picture, as on a poster or a screen.",
    "Leave it out, or take it again nearer to what the others show.",
)
MIRRORED_IN_DEPTH = Refusal(
    Code.AMBIGUOUS,
    "The photographs can be read in two ways, one the mirror image of the other in depth.",
    "Go nearer, or photograph from further to the side.",
)
MIRRORED_PHOTOGRAPHS = Refusal(
    Code.AMBIGUOUS,
    "{count} {count:photograph shows|photographs show} the place the wrong way round: turned left to right, "
    "{count:it matches|they match} the others better.",
    "Leave out photographs that were mirrored, or turn them back.",
)
TOO_CLOSE = Refusal(
    Code.BASELINE_TOO_SMALL,
    "Points are seen under {angle:.1f} degrees only: positions are uncertain by {travel:.0f} % of how far the camera "
    "moved, directions by {rotation:.1f} degrees.",
    "Move further to the side between photographs: about a tenth of the distance to the scene.",
)
FEW_SHARED_POINTS = Refusal(
    Code.NO_OVERLAP,
    "{name} shares only {points} points with two others at once: its position is open to {centre:.0f} % of the "
    "distance to the scene, its direction to {rotation:.0f} degrees.",
    "Add a photograph between {name} and {partner}.",
)
UNCONFIRMED = Refusal(
    Code.NO_OVERLAP,
    "Only {points} points of {name} are seen by two others at once: nothing confirms its position.",
    "Add a photograph between {name} and the one nearest to it.",
)
SCATTERED = Refusal(
    Code.AMBIGUOUS,
    "Parts of the photographs disagree about {name}: its position is open to {centre:.0f} % of the distance to the "
    "scene, its direction to {rotation:.0f} degrees.",
    "Add a photograph beside {name}, and keep out of the picture what moves, shines or repeats.",
)
ROUGHER = Refusal(
    Code.TOO_ROUGH,
    "Positions are known to {found:.2g} % of the distance to the scene; {needed:g} % were required.",
    "Add photographs between those that are there, give the camera's calibration, or require less.",
)
DIVERGED = Refusal(  # the losses over the photographs that the scene began with and that it ended with
    Code.DIVERGED,
    "The refinement ruined the scene: it misses the photographs by {after:.2g}, and began with {before:.2g}.",
    "Take smaller steps (optimize.lr), or a preset as it is.",
)
