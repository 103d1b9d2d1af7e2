"""The lens of an image topic: which calibration is its camera's, and what it says in splatnode's terms."""

from __future__ import annotations

from collections.abc import Mapping

from splatnode.capture.frame import Intrinsics
from splatnode.capture.logged.message import Calibration, UnusableMessage
from splatnode.capture.process.printable import sanitize_text

_MODELS = {  # how many coefficients a model has at most, and splatnode's name of it
    "": (0, "opencv"),
    "none": (0, "opencv"),
    "plumb_bob": (5, "opencv"),
    "rational_polynomial": (8, "opencv"),
    "equidistant": (4, "fisheye"),
    "kannala_brandt": (4, "fisheye"),
    "fisheye": (4, "fisheye"),
}
_WITHOUT_DISTORTION = "rect"  # in the last part of a topic's name: its images are rectified, as ROS names them


def calibration_topic(topic: str, sensor: str, known: Mapping[str, Calibration]) -> str | None:
    """The topic of `known` that calibrates the camera of `topic`, whose pictures are of `sensor`; None where none does.

    One of another sensor is not its camera's. Of the others it is the one that lies deepest in a namespace of the
    topic, as ROS has it: /front/camera_info is that of /front/image_raw/compressed.
    """
    of_sensor = [name for name, each in known.items() if not sensor or not each.sensor or sensor == each.sensor]
    above = [name for name in of_sensor if topic.startswith(_namespace(name))]
    if above:
        return max(above, key=lambda name: (len(_namespace(name)), name))
    named = [name for name in of_sensor if sensor and known[name].sensor == sensor]
    return named[0] if len(named) == 1 else None


def lens(topic: str, found: Calibration) -> Intrinsics | None:
    """The lens of the images of `topic`; None where the camera was not calibrated.

    Raises UnusableMessage where its model is not known here, or its numbers are no lens.
    """
    if len(found.K) != 9 or not found.K[0]:
        return None
    (fx, _, cx, _, fy, cy, *_), terms, model = found.K, found.D, found.model
    if _WITHOUT_DISTORTION in topic.rpartition("image")[2] and len(found.P) == 12 and found.P[0]:
        (fx, _, cx, _, _, fy, cy, *_), terms, model = found.P, (), ""
    terms = terms if any(terms) else ()
    if terms and model not in _MODELS:
        known = ", ".join(name for name in _MODELS if name)
        raise UnusableMessage(f"a lens must be one of {known}, it is {sanitize_text(model, 40)}")
    most, kind = _MODELS.get(model, (0, "opencv"))
    if len(terms) > most:
        raise UnusableMessage(
            f"a lens of {sanitize_text(model, 40) or 'no model'} has {most} numbers, got {len(terms)}"
        )
    x, y, width, height = found.window
    size = (width, height) if width and height else (found.width, found.height)
    try:  # ROS and Foxglove: the centre of the top-left pixel is at (0, 0)
        return Intrinsics(*size, fx, fy, cx - x + 0.5, cy - y + 0.5, "calibration", tuple(terms), kind)
    except ValueError as error:
        raise UnusableMessage(str(error)) from error


def _namespace(topic: str) -> str:
    return topic[: topic.rfind("/") + 1]
