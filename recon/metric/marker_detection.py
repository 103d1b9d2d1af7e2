"""Printed markers in photographs: which, and where their corners are."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.calibration.board import DICTIONARIES
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.lenses.undistort import undistort_frame
from splatnode.recon.metric.marker_fit import Corners, refine_corners

_LEAST_SIDE_PX = 12.0  # of a marker: two pixels a bit
_LEAST_CORRELATION = 0.9  # of a marker with its picture: what looks like one by chance has less


@dataclass(frozen=True, eq=False)
class MarkerDetection:
    """A marker in a photograph. Pixels are those of the photograph without its lens' distortion."""

    photograph: str
    width: int
    height: int
    marker: int  # its number
    corners: Corners


def detect_markers(frames: Iterable[Frame | DroppedFrame], dictionary: str) -> list[MarkerDetection]:
    """Every marker of the dictionary in every frame; a number that a frame shows twice is none of it.

    Raises ValueError where the intrinsics of a frame cannot be used.
    """
    definition = cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary])
    detector = cv2.aruco.ArucoDetector(definition)
    found = list[MarkerDetection]()
    for frame in frames:
        if isinstance(frame, Frame):
            found += _detect_in_frame(undistort_frame(frame), detector, definition)
    return found


def _detect_in_frame(
    frame: Frame, detector: cv2.aruco.ArucoDetector, definition: cv2.aruco.Dictionary
) -> list[MarkerDetection]:
    grey = np.asarray(cv2.cvtColor(frame.image, cv2.COLOR_RGB2GRAY), np.uint8)
    found = [
        MarkerDetection(frame.name, frame.width, frame.height, marker, corners)
        for marker, start in _detect_quads(grey, detector)
        if (corners := refine_corners(grey.astype(np.float32), _render_bits(definition, marker), start)) is not None
        and corners.correlation >= _LEAST_CORRELATION
    ]
    times = Counter(each.marker for each in found)
    return [each for each in found if times[each.marker] == 1]


def _detect_quads(
    grey: npt.NDArray[np.uint8], detector: cv2.aruco.ArucoDetector
) -> Iterator[tuple[int, npt.NDArray[np.float64]]]:
    """The number and the corners (4, 2) of each marker, to about a pixel."""
    parameters = cv2.aruco.DetectorParameters()
    parameters.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    parameters.minMarkerPerimeterRate = min(0.03, 4.0 * _LEAST_SIDE_PX / max(grey.shape))
    detector.setDetectorParameters(parameters)
    quads, numbers, _ = detector.detectMarkers(grey)
    for quad, number in zip(quads, () if numbers is None else numbers.ravel(), strict=True):
        yield int(number), np.asarray(quad, np.float64).reshape(4, 2) + 0.5


def _render_bits(definition: cv2.aruco.Dictionary, marker: int) -> npt.NDArray[np.bool_]:
    """(B, B) True where the marker is white, its black border included."""
    picture = cv2.aruco.generateImageMarker(definition, marker, definition.markerSize + 2)
    return np.asarray(picture) > 0
