"""What cameras say of the light of their photographs: how much brighter one should be than another.

Time, sensitivity and aperture tell how much light of a surface was recorded. Pixels answer with a power of it, and each
camera's own processing differs from that; so this is a hint with a wide sigma, which shared pixels overrule.
"""

from __future__ import annotations

from collections.abc import Iterable

from splatnode.recon.frames.keyframe import Keyframe

RESPONSE = 1.0 / 2.2  # exponent by which pixels answer to light, as sRGB's do


def compute_exposure_priors(keyframes: Iterable[Keyframe]) -> dict[str, float]:
    """Returns the log exposures that image metadata states, by name; only differences mean anything.

    An exposure with an f-number and one without cannot be compared: those of the kind that is rarer are left out.
    """
    told = {each.name: each.frame.exposure for each in keyframes if each.frame.exposure is not None}
    whole = {name for name, exposure in told.items() if exposure.f_number is not None}
    chosen = whole if 2 * len(whole) >= len(told) else told.keys() - whole
    return {name: RESPONSE * exposure.log_exposure for name, exposure in told.items() if name in chosen}
