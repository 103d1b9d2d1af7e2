"""The pieces of a node that write, for `interrupted.py`: what each promises, and what must be there afterwards."""

from __future__ import annotations

import contextlib
import hashlib
import json
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from splatnode.capture import recording
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.messaging.keyframe_queue import Spool, SpoolConfig, SpoolFull
from splatnode.capture.messaging.messages import Key, ReceivedFrame
from splatnode.capture.messaging.network import allow, create_keys, expect_server, read_keys
from splatnode.recon.daemon import ledger
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.ledger import MADE_ANEW
from splatnode.recon.result.export import export_scene
from splatnode.recon.result.export.staged import hold_result_folder
from splatnode.recon.result.export.stored import read_gaussians
from splatnode.recon.result.verdict import Code
from tests.fuzz.interrupted import Piece, Tell
from tests.support.exported import make_gaussians, make_snapshot, write

SESSION = "0123456789abcdef" * 2
KEY = b"0123456789abcdefghijklmnopqrstuvwxyzABCD"


def nothing(_: Path) -> None:
    """For a piece before which nothing lies there."""


def no_leftovers(folder: Path) -> None:
    found = [path for path in folder.rglob(".*") if path.suffix in (".tmp", ".renaming")]
    assert not found, f"left: {found}"


# The spool: what `put` has returned from is delivered until it is removed, byte by byte.


def _parts(sequence: int) -> list[bytes]:
    return [b"header %d" % sequence, bytes([sequence]) * 5000]


def _spool(disk: Path) -> Spool:
    return Spool(SpoolConfig(directory=disk))


def _spooling(disk: Path, tell: Tell) -> None:
    spool = _spool(disk)
    for sequence in range(4):
        _put(spool, sequence, tell)
    for sequence in (0, 2):
        tell(f"removing {sequence}")
        spool.remove(Key(SESSION, sequence))
    tell("setting 1 aside")
    if Key(SESSION, 1) in spool:
        spool.move_to_quarantine(Key(SESSION, 1), "1.png", "refused by recon")
    _put(spool, 4, tell)
    spool.close()


def _put(spool: Spool, sequence: int, tell: Tell) -> None:
    with contextlib.suppress(SpoolFull):
        spool.store(Key(SESSION, sequence), _parts(sequence))
        tell(f"put {sequence}")


def _spool_after(disk: Path, told: list[str]) -> None:
    spool = _spool(disk)
    no_leftovers(disk)
    promised = {sequence for sequence in range(5) if f"put {sequence}" in told}
    may_be_gone = {sequence for sequence in (0, 2) if f"removing {sequence}" in told}
    may_be_gone |= {1} if "setting 1 aside" in told else set()
    there = [key.sequence for key in spool]
    assert promised - may_be_gone <= set(there), f"lost: {promised - may_be_gone - set(there)}"
    assert there == sorted(there), "in another order"
    for key in spool:
        assert [bytes(part) for part in spool.get(key)] == _parts(key.sequence)
    aside = spool.quarantine.newest(9)
    assert all(each.file.endswith("-1.frame") or each.reason == "its reason was lost" for each in aside), aside
    assert len(aside) <= 1 and len(list(spool.quarantine.directory.glob("*.frame"))) == len(aside)
    spool.store(Key(SESSION, 9), _parts(9))
    spool.close()
    assert list(_spool(disk))[-1] == Key(SESSION, 9)


# The checkpoint: what `put` has returned from is there until it is forgotten; what is computed is whole or missing.


TOGETHER = (7, 8, 9)  # that several cameras took together


class _Thing(msgspec.Struct, frozen=True):
    number: int


def _frame(sequence: int) -> Frame:
    return Frame(sequence, f"{sequence}.png", sequence, np.full((6, 8, 3), sequence, np.uint8), None)


def _arrays(number: int) -> list[np.ndarray]:
    return [np.full(2000, number, np.int64)]


def _storing(disk: Path, tell: Tell) -> None:
    store = Store(disk / "checkpoint")
    doing = partial(_doing, tell)
    for sequence in range(3):
        doing(
            f"put {sequence}",
            lambda sequence=sequence: store.add_frame(ReceivedFrame(SESSION, sequence, _frame(sequence))),
        )
    for number in range(2):
        for name in MADE_ANEW:
            doing(
                f"save {name} {number}",
                lambda name=name, number=number: store.save(name, _Thing(number), _arrays(number)),
            )
    doing("forget 1", lambda: store.forget("1.png", "blurred"))
    dropped = ReceivedFrame(SESSION, 3, DroppedFrame("3.png", "black"))
    doing("drop 3", lambda: store.add_frame(dropped))
    doing("put 4", lambda: store.add_frame(ReceivedFrame(SESSION, 4, _frame(4))))
    first = store._names.get("4.png", store._next)
    doing("place", lambda: store.leave_submap(first))
    doing("put 5", lambda: store.add_frame(ReceivedFrame(SESSION, 5, _frame(5))))
    doing("put set", lambda: store.add_frames([ReceivedFrame(SESSION, each, _frame(each)) for each in TOGETHER]))
    doing("save graph 2", lambda: store.save("graph", _Thing(2), _arrays(2)))
    doing("finish", lambda: _finishing(store))
    doing("retract 0", lambda: store.forget_frames([], "retracted", [("scene-0001", "0.png")]))
    doing("retracting 0", lambda: _retracting(store))
    store.close()


def _finishing(store: Store) -> None:
    """Takes the place that was left among the finished ones, as the daemon does once its scene is final."""
    for folder in ledger.list_left_folders(store.directory):
        with contextlib.closing(Store(folder)) as kept:
            kept.save("codes", _Thing(3), _arrays(3))
            kept.remove_scene_files()
            kept.finalize()


def _retracting(store: Store) -> None:
    """Takes a finished place back among those that were left, and a frame out of it."""
    for scene, name in store.ledger.retracted:
        folder = ledger.reopen(store.directory, scene)
        if folder is not None:
            with contextlib.closing(Store(folder)) as kept:
                kept.forget_frames([name], "retracted")
        store.confirm_removal(scene, name)


def _doing(tell: Tell, what: str, work: Callable[[], object]) -> None:
    """As the daemon does: what the disk refuses is told, and it goes on."""
    tell(f"begin {what}")
    try:
        work()
    except OSError:
        tell(f"failed {what}")
    else:
        tell(what)


def _store_after(disk: Path, told: list[str]) -> None:
    store = Store(disk / "checkpoint")
    no_leftovers(disk)
    frames = {stored.key[1]: stored for stored in store.frames()}
    for stored in frames.values():
        assert np.array_equal(stored.frame.image, _frame(stored.key[1]).image)
    promised = {sequence for sequence in (0, 1, 2, 4, 5) if f"put {sequence}" in told}
    promised |= set(TOGETHER) if "put set" in told else set()
    seen = {sequence for _, sequence in store.frame_keys}
    assert promised <= seen, f"would be taken twice: {promised - seen}"
    assert len(seen & set(TOGETHER)) in (0, len(TOGETHER)), "a part of a frame set is there"
    gone = {1} if "begin forget 1" in told else set()
    gone |= {0, 1, 2} if "begin place" in told else set()
    assert promised - gone <= set(frames), f"lost: {promised - gone - set(frames)}"
    if "forget 1" in told:
        assert 1 not in frames and ("1.png" in {each.name for each in store.frames_dropped} or "begin place" in told)
    if "place" in told:
        assert not {0, 1, 2} & set(frames) and store.scene_id == "scene-0002"
    _left_after(store, promised & {0, 2}, told)
    assert not {stored.frame.name for stored in frames.values()} & {each.name for each in store.frames_dropped}
    assert not list(disk.rglob("*.damaged")), "a whole frame was called damaged"
    for name in MADE_ANEW:
        _made_anew_after(store, name, told, another_place=store.scene_id == "scene-0002")
    again = store.add_frame(ReceivedFrame(SESSION, 6, _frame(6)))
    assert again is not None and all(again.number > stored.number for stored in frames.values())
    store.close()


def _left_after(store: Store, promised: set[int], told: list[str]) -> None:
    """A place is here, in left/ or in finished/, whole each way."""
    folders = [*ledger.list_left_folders(store.directory), *ledger.list_finished_folders(store.directory)]
    assert len(folders) == (store.scene_id == "scene-0002"), folders
    if "retract 0" in told and folders:
        _retracting(store)
        promised = promised - {0}
    elif "begin retract 0" in told:
        promised = promised - {0}
    folders = [*ledger.list_left_folders(store.directory), *ledger.list_finished_folders(store.directory)]
    for folder in folders:
        with contextlib.closing(Store(folder)) as kept:
            frames = {stored.key[1] for stored in kept.frames()}
            assert kept.scene_id == "scene-0001" and promised <= frames, f"lost: {promised - frames}"


def _made_anew_after(store: Store, name: str, told: list[str], another_place: bool) -> None:
    found = store.load(name, _Thing)
    if found is not None:
        number = found.header.number
        assert np.array_equal(found.arrays[0], _arrays(number)[0])
        assert not another_place or number == 2, f"{name} is that of the place before"
    else:
        assert f"save {name} 0" not in told or "begin place" in told, f"{name} is lost"


# Result folders: the old result or the new one, and no file of the other.


def _old_result(disk: Path) -> None:
    write(make_snapshot(), disk / "out", preview=b"old")


def _new_result(disk: Path, _: Tell) -> None:
    with hold_result_folder(disk / "out"):
        write(replace(make_snapshot(), gaussians=make_gaussians(seed=9)), disk / "out", preview=b"new")


def _refused_result(disk: Path, _: Tell) -> None:
    with hold_result_folder(disk / "out"):
        write(make_snapshot(Code.NO_PARALLAX, publishable=False), disk / "out")


def _result_after(disk: Path, _: list[str]) -> None:
    out = disk / "out"
    with hold_result_folder(out):
        pass
    no_leftovers(disk)
    if any(path.is_file() for path in out.rglob("*")):
        whole(out)
    with hold_result_folder(out):
        write(make_snapshot(), out, preview=b"again")
    whole(out)
    assert (out / "preview.png").read_bytes() == b"again"


def whole(out: Path) -> None:
    """All that the manifest lists, as it says, and nothing else."""
    files = json.loads((out / "manifest.json").read_bytes())["files"]
    for name, entry in files.items():
        assert hashlib.sha256((out / name).read_bytes()).hexdigest() == entry["sha256"], f"{name} is of another result"
    there = {str(path.relative_to(out)) for path in out.rglob("*") if path.is_file()}
    assert there == {*files, "manifest.json"}, f"not of this result: {there - set(files)}"


def _exporting(disk: Path, _: Tell) -> None:
    export_scene(disk / "out", "spz", disk / "out.spz")


def _exported_after(disk: Path, told: list[str]) -> None:
    if (disk / "out.spz").exists():
        assert len(read_gaussians(disk / "out.spz")) == 50
    _exporting(disk, told.append)
    no_leftovers(disk)
    assert len(read_gaussians(disk / "out.spz")) == 50
    whole(disk / "out")


# Recordings: those frames whose `write` has returned, and perhaps the one after.


def _recording(disk: Path, tell: Tell) -> None:
    with recording.Recorder(disk / "recording") as recorder:
        for index in range(4):
            recorder.write(_frame(index) if index != 2 else DroppedFrame("2.png", "black"))
            tell(f"wrote {index}")


def _recorded_after(disk: Path, told: list[str]) -> None:
    wrote = sum(line.startswith("wrote") for line in told)
    folder = disk / "recording"
    if wrote == 0 and not recording.is_recording(folder):
        _recording(disk, lambda _: None)  # the same folder will do
        wrote = 4
    if wrote == 0:
        with contextlib.suppress(ValueError):
            _frames_of(folder)
        return
    assert len(_frames_of(folder)) >= wrote


def _frames_of(folder: Path) -> list[Frame | DroppedFrame]:
    frames = list(recording.read(folder).frames())
    for index, item in enumerate(frames):
        assert isinstance(item, DroppedFrame) == (index == 2), item
        assert isinstance(item, DroppedFrame) or np.array_equal(item.image, _frame(index).image)
    return frames


# Keys: a pair that belongs together, or none; the next `splatnode keygen` needs no hand.


def _making_keys(disk: Path, _: Tell) -> None:
    create_keys(disk / "keys")
    allow(disk / "keys", "robot", KEY)
    expect_server(disk / "keys", KEY)


def _keys_after(disk: Path, _: list[str]) -> None:
    import zmq

    folder = disk / "keys"
    if not (folder / "secret.key").exists():
        create_keys(folder)
    keys = read_keys(folder)
    assert zmq.curve_public(keys.secret) == keys.public
    assert keys.server in (KEY, keys.public)
    allow(folder, "robot", KEY)
    expect_server(folder, KEY)
    no_leftovers(disk)


PIECES = (
    Piece("spool", nothing, _spooling, _spool_after),
    Piece("checkpoint", nothing, _storing, _store_after),
    Piece("first result", nothing, _new_result, _result_after),
    Piece("new result", _old_result, _new_result, _result_after),
    Piece("refused result", _old_result, _refused_result, _result_after),
    Piece("export", _old_result, _exporting, _exported_after),
    Piece("recording", nothing, _recording, _recorded_after),
    Piece("keys", nothing, _making_keys, _keys_after),
)
