from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from splatnode.command_line import main
from splatnode.extras.calibration.board import DICTIONARIES, PAPERS, Markers, Page, marker_pages

_DOTS = 4  # a millimetre


def printed(page: Page) -> np.ndarray:
    """(H, W) grey levels of the page as a printer that works in millimetres puts it on paper."""
    paper = np.full((round(page.paper.height_mm * _DOTS), round(page.paper.width_mm * _DOTS)), 255, np.uint8)
    for mark in page.rectangles:
        top, bottom = (round(_DOTS * y) for y in (mark.y_mm, mark.y_mm + mark.height_mm))
        left, right = (round(_DOTS * x) for x in (mark.x_mm, mark.x_mm + mark.width_mm))
        paper[top:bottom, left:right] = 0
    return paper


@pytest.mark.parametrize("dictionary", ["4X4_50", "APRILTAG_36h11"])
def test_a_page_has_markers_of_the_side_that_was_asked_for(dictionary):
    (page,) = marker_pages(Markers(side_mm=80.0, first=3, count=2, dictionary=dictionary), PAPERS["a4"])
    detector = cv2.aruco.ArucoDetector(cv2.aruco.getPredefinedDictionary(DICTIONARIES[dictionary]))
    corners, numbers, _ = detector.detectMarkers(printed(page))
    assert sorted(numbers.ravel()) == [3, 4]
    for quad in corners:
        sides = np.linalg.norm(quad[0] - np.roll(quad[0], 1, 0), axis=1) / _DOTS
        np.testing.assert_allclose(sides, 80.0, atol=0.8)
    assert [text.text.split(".")[0] for text in page.texts] == [f"{dictionary}, number {n}" for n in (3, 4)]


def test_a_page_holds_what_fits_and_more_pages_the_rest():
    assert [len(page.texts) for page in marker_pages(Markers(), PAPERS["a4"])] == [2]
    assert [len(page.texts) for page in marker_pages(Markers(side_mm=40.0, count=20), PAPERS["a4"])] == [12, 8]
    with pytest.raises(ValueError, match=r"a marker of 200 mm needs .* Print a smaller one"):
        marker_pages(Markers(side_mm=200.0), PAPERS["a4"])
    for wrong, told in (
        ({"side_mm": 4.0}, "5 mm wide"),
        ({"dictionary": "x"}, "must be one of"),
        ({"first": 50}, "49"),
    ):
        with pytest.raises(ValueError, match=told):
            Markers(**wrong)


def test_the_verb_writes_a_pdf_and_says_what_to_do(tmp_path, capsys):
    assert main(["marker", str(tmp_path / "new" / "markers.pdf"), "--side", "5cm", "--count", "3"]) == 0
    told = capsys.readouterr().out
    assert "3 markers of 50 mm on 1 page." in told and "--marker 50mm" in told
    file = (tmp_path / "new" / "markers.pdf").read_bytes()
    assert file.startswith(b"%PDF-") and len(re.findall(rb"number \d", file)) == 3
    with pytest.raises(SystemExit):
        main(["marker", str(tmp_path / "m.pdf"), "--side", "50"])
    assert "a length must have its unit, as 100mm" in capsys.readouterr().err
    assert main(["marker", str(tmp_path / "m.pdf"), "--side", "1m"]) == 2
    assert not (tmp_path / "m.pdf").exists()
