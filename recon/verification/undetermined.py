"""The check that comes before all others: was everything computed that the verdict rests on?

A comparison with NaN is false whatever it asks, and infinity lies beyond every limit on one side. Therefore no limit is
asked about such a number: poses of which something could not be computed are not published.
"""

from __future__ import annotations

from splatnode.recon.registration.register import Registration
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.recon.verification.evidence import Evidence
from splatnode.recon.verification.finiteness import not_finite

WORDS = {  # what each field of the evidence says, for the user
    "cameras": "how certain each pose is",
    "agreement": "how many matches the poses explain",
    "joint": "what connects the frames",
    "loose": "which frames belong together",
    "reflection": "whether photographs are mirrored",
    "flatness": "whether everything lies in one plane",
    "spread": "how much the poses depend on parts of the pictures",
    "mirrored_cost": "how much worse the scene mirrored in depth fits",
    "cycles": "whether pairs of frames agree with each other",
    "median_angle_deg": "the angle under which points are seen",
    "rms_px": "the reprojection error",
    "focal_sigma": "how certain the focal length is",
    "freed": "whether the given focal length is right",
    "distortion": "whether the lens bends the picture",
}


def undetermined(registration: Registration, evidence: Evidence) -> Verdict | None:
    """A refusal where a number of the registration or of its evidence is NaN or infinite, which names what it is."""
    missing = list(not_finite(evidence))
    of_cameras = [evidence.cameras[int(path[1])].name for path in missing if path[0] == "cameras"]
    found = [WORDS[path[0]] for path in missing]
    if any(not_finite(registration)):
        found.append("the poses themselves")
    if not found:
        return None
    return Verdict(
        Code.UNDETERMINED,
        f"The poses cannot be verified: these could not be computed: {'; '.join(dict.fromkeys(found))}.",
        "Leave out the frames named, or add photographs from further to the side between them and the others.",
        tuple(dict.fromkeys(of_cameras)) or tuple(camera.name for camera in evidence.cameras),
    )
