"""True cameras are read as they stand, and a file that promises what is not there is named."""

from __future__ import annotations

import struct
import tempfile
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode.capture.image_file import encode_png
from splatnode.extras.evaluate.dataset import EvaluationFileError, EvaluationScene, TrueCamera, load_scene, load_split
from splatnode.extras.evaluate.report import read_bench
from tests.support.crafted import Crafted
from tests.support.crafted.bounded import MARGIN, readings
from tests.support.crafted.images import HUGE, jpeg
from tests.support.crafted.truth_files import MODEL, TEXT_MODEL


def write(folder: Path, files: dict[str, bytes]) -> Path:
    for name, data in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(data)
    return folder


def read(file: Crafted) -> str:
    """For the process that reads the corpus."""
    with tempfile.TemporaryDirectory() as folder:
        _, _, name = file.name.partition("/")
        model = TEXT_MODEL if name.endswith(".txt") else MODEL if name.endswith(".bin") else {}
        files = {"images/a.jpg": b"", **{f"sparse/0/{part}": data for part, data in model.items()}, name: file.data}
        return str(load_scene(write(Path(folder), files)).cameras)


def test_every_crafted_truth_is_refused_by_name_in_little_memory():
    for reading in readings("tests.support.crafted:truth_files", f"{__name__}:read"):
        named = Path(reading.name).name if reading.name.endswith(".json") else "sparse/0"
        assert reading.outcome.startswith(("EvaluationFileError: ", "SceneFileError: ")), reading
        assert named in reading.outcome and len(reading.outcome) < 2000, reading
        assert reading.taken < 100_000_000 + MARGIN, reading


@pytest.mark.parametrize("model", [MODEL, TEXT_MODEL])
def test_a_model_is_read_as_pycolmap_reads_it(model, tmp_path):
    pycolmap = pytest.importorskip("pycolmap")
    rest = {"points3D.bin": bytes(8)} if model is MODEL else {"points3D.txt": b""}
    write(tmp_path, {"images/a.jpg": b"", **{f"sparse/0/{name}": data for name, data in (model | rest).items()}})
    camera = load_scene(tmp_path).cameras["a.jpg"]
    theirs = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    np.testing.assert_array_equal(camera.K, theirs.cameras[1].calibration_matrix())
    np.testing.assert_array_equal(np.linalg.inv(camera.T_world_camera)[:3], theirs.images[1].cam_from_world().matrix())
    assert (camera.width, camera.height) == (100, 80)


def test_a_photograph_that_is_none_is_named(tmp_path):
    files = {"images/a.jpg": jpeg(HUGE, HUGE * 4 // 5), **{f"sparse/0/{name}": data for name, data in MODEL.items()}}
    scene = load_scene(write(tmp_path, files))
    with pytest.raises(EvaluationFileError, match=r"a\.jpg must be an image: 50000 x 40000: more than"):
        scene.image("a.jpg")
    (tmp_path / "images" / "a.jpg").write_bytes(encode_png(np.full((2, 3, 3), (1, 2, 3), np.uint8)))
    assert scene.image("a.jpg").tolist() == [[[1, 2, 3]] * 3] * 2


def turned(image: np.ndarray, orientation: int) -> bytes:
    """A JPEG with an EXIF orientation."""
    tiff = b"II*\0" + struct.pack("<IHHHIII", 8, 1, 274, 3, 1, orientation, 0)
    part = b"Exif\0\0" + tiff
    data = cv2.imencode(".jpg", image)[1].tobytes()
    return data[:2] + b"\xff\xe1" + struct.pack(">H", len(part) + 2) + part + data[2:]


@pytest.mark.parametrize("orientation", [1, 3, 6])
def test_a_photograph_that_its_true_camera_did_not_take_is_refused(orientation, tmp_path):
    model = {f"sparse/0/{name}": data for name, data in MODEL.items()}  # 100 x 80
    photograph = turned(np.zeros((80, 100, 3), np.uint8), orientation)
    folder = write(tmp_path, {"images/a.jpg": photograph, **model})
    if orientation != 6:
        assert load_scene(folder).image("a.jpg").shape == (80, 100, 3)
        return
    said = r"a\.jpg: declared 100 x 80, the photograph is 80 x 100 \(after its EXIF orientation\)"
    with pytest.raises(EvaluationFileError, match=said):
        load_scene(folder)
    camera = TrueCamera(np.eye(4), np.eye(3), 100, 80)
    with pytest.raises(EvaluationFileError, match=said):  # as of a file of which only decoding tells the size
        EvaluationScene("a", {"a.jpg": folder / "images" / "a.jpg"}, {"a.jpg": camera}).image("a.jpg")


def test_a_photograph_may_be_resized_and_its_sides_rounded():
    for width, height in ((100, 80), (50, 40), (3, 2), (33, 26), (33, 27), (1000, 800), (1004, 800), (1000, 790)):
        assert not TrueCamera(np.eye(4), np.eye(3), 100, 80).size_problem(width, height)
    for width, height in ((80, 100), (3, 4), (100, 78), (1000, 780), (33, 33)):
        assert TrueCamera(np.eye(4), np.eye(3), 100, 80).size_problem(width, height)
    assert not TrueCamera(np.eye(4), np.eye(3), 5187, 3361).size_problem(648, 420)


@pytest.mark.parametrize("content", [b"[" * 100_000, b"[]", b'{"scene": 3}', b'{"scene": {"train3": "a"}}', b"\xff"])
def test_other_files_of_an_evaluation_are_named_too(content, tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "splits.json").write_bytes(content)
    with pytest.raises(EvaluationFileError, match=r"splits\.json"):
        load_split(tmp_path / "scene", ["a", "b", "c", "d"], 2)
    with pytest.raises(EvaluationFileError, match=r"splits\.json"):
        read_bench(tmp_path / "splits.json")
