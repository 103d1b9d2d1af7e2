"""The check that comes before all others: was everything computed that the verdict rests on?

A comparison with NaN is false whatever it asks, and infinity lies beyond every limit on one side. Therefore no limit is
asked about such a number: poses of which something could not be computed are not published.
"""

from __future__ import annotations

from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification.checks import VerificationCase
from splatnode.recon.verification.finiteness import find_non_finite
from splatnode.recon.verification.refusals import Refusal, refuse

UNDETERMINED = Refusal(
    Code.UNDETERMINED,
    "The poses cannot be verified: these could not be computed: {missing}.",
    "Leave out the photographs named, or add photographs from further to the side between them and the others.",
)

WORDS = {  # what each field of the evidence says, for the user
    "cameras": "how certain each pose is",
    "inlier_ratio": "how many matches the poses explain",
    "weakest_link": "what connects the photographs",
    "disconnected": "which photographs belong together",
    "reflection": "whether photographs are mirrored",
    "flatness": "whether everything lies in one plane",
    "mirrored_cost": "how much worse the scene mirrored in depth fits",
    "cycles": "whether pairs of photographs agree with each other",
    "median_angle_deg": "the angle under which points are seen",
    "rms_px": "the reprojection error",
    "focal": "how certain the focal length is",
    "travel": "how far the camera moved",
    "freed": "whether the given focal length is right",
    "distortion": "whether the lens bends the picture",
}


def check_finite(case: VerificationCase) -> Verdict | None:
    """A number of the registration or of its evidence is NaN or infinite."""
    paths = list(find_non_finite(case.evidence))
    of_cameras = [case.names[int(path[1])] for path in paths if path[0] == "cameras"]
    found = [WORDS[path[0]] for path in paths]
    if any(find_non_finite(case.registration)):
        found.append("the poses themselves")
    if not found:
        return None
    frames = tuple(dict.fromkeys(of_cameras)) or case.names
    return refuse(UNDETERMINED, frames, missing="; ".join(dict.fromkeys(found)))
