import typing
from pathlib import Path

import msgspec
import pytest

from splatnode.capture.cameras import folder, synthetic
from splatnode.capture.config import CaptureConfig, camera_opener
from splatnode.capture.frame import Frame, Intrinsics
from splatnode.capture.process.config import ConfigError, build_config, load_config, merge_config, parse_changes

FOLDER = "camera: {kind: folder, folder: photos}"
SYNTHETIC = "camera: {kind: synthetic}"


def load(tmp_path, text, *changes):
    path = tmp_path / "capture.yaml"
    path.write_text(text)
    return load_config(path, CaptureConfig, changes)


def test_kind_is_a_module_and_the_rest_its_config(tmp_path):
    config = load(tmp_path, FOLDER)
    assert config.camera.kind == "folder"
    assert config.camera.module is folder
    assert config.camera.config == folder.Config(Path("photos"))
    assert load(tmp_path, SYNTHETIC + "\nquality: {max_blur_px: 5}").quality.max_blur_px == 5


def test_changes_are_laid_over_the_file(tmp_path):
    config = load(tmp_path, SYNTHETIC, "camera.views=3", "camera.fps=2e1", "quality.min_novelty=0")
    assert config.camera.config == synthetic.Config(views=3, fps=20.0)
    assert config.quality.min_novelty == 0
    other = load(tmp_path, SYNTHETIC, "camera={kind: folder, folder: x, names: [a, b]}", "camera.max-pixels=9")
    assert "seed" not in other.camera.config.__struct_fields__
    assert other.camera.config == folder.Config(Path("x"), ("a", "b"), max_pixels=9)


def test_nested_structures_are_typed(tmp_path):
    given = "{width: 640, height: 480, fx: 5e2, fy: 500, cx: 320, cy: 240, source: given, distortion: [0.1, 0]}"
    config = load(tmp_path, f"camera: {{kind: folder, folder: x, intrinsics: {given}}}")
    assert config.camera.config.intrinsics == Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0, "given", (0.1, 0.0))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", r"camera: missing"),
        ("camera: {kind: folder}", r"camera\.folder: missing"),
        ("camera: {kind: nope}", r"camera\.kind: expected one of .*folder, .*synthetic.*got 'nope'"),
        ("camera: {kind: ../folder}", r"camera\.kind: expected one of"),
        ("camera: {folder: x}", r"camera\.kind: expected one of .* got None"),
        (FOLDER.replace("folder: p", "foldr: p"), r"camera\.foldr: unknown key; allowed here: folder, names"),
        (SYNTHETIC + "\nqualty: {}", r"qualty: unknown key; allowed here: camera, quality"),
        ("camera: {kind: synthetic, views: many}", r"camera\.views: expected int, got str"),
        ("camera: {kind: synthetic, views: 0}", r"camera\.views: expected int >= 1"),
        ("camera: {kind: folder, folder: 3}", r"camera\.folder: expected path, got int"),
        ("camera: {kind: folder, folder: x, names: [a, 1]}", r"camera\.names\[1\]: expected str, got int"),
        (
            "camera: {kind: folder, folder: x, intrinsics: "
            "{width: 0, height: 1, fx: 1, fy: 1, cx: 0, cy: 0, source: given}}",
            r"camera\.intrinsics: intrinsics must be finite, sizes and focal lengths above 0",
        ),
        ("camera: {kind: folder, folder: x, intrinsics: {wdth: 1}}", r"camera\.intrinsics\.wdth: unknown key"),
        (SYNTHETIC + "\nquality: {max_blur_px: wide}", r"quality\.max_blur_px: expected float, got str"),
        ("- a", r"expected keys and values, got list"),
        ("a: [", r"is not YAML"),
    ],
)
def test_mistakes_name_the_key(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        load(tmp_path, text)


def test_a_missing_file_is_named(tmp_path):
    with pytest.raises(ConfigError, match=r"nowhere\.yaml: No such file"):
        load_config(tmp_path / "nowhere.yaml", CaptureConfig)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("camera.loops", "expected KEY=VALUE"),
        ("=5", "expected KEY=VALUE"),
        ("a.b=[", r"a\.b is not YAML"),
    ],
)
def test_changes_that_are_none(change, message):
    with pytest.raises(ConfigError, match=message):
        parse_changes([change])


def test_changes_are_yaml_values():
    assert parse_changes(["a.b-c=-5", "a.d=x=y", "e=1e-3", "f=true"]) == {
        "a": {"b_c": -5, "d": "x=y"},
        "e": 0.001,
        "f": True,
    }


def test_merging_leaves_its_arguments_alone():
    base = {"a": {"b": 1, "c": 2}, "d": 3}
    assert merge_config(base, {"a": {"b": 9}, "d": {"e": 1}}) == {"a": {"b": 9, "c": 2}, "d": {"e": 1}}
    assert base == {"a": {"b": 1, "c": 2}, "d": 3}


def test_the_types_of_fields_are_evaluated_once(monkeypatch):
    """Python evaluates annotations anew each time, which took most of the time that a configuration took."""
    raw = {"camera": {"kind": "synthetic", "views": 3}, "selection": {"backlog": 5}}
    once = build_config(raw, CaptureConfig)
    for module, name in ((typing, "get_type_hints"), (msgspec.structs, "fields")):
        monkeypatch.setattr(module, name, lambda *_, **__: pytest.fail("evaluated again"))
    assert build_config(raw, CaptureConfig) == once


def test_a_configured_camera_streams(tmp_path):
    config = load(tmp_path, SYNTHETIC, "camera={views: 1, width: 32, height: 24}")
    (frame,) = camera_opener(config.camera)()
    assert isinstance(frame, Frame) and frame.image.shape == (24, 32, 3)
