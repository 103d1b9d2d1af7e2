"""Result folders: every file with its digest, whole or not at all; a failure leaves nothing behind."""

from __future__ import annotations

import errno
import fcntl
import hashlib
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from splatnode.recon.result.export import (
    ResultWriteError,
    export_scene,
    remove_result,
    write_beside,
    write_file,
    write_files,
    write_result,
)
from splatnode.recon.result.export import staged as staged_module
from splatnode.recon.result.export.formats.ply import encode_ply
from splatnode.recon.result.export.staged import hold_result_folder
from splatnode.recon.result.report import build_report
from splatnode.recon.result.verdict import Code
from tests.support.exported import make_gaussians, make_snapshot, write


def test_result_holds_every_file_and_a_manifest_of_them(tmp_path):
    manifest_path = write(make_snapshot(), tmp_path, preview=b"PNG bytes")
    manifest = json.loads(manifest_path.read_text())
    expected = {"scene.ply", "cameras.json", "trajectory.tum", "transforms.json", "preview.png", "report.json"}
    expected |= {f"colmap/{name}.txt" for name in ("cameras", "images", "points3D")}
    assert set(manifest["files"]) == expected
    on_disk = {str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*") if path.is_file()}
    assert on_disk == expected | {"manifest.json"}
    for name, entry in manifest["files"].items():
        data = (tmp_path / name).read_bytes()
        assert entry == {"bytes": len(data), "sha256": hashlib.sha256(data).hexdigest()}
    for name in expected - {"scene.ply", "preview.png"}:
        assert "relative" in (tmp_path / name).read_text(), f"{name} must say that the scale is relative"


def test_report_tells_what_happened():
    report = json.loads(json.dumps(build_report(make_snapshot(), seed=1, preset="fast", peak_rss_mb=100.0)))
    assert report["verdict"]["code"] == "OK" and report["verdict"]["frames"] == ["0001.jpg"]
    assert report["seconds"] == {"poses": 1.5, "optimise": 2.0, "total": 3.5}
    assert report["num_gaussians"] == 50
    assert report["scene_bytes"] == len(encode_ply(make_gaussians()))
    assert report["frames_used"] == ["0000.jpg", "0002.jpg"]
    assert report["frames_dropped"] == [{"name": "0001.jpg", "reason": "blurred"}]
    axes = [[0.03, 0.0, 0.0], [0.0, 0.0, 0.01], [0.0, 0.005, 0.0]]
    bounds = {"rotation_deg": 0.1, "centre": 0.02, "centre_percent": 2.0, "focal_percent": 1.5, "axes": axes}
    assert report["bounds"] == report["cameras"][0]["bounds"] == bounds
    assert (report["seed"], report["preset"], report["peak_rss_mb"]) == (1, "fast", 100.0)
    assert report["versions"]["numpy"] == np.__version__


def test_an_image_that_the_verdict_leaves_out_is_among_the_dropped_ones():
    snapshot = make_snapshot()
    verdict = replace(snapshot.verdict, frames=("0001.jpg", "0003.jpg"))
    report = build_report(replace(snapshot, verdict=verdict), seed=1, preset="fast", peak_rss_mb=100.0)
    reason = "it has no camera in the scene, as the verdict says"
    assert report["frames_dropped"] == [
        {"name": "0001.jpg", "reason": "blurred"},
        {"name": "0003.jpg", "reason": reason},
    ]


def test_refused_scene_is_not_published_and_replaces_an_earlier_one(tmp_path):
    write(make_snapshot(), tmp_path)
    (tmp_path / "transforms.json").write_text("edited by the user")
    write(make_snapshot(Code.NO_PARALLAX, publishable=False), tmp_path)
    left = {path.name for path in tmp_path.rglob("*")}  # and no empty folder
    assert left == {"report.json", "manifest.json", "transforms.json"}  # what the user changed is the user's
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["verdict"]["code"], report["scene_bytes"]) == ("NO_PARALLAX", 0)


def test_a_result_is_removed_but_not_what_others_put_beside_it(tmp_path):
    folder = tmp_path / "result"
    write(make_snapshot(), folder)
    (folder / "notes.txt").write_text("mine")
    (folder / "cameras.json").write_text("changed by hand")
    remove_result(folder)
    assert sorted(path.name for path in folder.rglob("*")) == ["cameras.json", "notes.txt"]
    write(make_snapshot(), tmp_path / "other")
    remove_result(tmp_path / "other")
    assert not (tmp_path / "other").exists()
    remove_result(tmp_path / "nothing there")


def test_manifest_cannot_make_us_remove_a_file_elsewhere(tmp_path):
    outside = tmp_path / "precious.txt"
    outside.write_text("mine")
    folder = tmp_path / "out"
    folder.mkdir()
    digest = hashlib.sha256(b"mine").hexdigest()
    (folder / "manifest.json").write_text(json.dumps({"files": {"../precious.txt": {"sha256": digest}}}))
    write(make_snapshot(), folder)
    assert outside.read_text() == "mine"


@pytest.mark.parametrize("failing", ["scene.ply", "report.json", "manifest.json"])
def test_full_disk_leaves_the_earlier_result_and_no_temporary_file(tmp_path, monkeypatch, failing):
    write(make_snapshot(), tmp_path)
    before = {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()}
    real = staged_module._write_through

    def full(path: Path, content: bytes, *rest: object) -> None:
        if failing in path.name:
            path.write_bytes(content[: len(content) // 2])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        real(path, content, *rest)

    monkeypatch.setattr(staged_module, "_write_through", full)
    changed = replace(make_snapshot(), gaussians=make_gaussians(seed=9))
    with pytest.raises(ResultWriteError, match="Free some space") as caught:
        write(changed, tmp_path)
    assert caught.value.errno == errno.ENOSPC and isinstance(caught.value, OSError)
    assert {path: path.read_bytes() for path in tmp_path.rglob("*") if path.is_file()} == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_the_system_reporting_a_full_disk_surfaces(tmp_path, monkeypatch):
    snapshot = make_snapshot()
    report = build_report(snapshot, seed=0, preset="fast", peak_rss_mb=None)
    real_open = Path.open

    def open_full_device(path: Path, mode: str = "r", *rest, **options):
        return real_open(Path("/dev/full"), "wb") if mode == "xb" else real_open(path, mode, *rest, **options)

    monkeypatch.setattr(Path, "open", open_full_device)
    with pytest.raises(ResultWriteError) as caught:
        write_result(snapshot, tmp_path, report)
    assert caught.value.errno == errno.ENOSPC
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


def test_a_device_or_a_pipe_is_not_replaced_and_a_link_is_followed(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(ResultWriteError, match="pipe is a device or a pipe"):
        write_file(tmp_path / "pipe", b"new")
    assert (tmp_path / "pipe").is_fifo()
    (tmp_path / "link").symlink_to(tmp_path / "real")
    write_file(tmp_path / "link", b"new")
    assert (tmp_path / "link").is_symlink() and (tmp_path / "real").read_bytes() == b"new"


def test_a_result_goes_through_no_link_that_somebody_put_into_its_folder(tmp_path):
    """The folder may be a stranger's, who knows how the files of a result are called."""
    outside, elsewhere, out = tmp_path / "outside", tmp_path / "elsewhere", tmp_path / "out"
    outside.write_text("mine")
    elsewhere.mkdir()
    out.mkdir()
    (out / "a.npz").symlink_to(outside)
    (out / "b.npz").symlink_to("nothing")
    write_files(out, {"a.npz": b"new", "b.npz": b"new"})
    assert outside.read_text() == "mine" and not (out / "nothing").exists()
    assert all((out / name).read_bytes() == b"new" and not (out / name).is_symlink() for name in ("a.npz", "b.npz"))
    (out / "maps").symlink_to(elsewhere)
    for name in ("maps/a.npz", "../outside", str(outside)):
        with pytest.raises(ResultWriteError, match="remove the link"):
            write_files(out, {name: b"new"})
    assert outside.read_text() == "mine" and not any(elsewhere.iterdir())
    (tmp_path / "my results").symlink_to(out)  # the user's own, which he names
    write_files(tmp_path / "my results", {"a.npz": b"newer"})
    assert (out / "a.npz").read_bytes() == b"newer"


def test_file_in_place_of_the_folder_is_a_clear_error(tmp_path):
    (tmp_path / "out").write_text("a file")
    with pytest.raises(ResultWriteError, match="cannot write"):
        write(make_snapshot(), tmp_path / "out")
    assert (tmp_path / "out").read_text() == "a file"


MINE = hashlib.sha256(b"mine").hexdigest()


def interrupted(folder, contents: dict[str, bytes], note: str | None) -> None:
    """What a process that was killed between renames leaves: temporary files, and the note of what is to be done."""
    for name, content in contents.items():
        target = folder / name
        target.with_name(f".{target.name}.0123456789ab.tmp").write_bytes(content)
    if note is not None:
        (folder / ".0123456789ab.renaming").write_text(note)


def test_what_a_killed_process_had_begun_is_finished_or_taken_back(tmp_path):
    write(make_snapshot(), tmp_path)
    digest = hashlib.sha256((tmp_path / "transforms.json").read_bytes()).hexdigest()
    note = {"files": ["scene.ply", "report.json"], "superseded": {"transforms.json": digest}}
    interrupted(tmp_path, {"report.json": b"new"}, json.dumps(note))  # scene.ply has its name already
    staged_module.finish_interrupted_write(tmp_path)
    assert (tmp_path / "report.json").read_bytes() == b"new" and not (tmp_path / "transforms.json").exists()
    interrupted(tmp_path, {"report.json": b"newer"}, None)
    staged_module.finish_interrupted_write(tmp_path)
    assert (tmp_path / "report.json").read_bytes() == b"new" and not list(tmp_path.glob(".*"))


@pytest.mark.parametrize(
    "note",
    ["", "{", '{"files": 3}', '{"files": ["../outside"], "superseded": {}}', '{"files": ["link/x"], "superseded": {}}']
    + [json.dumps({"files": [], "superseded": {name: MINE}}) for name in ("../outside", "own")],
)
def test_a_strangers_note_touches_nothing_outside_its_folder(tmp_path, note):
    outside, folder = tmp_path / "outside", tmp_path / "out"
    outside.write_text("mine")
    (tmp_path / "elsewhere").mkdir()
    folder.mkdir()
    (folder / "link").symlink_to(tmp_path / "elsewhere")
    (folder / "own").symlink_to(outside)
    (tmp_path / ".outside.0123456789ab.tmp").write_text("theirs")
    (tmp_path / "elsewhere" / ".x.0123456789ab.tmp").write_text("theirs")
    interrupted(folder, {}, note)
    staged_module.finish_interrupted_write(folder)
    assert outside.read_text() == "mine" and not (tmp_path / "elsewhere" / "x").exists()
    assert {path.name for path in folder.iterdir()} == {"link", "own"}


def test_a_living_writers_files_and_a_pipe_of_such_a_name_are_left_alone(tmp_path):
    os.mkfifo(tmp_path / ".pipe.0123456789ab.tmp")
    with (tmp_path / ".scene.ply.ba9876543210.tmp").open("wb") as living:
        fcntl.flock(living, fcntl.LOCK_EX)
        write_file(tmp_path / "scene.ply", b"mine")
        assert (tmp_path / ".scene.ply.ba9876543210.tmp").exists()
    write_file(tmp_path / "scene.ply", b"again")
    assert not (tmp_path / ".scene.ply.ba9876543210.tmp").exists()


@pytest.mark.parametrize(
    "manifest",
    [
        b'{"files":' + b"[" * 100_000,
        b"[]",
        b"\xff",
        b'{"files": {"a\\u0000b": {"sha256": "x"}}}',
        b'{"files": {"a": {}}}',
    ],
    ids=["deep", "list", "bytes", "null", "without"],
)
def test_a_crafted_manifest_keeps_no_result_from_being_written(tmp_path, manifest):
    (tmp_path / "manifest.json").write_bytes(manifest)
    written = json.loads(write(make_snapshot(), tmp_path).read_text())
    assert "scene.ply" in written["files"]


def files_in(folder: Path) -> set[str]:
    return {path.relative_to(folder).as_posix() for path in folder.rglob("*") if path.is_file()}


REFUSED = {"report.json", "manifest.json"}


@pytest.mark.parametrize("publishable", [True, False])
def test_exports_of_the_earlier_result_go_with_it_and_what_is_the_users_stays(tmp_path, publishable):
    out = tmp_path / "out"
    write(make_snapshot(), out)
    fresh = files_in(out)
    export_scene(out, "spz")
    export_scene(out / "scene.ply", "splat", out / "for_the_web" / "mine.splat")
    export_scene(out, "colmap", out / "dataset")
    write_beside(out / "view", {"overview.png": b"a picture"}, of=out)
    write_beside(out / "training", {"sparse/0/points.txt": b"points", "images/a.jpg": b"an image"}, of=out)
    (out / "dataset" / "notes.txt").write_text("mine")
    (out / "scene.rrd").write_text("mine, of that name")
    exported = {"scene.spz", "for_the_web/mine.splat", "view/overview.png", "exports.json"}
    exported |= {"training/sparse/0/points.txt", "training/images/a.jpg"}
    exported |= {f"dataset/{name}.txt" for name in ("cameras", "images", "points3D")}
    users = {"dataset/notes.txt", "scene.rrd"}
    assert files_in(out) == fresh | exported | users
    code = Code.OK if publishable else Code.NO_PARALLAX
    write(replace(make_snapshot(code, publishable=publishable), gaussians=make_gaussians(seed=4)), out)
    assert files_in(out) == (fresh if publishable else REFUSED) | users
    assert not any((out / name).exists() for name in ("view", "for_the_web", "training"))


def test_an_export_that_was_changed_by_hand_is_the_users(tmp_path):
    write(make_snapshot(), tmp_path)
    export_scene(tmp_path, "spz")
    (tmp_path / "scene.spz").write_bytes(b"edited")
    write(make_snapshot(Code.NO_PARALLAX, publishable=False), tmp_path)
    assert files_in(tmp_path) == REFUSED | {"scene.spz"}


def test_an_export_elsewhere_or_into_another_result_is_not_listed(tmp_path):
    one, other = tmp_path / "one", tmp_path / "other"
    write(make_snapshot(), one)
    write(make_snapshot(), other)
    export_scene(one, "spz", tmp_path / "shared" / "scene.spz")
    export_scene(one, "spz", other / "of_one.spz")
    assert not list(tmp_path.rglob("exports.json"))
    write(make_snapshot(Code.NO_PARALLAX, publishable=False), other)
    assert files_in(other) == REFUSED | {"of_one.spz"}


def test_a_run_that_is_killed_between_renames_leaves_no_export_beside_the_new_scene(tmp_path, monkeypatch):
    write(make_snapshot(), tmp_path)
    fresh = files_in(tmp_path)
    export_scene(tmp_path, "spz")
    real = os.replace

    def killed(source, target, **options):
        if Path(target).name == "cameras.json":
            raise KeyboardInterrupt
        real(source, target, **options)

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(KeyboardInterrupt):
        write(replace(make_snapshot(), gaussians=make_gaussians(seed=4)), tmp_path)
    monkeypatch.undo()
    with hold_result_folder(tmp_path):
        assert files_in(tmp_path) - {".splatnode.lock"} == fresh


def test_exports_are_removed_with_a_provisional_result(tmp_path):
    folder = tmp_path / "scene-provisional"
    write(make_snapshot(), folder)
    export_scene(folder, "spz")
    remove_result(folder)
    assert not folder.exists()
