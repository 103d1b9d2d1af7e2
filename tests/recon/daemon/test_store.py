"""The checkpoint: what was taken is there after any death, what is damaged is told, nothing comes twice."""

from __future__ import annotations

import dataclasses
import errno
import itertools
import os
import sys
import threading
from pathlib import Path

import msgspec
import numpy as np
import pytest

from splatnode.capture.frame import Clock, DroppedFrame, Frame, Intrinsics, Stamp
from splatnode.capture.messaging.keyframe_queue import write_message
from splatnode.capture.messaging.messages import MAGIC, ReceivedFrame, encode
from splatnode.recon.daemon import ledger as ledger_module
from splatnode.recon.daemon.checkpoint import REMEMBERED_DROPPED, Store
from splatnode.recon.daemon.ledger import VERSION, CheckpointError, Ledger, StoredFrame, file_name, read_ledger
from tests.support.strays import STRAYS

SESSION = "0123456789abcdef" * 2
LENS = Intrinsics(8, 6, 7.0, 7.1, 4.0, 3.0, "calibration", (0.1, 0.0), "fisheye")


def image(sequence: int) -> np.ndarray:
    return np.full((6, 8, 3), sequence, np.uint8)


def received(sequence: int, name: str | None = None) -> ReceivedFrame:
    captured_at = Stamp(10**18 + sequence, Clock.UTC)
    frame = Frame(sequence, name or f"{sequence}.png", 10 * sequence, image(sequence), LENS, captured_at=captured_at)
    return ReceivedFrame(SESSION, sequence, frame)


@pytest.fixture
def open_store(tmp_path):
    """Opens the checkpoint as a new process would."""
    opened: list[Store] = []

    def reopen() -> Store:
        while opened:
            opened.pop().close()
        opened.append(Store(tmp_path / "checkpoint"))
        return opened[0]

    yield reopen
    for store in opened:
        store.close()


def test_a_frame_survives_the_process_with_all_that_it_had(open_store):
    put = open_store().add_frame(received(5))
    (stored,) = open_store().frames()
    assert (stored.number, stored.key, stored.frame.name) == (put.number, (SESSION, 5), "5.png")
    assert stored.frame.intrinsics == LENS and stored.frame.stamp_ns == 50
    assert stored.frame.captured_at == put.frame.captured_at == Stamp(10**18 + 5, Clock.UTC)
    assert np.array_equal(stored.frame.image, image(5))


def test_a_mask_is_kept(open_store):
    store = open_store()
    mask = np.random.default_rng(0).random(image(1).shape[:2]) < 0.5
    received = ReceivedFrame(SESSION, 1, Frame(1, "1.png", 10, image(1), LENS, mask=mask))
    assert store.add_frame(received) is not None
    (stored,) = open_store().frames()
    assert np.array_equal(stored.frame.mask, mask)


def test_a_checkpoint_of_the_version_before_is_gone_on_with_and_becomes_one_of_this(open_store):
    store = open_store()
    lens = {name: value for name, value in dataclasses.asdict(LENS).items() if name != "model"}
    header = {"version": 1, "session": SESSION, "sequence": 4, "name": "a.png", "stamp_ns": 40, "intrinsics": lens}
    _, *parts = encode(header, [image(4)])
    write_message(store.directory / "frames" / file_name(0), [MAGIC[:-1] + b"\x02", *parts])
    store._write(msgspec.structs.replace(store.ledger, version=1))
    again = open_store()
    (stored,) = again.frames()
    assert (stored.key, stored.frame.name, stored.frame.stamp_ns) == ((SESSION, 4), "a.png", 40)
    assert stored.frame.intrinsics == dataclasses.replace(LENS, model="opencv")
    assert stored.frame.captured_at is None and again.identity == store.identity
    assert read_ledger(again.directory).version == VERSION


def test_numbers_go_on_and_frames_keep_their_order(open_store):
    for run in range(3):
        store = open_store()
        assert [stored.number for stored in store.frames()] == list(range(2 * run))
        assert [store.add_frame(received(2 * run + i)).number for i in (0, 1)] == [2 * run, 2 * run + 1]


def test_what_comes_while_the_frames_are_read_takes_no_number_and_no_name_of_theirs(open_store):
    for i in range(3):
        open_store().add_frame(received(i))
    again = open_store()
    assert sorted(again.frame_keys) == [(SESSION, i) for i in range(3)] and again.names == {"0.png", "1.png", "2.png"}
    new = again.add_frame(received(3, "1.png"))
    assert new.number == 3 and new.frame.name != "1.png"
    assert [stored.key[1] for stored in again.frames()] == [0, 1, 2]
    assert [stored.key[1] for stored in open_store().frames()] == [0, 1, 2, 3]


def test_frames_of_the_same_name_are_told_apart(open_store):
    store = open_store()
    names = [store.add_frame(received(i, "same.png")).frame.name for i in range(3)]
    assert len(set(names)) == 3 and names[0] == "same.png"
    assert [stored.frame.name for stored in open_store().frames()] == names


def test_names_are_told_while_another_thread_stores_frames(open_store):
    store, told, before_s = open_store(), threading.Event(), sys.getswitchinterval()

    def remember(number: int) -> None:
        store._remember(StoredFrame(number, (SESSION, number), received(0, f"{number}.png").frame))

    def remember_more() -> None:
        for number in range(1000, 20_000):
            if not told.is_set():
                remember(number)

    for number in range(1000):
        remember(number)
    more = threading.Thread(target=remember_more, daemon=True)
    sys.setswitchinterval(1e-6)
    try:
        more.start()
        assert all(len(store.names_before(1000)) == 1000 for _ in range(100))
    finally:
        sys.setswitchinterval(before_s)
        told.set()
        more.join()


def test_what_was_taken_is_known_whatever_became_of_it(open_store):
    store = open_store()
    store.add_frame(received(0))
    store.add_frame(received(1))
    store.add_frame(ReceivedFrame(SESSION, 2, DroppedFrame("2.png", "blurred")))
    store.forget("0.png", "retracted")
    again = open_store()
    assert [stored.frame.name for stored in again.frames()] == ["1.png"]
    assert sorted(again.frame_keys) == [(SESSION, 0), (SESSION, 1), (SESSION, 2)]
    assert again.frames_dropped == [DroppedFrame("2.png", "blurred"), DroppedFrame("0.png", "retracted")]
    again.forget("nobody.png", "retracted")
    assert again.add_frame(received(3)).number == 2


def test_what_was_left_out_is_bounded(open_store):
    store = open_store()
    for i in range(REMEMBERED_DROPPED + 5):
        store.add_frame(ReceivedFrame(SESSION, i, DroppedFrame(f"{i}.png", "blurred")))
    assert (
        len(store.frames_dropped) == REMEMBERED_DROPPED
        and store.frames_dropped[-1].name == f"{REMEMBERED_DROPPED + 4}.png"
    )


def test_another_place_keeps_its_own_frames_only(open_store):
    store = open_store()
    for i in range(4):
        store.add_frame(received(i))
    store.save("scene", Ledger(), [])
    store.begin_submap(first=2)
    assert store.scene_id == "scene-0002" and store.names == {"2.png", "3.png"}
    again = open_store()
    assert [stored.number for stored in again.frames()] == [2, 3]
    assert again.scene_id == "scene-0002" and again.load("scene", Ledger) is None
    assert sorted(again.frame_keys) == [(SESSION, i) for i in range(4)]


def test_frames_of_a_place_that_was_left_as_the_process_died_are_removed(open_store, monkeypatch):
    store = open_store()
    for i in range(3):
        store.add_frame(received(i))
    monkeypatch.setattr(store, "_unlink", lambda frames: None)
    store.begin_submap(first=2)
    assert [stored.number for stored in open_store().frames()] == [2]
    assert len(list((store.directory / "frames").glob("*.frame"))) == 1


def test_a_damaged_frame_is_put_aside_and_the_others_are_there(open_store, caplog):
    store = open_store()
    paths = [store.directory / "frames" / f"{store.add_frame(received(i)).number:012d}.frame" for i in range(3)]
    paths[1].write_bytes(paths[1].read_bytes()[:-9])
    (store.directory / "frames" / "stranger.frame").write_bytes(b"?")
    again = open_store()
    assert [stored.number for stored in again.frames()] == [0, 2]
    assert "put aside" in caplog.text and paths[1].with_suffix(".damaged").exists()
    assert again.add_frame(received(9)).number == 3


def test_half_written_files_are_removed(open_store):
    store = open_store()
    half = store.directory / "frames" / ".000000000000.frame.77.tmp"
    half.write_bytes(b"half")
    assert list(open_store().frames()) == [] and not half.exists()


def test_a_full_disk_is_told_and_nothing_has_changed(open_store, monkeypatch):
    store = open_store()
    store.add_frame(received(0))

    def full(path, parts):
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patched:
        for module in (ledger_module, ledger_module):
            patched.setattr(module, "write_message", full)
        for frame in (received(1), ReceivedFrame(SESSION, 2, DroppedFrame("2.png", "blurred"))):
            with pytest.raises(OSError, match="No space"):
                store.add_frame(frame)
        with pytest.raises(OSError, match="No space"):
            store.forget("0.png", "retracted")
    assert store.frame_keys == [(SESSION, 0)] and store.names == {"0.png"}
    assert store.add_frame(received(1)).number == 1


def test_two_processes_do_not_share_a_checkpoint(open_store):
    store = open_store()
    with pytest.raises(CheckpointError, match="another process uses"):
        Store(store.directory)


def test_another_version_and_a_damaged_ledger_are_refused_with_what_to_do(open_store):
    store = open_store()
    store._write(Ledger(version=99))
    with pytest.raises(CheckpointError, match=f"version 99, this is version {VERSION}.*move the folder away"):
        open_store()
    (store.directory / "ledger").write_bytes(b"rubbish")
    with pytest.raises(CheckpointError, match=r"damaged.*Move the folder away"):
        open_store()


def test_what_can_be_made_anew_is_missing_rather_than_wrong(open_store, caplog):
    store = open_store()
    store.save("graph", Ledger(number=3), [np.arange(3.0)])
    message = store.load("graph", Ledger)
    assert message.header.number == 3 and message.arrays[0].tolist() == [0, 1, 2]
    path = store.directory / "graph"
    path.write_bytes(path.read_bytes()[:-1])
    assert store.load("graph", Ledger) is None and "made anew" in caplog.text
    assert store.load("scene", Ledger) is None


@pytest.mark.parametrize("make", STRAYS.values(), ids=STRAYS)
@pytest.mark.parametrize("name", ["frames/{}", "{}"])
@pytest.mark.parametrize(
    "stray", ["copy of 000000000005.frame", "000000000005.frame", "9" * 60 + ".frame", ".x.tmp", "-1.frame", "٣.frame"]
)
def test_what_is_no_file_of_the_checkpoint_is_left_alone(open_store, make, name, stray):
    store = open_store()
    store.add_frame(received(0))
    path = store.directory / name.format(stray)
    make(path)
    store = open_store()
    assert [stored.frame.name for stored in store.frames()] == ["0.png"] and os.path.lexists(path)
    for sequence in range(1, 5):
        store.add_frame(received(sequence))
    assert len(list(open_store().frames())) == 5


@pytest.mark.parametrize("make", STRAYS.values(), ids=STRAYS)
@pytest.mark.parametrize("name", ["graph", "scene", "judgement", "pointmaps"])
def test_what_lies_where_a_file_belongs_that_can_be_made_anew_is_no_file(open_store, make, name):
    store = open_store()
    make(store.directory / name)
    assert open_store().load(name, Ledger) is None


@pytest.mark.parametrize("make", STRAYS.values(), ids=STRAYS)
def test_what_lies_where_the_ledger_belongs_is_told(open_store, make):
    ledger = open_store().directory / "ledger"
    ledger.unlink()
    make(ledger)
    with pytest.raises(CheckpointError, match="Move the folder away"):
        open_store()


def test_a_copy_of_a_keyframe_is_left_alone(open_store, caplog):
    store = open_store()
    store.add_frame(received(0))
    copy = store.directory / "frames" / "000000000007.frame"
    copy.write_bytes((store.directory / "frames" / "000000000000.frame").read_bytes())
    store = open_store()
    assert [stored.number for stored in store.frames()] == [0] and copy.exists() and "a copy of" in caplog.text
    assert store.add_frame(received(1)).number == 8


def test_a_checkpoint_is_private_whatever_the_umask_and_one_that_was_open_is_closed(open_store):
    before = os.umask(0)
    try:
        store = open_store()
        store.add_frame(received(0))
        store.begin_submap(1)
        store.add_frame(received(1))
    finally:
        os.umask(before)
    everything = [store.directory, *store.directory.rglob("*")]
    assert len(everything) > 3 and not any(path.lstat().st_mode & 0o077 for path in everything)
    for path in everything:
        path.chmod(0o755 if path.is_dir() else 0o644)
    store = open_store()
    assert store.directory.lstat().st_mode & 0o777 == (store.directory / "frames").lstat().st_mode & 0o777 == 0o700


def test_a_place_that_is_left_is_kept_as_a_checkpoint_of_its_own(open_store):
    store = open_store()
    for sequence in range(4):
        store.add_frame(received(sequence))
    store.forget("1.png", "blurred")
    assert store.names_before(2) == {"0.png"} and store.names_before(3) == {"0.png", "2.png"}
    store.save("graph", Ledger(), [])
    store.leave_submap(2)
    assert store.scene_id == "scene-0002" and store.names == {"2.png", "3.png"} and not store.frames_dropped
    assert not (store.directory / "graph").exists()
    (folder,) = ledger_module.list_left_folders(store.directory)
    kept = Store(folder)
    assert kept.scene_id == "scene-0001" and [each.frame.name for each in kept.frames()] == ["0.png"]
    assert kept.frames_dropped == [DroppedFrame("1.png", "blurred")] and kept.load("graph", Ledger) is not None
    kept.close()

    store = open_store()
    assert [stored.frame.name for stored in store.frames()] == ["2.png", "3.png"]
    assert (SESSION, 0) in store.frame_keys and ledger_module.list_left_folders(store.directory) == [folder]
    ledger_module.remove_left_checkpoint(folder)
    assert ledger_module.list_left_folders(store.directory) == []


def test_a_place_goes_on_from_the_one_that_it_shares_frames_with(open_store):
    store = open_store()
    for sequence in range(4):
        store.add_frame(received(sequence))
    store.leave_submap(2, shared=("2.png", "3.png"))
    (folder,) = ledger_module.list_left_folders(store.directory)
    kept = Store(folder)
    assert (kept.ledger.follows, kept.ledger.shared) == ("", ()) and kept.names == {f"{i}.png" for i in range(4)}
    kept.close()
    store = open_store()
    assert (store.ledger.follows, store.ledger.shared) == ("scene-0001", ("2.png", "3.png"))
    store.leave_submap(4)
    assert (store.ledger.follows, store.ledger.shared) == ("", ())


def test_a_finished_place_is_kept_and_taken_back(open_store):
    store = open_store()
    for sequence in range(3):
        store.add_frame(received(sequence))
    store.save("scene", Ledger(), [])
    store.leave_submap(2)
    (folder,) = ledger_module.list_left_folders(store.directory)
    kept = Store(folder)
    kept.remove_scene_files()
    kept.finalize()
    kept.close()
    assert (
        ledger_module.list_left_folders(store.directory) == []
        and ledger_module.list_finished_folders(store.directory)[0].name == "scene-0001"
    )
    assert not (ledger_module.make_finished_path(store.directory, "scene-0001") / "scene").exists()

    store = open_store()
    store.forget_frames([], "retracted", [("scene-0001", "0.png")])
    store.forget_frames([], "retracted", [("scene-0001", "0.png")])
    store = open_store()
    assert store.ledger.retracted == (("scene-0001", "0.png"),)
    assert ledger_module.reopen(store.directory, "scene-0007") is None
    again = ledger_module.reopen(store.directory, "scene-0001")
    assert again == folder and ledger_module.reopen(store.directory, "scene-0001") == folder
    assert ledger_module.list_finished_folders(store.directory) == [] and ledger_module.list_left_folders(
        store.directory
    ) == [folder]
    store.confirm_removal("scene-0001", "0.png")
    assert open_store().ledger.retracted == ()


def test_a_death_while_a_place_is_left_leaves_it_as_it_was(open_store, monkeypatch):
    store = open_store()
    for sequence in range(3):
        store.add_frame(received(sequence))
    monkeypatch.setattr(Store, "begin_submap", lambda *_: (_ for _ in ()).throw(SystemExit))
    with pytest.raises(SystemExit):
        store.leave_submap(2)
    assert ledger_module.list_left_folders(store.directory) != []
    store = open_store()
    assert [stored.frame.name for stored in store.frames()] == ["0.png", "1.png", "2.png"]
    assert ledger_module.list_left_folders(store.directory) == [] and store.scene_id == "scene-0001"


def place_that_was_left(open_store, count: int) -> Path:
    """Its checkpoint, with so many frames."""
    store = open_store()
    for sequence in range(count):
        store.add_frame(received(sequence))
    store.leave_submap(count)
    return store.directory / "left" / "scene-0001"


def test_a_part_of_a_place_that_was_left_is_a_place_of_its_own(open_store, tmp_path):
    folder = place_that_was_left(open_store, 4)
    place = Store(folder)
    assert place.split_off(["3.png", "2.png"]) == "scene-0001-3" and place.names == {"0.png", "1.png"}
    assert {each.reason for each in place.frames_dropped} == {"it shows another place: scene-0001-3"}
    place.close()
    open_store()  # whose start removes what was not left yet
    assert [each.name for each in ledger_module.list_left_folders(tmp_path / "checkpoint")] == [
        "scene-0001",
        "scene-0001-3",
    ]
    part = Store(folder.with_name("scene-0001-3"))
    assert [each.frame.name for each in part.frames()] == ["2.png", "3.png"] and part.scene_id == "scene-0001-3"
    part.close()


def test_a_part_that_begins_with_the_very_first_frame_has_a_name_of_its_own(open_store):
    place = Store(place_that_was_left(open_store, 2))
    assert place.split_off(["0.png"]) == "scene-0001-1" and place.names == {"1.png"}
    place.close()


def test_a_part_whose_making_was_interrupted_is_made_once(open_store, tmp_path, monkeypatch):
    folder = place_that_was_left(open_store, 4)
    place = Store(folder)
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Store, "forget", lambda *_: (_ for _ in ()).throw(KeyboardInterrupt))
        place.split_off(["2.png", "3.png"])
    place.close()
    place = Store(folder)
    assert place.names == {"0.png", "1.png", "2.png", "3.png"}
    assert place.split_off(["2.png", "3.png"]) == "scene-0001-3" and place.names == {"0.png", "1.png"}
    place.close()
    assert len(ledger_module.list_left_folders(tmp_path / "checkpoint")) == 2


# Frames that were taken together.


def together(*sequences: int) -> list[ReceivedFrame]:
    return [received(sequence) for sequence in sequences]


def numbers(store: Store) -> list[int]:
    return [stored.number for stored in store.frames()]


@pytest.mark.parametrize("written", (1, 2))
def test_a_kill_between_two_frames_of_a_set_leaves_none_of_it(open_store, monkeypatch, written):
    """Neither is acknowledged before both are there, so both come again; what was there before stays."""
    store, real, count = open_store(), ledger_module.write_message, itertools.count()
    store.add_frames(together(0, 1))

    def write(path, parts):
        if next(count) == written:
            raise KeyboardInterrupt  # as a kill: nothing is put in order afterwards
        real(path, parts)

    with monkeypatch.context() as patched:
        patched.setattr(ledger_module, "write_message", write)
        patched.setattr(store, "_remove", lambda number: None)
        with pytest.raises(KeyboardInterrupt):
            store.add_frames(together(2, 3, 4))
    assert len(list((store.directory / "frames").glob("*.frame"))) == 2 + written
    again = open_store()
    assert again.frame_keys == [(SESSION, 0), (SESSION, 1)] and numbers(again) == [0, 1]
    assert [each.number for each in again.add_frames(together(2, 3, 4))] == [2, 3, 4]
    assert numbers(open_store()) == [0, 1, 2, 3, 4]


def test_what_the_disk_does_not_take_of_a_set_leaves_none_of_it(open_store, monkeypatch):
    store, real = open_store(), ledger_module.write_message

    def full(path, parts):
        if path.name.startswith("000000000001"):
            raise OSError(errno.ENOSPC, "No space left on device")
        real(path, parts)

    with monkeypatch.context() as patched:
        patched.setattr(ledger_module, "write_message", full)
        with pytest.raises(OSError, match="No space"):
            store.add_frames(together(0, 1))
    assert store.names == set() and not list((store.directory / "frames").iterdir())
    assert [each.number for each in store.add_frames(together(0, 1))] == [0, 1]


def test_a_set_of_which_a_frame_was_taken_out_or_is_damaged_stays(open_store):
    store = open_store()
    store.add_frames(together(0, 1))
    store.forget("1.png", "retracted")
    store = open_store()
    assert numbers(store) == [0]
    store.add_frames(together(2, 3))
    last = store.directory / "frames" / "000000000003.frame"
    last.write_bytes(last.read_bytes()[:-1])
    assert numbers(open_store()) == [0, 2]
    assert numbers(open_store()) == [0, 2], "the damaged one is not there under its name any more"


def test_frames_of_a_set_with_one_name_get_their_own(open_store):
    names = [each.frame.name for each in open_store().add_frames([received(i, "same.png") for i in range(3)])]
    assert len(set(names)) == 3 and names[0] == "same.png"
