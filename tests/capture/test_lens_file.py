"""Calibrations of other programs become a lens; what is none of them is one sentence that names the file."""

import pytest

from splatnode.capture.frame import Intrinsics
from splatnode.capture.lenses import UnusableLens, read_lens, read_lenses

KALIBR = """cam0:
  cam_overlaps: []
  camera_model: {projection}
  distortion_coeffs: [-0.01, 0.02, -0.003, 0.0004]
  distortion_model: {bending}
  intrinsics: [461.6, 460.3, 362.7, 248.1]
  resolution: [752, 480]
  rostopic: /cam0/image_raw
"""
COLMAP = "# Camera list\n# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n# Number of cameras: 1\n"
OWN = "{width: 640, height: 480, fx: 500, fy: 501, cx: 320.5, cy: 240.5"


def lens_in(tmp_path, text: str) -> Intrinsics:
    path = tmp_path / "lens"
    path.write_text(text)
    return read_lens(path)


@pytest.mark.parametrize(
    ("line", "focal", "distortion", "model"),
    [
        ("SIMPLE_PINHOLE 640 480 500 320 240", (500, 500), (), "opencv"),
        ("PINHOLE 640 480 500 501 320 240", (500, 501), (), "opencv"),
        ("SIMPLE_RADIAL 640 480 500 320 240 -0.1", (500, 500), (-0.1,), "opencv"),
        ("RADIAL 640 480 500 320 240 -0.1 0.02", (500, 500), (-0.1, 0.02, 0, 0), "opencv"),
        ("OPENCV 640 480 500 501 320 240 .1 .2 .3 .4", (500, 501), (0.1, 0.2, 0.3, 0.4), "opencv"),
        ("FULL_OPENCV 640 480 500 501 320 240 1 2 3 4 5 6 7 8", (500, 501), (1, 2, 3, 4, 5, 6, 7, 8), "opencv"),
        ("OPENCV_FISHEYE 640 480 300 301 320 240 .1 .2 .3 .4", (300, 301), (0.1, 0.2, 0.3, 0.4), "fisheye"),
        ("SIMPLE_RADIAL_FISHEYE 640 480 300 320 240 .1", (300, 300), (0.1,), "fisheye"),
        ("RADIAL_FISHEYE 640 480 300 320 240 .1 .2", (300, 300), (0.1, 0.2), "fisheye"),
    ],
    ids=lambda value: value.split()[0] if isinstance(value, str) and " " in value else None,
)
def test_of_colmap(tmp_path, line, focal, distortion, model):
    expected = Intrinsics(640, 480, *focal, 320, 240, "calibration", distortion, model)
    assert lens_in(tmp_path, f"{COLMAP}1 {line}\n") == expected
    assert lens_in(tmp_path, f"1 {line}\n2 {line}\n") == expected  # as COLMAP writes it, a camera a photograph


@pytest.mark.parametrize("text", [COLMAP + "1 PINHOLE 640 480 500 501 320 240\n", OWN + "}"])
def test_of_an_editor_that_marks_the_order_of_bytes(tmp_path, text):
    (tmp_path / "lens").write_text(text, encoding="utf-8-sig")
    assert read_lens(tmp_path / "lens").fy == 501


@pytest.mark.parametrize(("bending", "model"), [("radtan", "opencv"), ("equidistant", "fisheye")])
def test_of_kalibr_whose_pixels_begin_at_their_centre(tmp_path, bending, model):
    expected = (-0.01, 0.02, -0.003, 0.0004)
    found = lens_in(tmp_path, KALIBR.format(projection="pinhole", bending=bending))
    assert found == Intrinsics(752, 480, 461.6, 460.3, 363.2, 248.6, "calibration", expected, model)


def test_of_a_configuration(tmp_path):
    expected = Intrinsics(640, 480, 500, 501, 320.5, 240.5, "calibration", (0.1,), "fisheye")
    assert lens_in(tmp_path, OWN + ", distortion: [0.1], model: fisheye}") == expected
    assert lens_in(tmp_path, "intrinsics: " + OWN + ", source: given}").source == "given"


IMAGES = "# Image list\n1 1 0 0 0 0 0 0 1 left/a.jpg\n\n2 1 0 0 0 0 0 0 2 right/b.jpg\n1.0 2.0 -1\n"
TWO = "1 PINHOLE 640 480 500 500 320 240\n2 OPENCV_FISHEYE 64 48 50 50 32 24 .1 0 0 0\n"


def test_of_a_model_whose_images_say_which_camera_took_them(tmp_path):
    (tmp_path / "cameras.txt").write_text(TWO)
    (tmp_path / "images.txt").write_text(IMAGES)
    for path in (tmp_path, tmp_path / "cameras.txt"):
        assert {key: (lens.fx, lens.model) for key, lens in read_lenses(path).by_key.items()} == {
            "a.jpg": (500, "opencv"),
            "b.jpg": (50, "fisheye"),
        }
    (tmp_path / "images.txt").write_text(IMAGES.replace(" 2 right", " 3 right"))
    with pytest.raises(UnusableLens, match=r"must have all cameras of images.txt, it lacks \[3\]"):
        read_lenses(tmp_path)


def test_of_several_cameras_by_name(tmp_path):
    path = tmp_path / "lens.yaml"
    one = KALIBR.format(projection="pinhole", bending="radtan")
    path.write_text(one + one.replace("cam0:", "cam1:").replace("461.6", "300.5"))
    lenses = read_lenses(path)
    assert [lenses.by_key[lenses.find_key(name)].fx for name in ("cam0/1.png", "cam1_1.png")] == [461.6, 300.5]
    assert lenses.find_key("cam10_1.png") is None and lenses.find_key("x.png", camera="cam1") == "cam1"
    path.write_text("cameras: {'left*': " + OWN + "}, right: {intrinsics: " + OWN + "}}}")
    assert list(read_lenses(path).by_key) == ["left*", "right"]
    with pytest.raises(UnusableLens, match="of one camera here, it has left\\*, right"):
        read_lens(path)
    path.write_text("camera: {kind: v4l2, intrinsics: " + OWN + "}}")
    assert read_lens(path).fy == 501


BAD = {
    "no text": (b"\xff\xfe\x00", "is no text"),
    "nothing": (b"", "holds no keys"),
    "a list": (b"[1, 2]", "holds no keys"),
    "no YAML": (b"{a: [", "is not YAML"),
    "misspelt": ((OWN + ", distorsion: [0.1]}").encode(), "a lens has no distorsion; there are .*distortion"),
    "of nothing": (b"a: 1", "must give width, height, fx"),
    "OpenCV's": (b"%YAML:1.0\n---\ncamera_matrix: !!opencv-matrix\n", "OpenCV's own format"),
    "FOV": (b"1 FOV 640 480 500 500 320 240 0.9", "must be one of SIMPLE_PINHOLE.*got FOV"),
    "short": (b"1 OPENCV 640 480 500 500 320 240 0.9", r"OPENCV must have 8 numbers \(fx fy .*got 5"),
    "two": (
        b"1 PINHOLE 640 480 500 500 320 240\n2 PINHOLE 64 48 50 50 32 24",
        "has 2 cameras that differ, and no images",
    ),
    "words": (b"1 PINHOLE 640 480 a b c d", "must have a size in pixels and numbers"),
    "no size": (b"1 PINHOLE 640 0 500 500 320 240", "sizes and focal lengths above 0"),
    "omni": (KALIBR.format(projection="omni", bending="radtan").encode(), "camera_model pinhole .*got omni"),
    "fov": (KALIBR.format(projection="pinhole", bending="fov").encode(), "got pinhole and fov"),
    "half": (b"cam0: {camera_model: pinhole, distortion_model: radtan}", "must have resolution"),
    "stereo, of nothing": (
        b"cam0: {camera_model: pinhole}\ncam1: {camera_model: pinhole}",
        "cam0 must have resolution",
    ),
}


@pytest.mark.parametrize(("content", "said"), BAD.values(), ids=BAD)
def test_what_gives_no_lens_is_one_sentence(tmp_path, content, said):
    path = tmp_path / "lens"
    path.write_bytes(content)
    with pytest.raises(UnusableLens, match=said) as refused:
        read_lens(path)
    assert str(path) in str(refused.value) and "\n" not in str(refused.value)


def test_a_file_that_is_not_there(tmp_path):
    with pytest.raises(UnusableLens, match="No such file.*give a file"):
        read_lens(tmp_path / "lens.yaml")
