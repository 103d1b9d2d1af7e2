"""OpenCV's dictionaries of printed markers, which boards, markers and their detection share."""

from __future__ import annotations

import cv2

DICTIONARIES = {
    name.removeprefix("DICT_"): getattr(cv2.aruco, name)
    for name in sorted(dir(cv2.aruco))
    if name.startswith(("DICT_4X4", "DICT_5X5", "DICT_6X6", "DICT_7X7", "DICT_APRILTAG_36h11"))
}  # by the name that people write, such as 5X5_100
