"""True cameras are read as they stand, and a file that promises what is not there is named."""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import pytest

from splatnode.capture.image_file import encode_png
from splatnode.recon.evaluate.json_file import EvaluationFileError
from splatnode.recon.evaluate.records import read_bench
from splatnode.recon.evaluate.splits import load_split
from splatnode.recon.evaluate.truth import load_scene
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
    files = {"images/a.jpg": jpeg(HUGE, HUGE), **{f"sparse/0/{name}": data for name, data in MODEL.items()}}
    scene = load_scene(write(tmp_path, files))
    with pytest.raises(EvaluationFileError, match=r"a\.jpg must be an image: 50000 x 50000: more than"):
        scene.image("a.jpg")
    (tmp_path / "images" / "a.jpg").write_bytes(encode_png(np.full((2, 3, 3), (1, 2, 3), np.uint8)))
    assert scene.image("a.jpg").tolist() == [[[1, 2, 3]] * 3] * 2


@pytest.mark.parametrize("content", [b"[" * 100_000, b"[]", b'{"scene": 3}', b'{"scene": {"train3": "a"}}', b"\xff"])
def test_other_files_of_an_evaluation_are_named_too(content, tmp_path):
    (tmp_path / "scene").mkdir()
    (tmp_path / "splits.json").write_bytes(content)
    with pytest.raises(EvaluationFileError, match=r"splits\.json"):
        load_split(tmp_path / "scene", ["a", "b", "c", "d"], 2)
    with pytest.raises(EvaluationFileError, match=r"splits\.json"):
        read_bench(tmp_path / "splits.json")
