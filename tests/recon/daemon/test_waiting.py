"""Keyframes that waited while recon was restarted become the places that the walk would have made of them.

And what making a scene final tries for want of matches: it has a budget, and what gained nothing is not tried again.
"""

from __future__ import annotations

import threading
import time
from contextlib import closing
from dataclasses import replace
from types import SimpleNamespace

import msgspec
import pytest

from splatnode.capture.messaging.messages import ReceivedFrame
from splatnode.capture.status import read_heartbeats
from splatnode.recon import incremental
from splatnode.recon.config import ReconstructionConfig as Recipe
from splatnode.recon.daemon import ReconState, checkpoint, ledger
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.ingest import BATCH, ArrivedKeyframe, Inbox
from splatnode.recon.daemon.loop_closure import LoopDetector
from splatnode.recon.daemon.output import Output
from splatnode.recon.daemon.submap import ActiveSubmap
from splatnode.recon.daemon.worker import InactiveSubmaps, Worker
from splatnode.recon.estimation import prepare
from splatnode.recon.fallbacks import make_fallback_key
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.threads import BACKGROUND, RunContext
from tests.capture.messaging.test_sockets import wait_for
from tests.recon.daemon.test_daemon import PATIENCE_S, config, index, running
from tests.support.synthetic import SMALL, photographs, places

__all__ = ["config"]


def store_all(store, frames) -> list:
    """The frames in the checkpoint, as an earlier process took them, of which it worked in none."""
    return [store.add_frame(ReceivedFrame("0" * 32, number, frame)) for number, frame in enumerate(frames)]


def at_rest(config) -> bool:
    """Whether the node has nothing left to do."""
    status = read_heartbeats(config.network, 1.0, only="recon")["recon"]
    if status is None or status["state"] not in ("idle", "waiting", "lost") or status["delay_s"] > 0:
        return False
    return status["unfinished"] == 0 and all(not each["provisional"] for each in index(config))


def submaps(config) -> list[list[str]]:
    """The keyframes with a camera in each scene."""
    return sorted(sorted(active["frames_used"]) for active in index(config))


@pytest.mark.parametrize("seeds", [(0, 1), (0, 1, 2)], ids=["two places", "three places"])
def test_keyframes_that_waited_become_a_submap_for_each_place(config, seeds):
    frames = places(msgspec.structs.replace(SMALL, views=4 * len(seeds)), seeds)
    with closing(Store(config.checkpoint)) as store:
        store_all(store, frames)
    with running(config):
        wait_for(lambda: (config.out / "places.json").exists() and at_rest(config), 3 * PATIENCE_S)
    names = [frame.name for frame in frames]
    assert submaps(config) == [names[at : at + 4] for at in range(0, len(names), 4)]


class Node:
    """A present place without the process around it, and the parts of one."""

    def __init__(self, config, store, recipe=None) -> None:
        self.store, self.recipe = store, recipe or config.reconstruction
        self.output = Output(config, store, lambda _: None, pytest.fail)
        self.active = ActiveSubmap(config, self.recipe, store, self.output, lambda until_s: None)

    def keyframes(self, frames) -> list[ArrivedKeyframe]:
        return [
            ArrivedKeyframe(prepare(each.frame, self.recipe), time.monotonic())
            for each in store_all(self.store, frames)
        ]


def test_keyframes_of_several_places_that_come_together_after_a_scene_begin_one_place_each(config):
    frames = places(msgspec.structs.replace(SMALL, views=9), (0, 1, 2))
    with closing(Store(config.checkpoint)) as store:
        node = Node(config, store)
        arrived = node.keyframes(frames)
        node.active.add_keyframes(arrived[:3])
        node.active.add_keyframes(arrived[3:])
        assert node.active.owed == node.active.under_way == []
        assert (store.scene_id, store.names) == ("scene-0003", {frame.name for frame in frames[6:]})
    for at, scene in enumerate(("scene-0001", "scene-0002")):
        with closing(Store(ledger.find_folder(config.checkpoint, scene))) as store:
            assert store.names == {frame.name for frame in frames[3 * at : 3 * at + 3]}


def test_the_status_of_a_submap_that_grows_is_that_of_the_scene_which_is_shown(config):
    frames = places(msgspec.structs.replace(SMALL, views=4), (0,))
    with closing(Store(config.checkpoint)) as store:
        node = Node(config, store)
        worker, newest = SimpleNamespace(_output=node.output, active=node.active), Worker.newest_submaps.fget
        assert newest is not None
        verdicts = []
        for arrived in node.keyframes(frames):
            node.active.add_keyframes([arrived])
            (status,) = newest(worker)
            verdicts.append((status.scene_id, status.verdict, status.keyframes))
        assert verdicts[0] == ("scene-0001", "TOO_FEW_VIEWS", 0) and verdicts[-1] == ("scene-0001", "OK", 4)
        node.active.finalize()
        assert [each.verdict for each in newest(worker)] == ["OK"]


def test_a_place_that_turns_out_to_be_two_while_the_camera_is_there_becomes_two(config, monkeypatch):
    """Such as one whose first keyframes made no scene until the camera was elsewhere."""
    monkeypatch.setattr("splatnode.recon.daemon.submap.is_split", lambda *_: False)
    monkeypatch.setattr("splatnode.recon.daemon.submap.find_untracked", lambda *_: [])
    frames = places(msgspec.structs.replace(SMALL, views=8), (0, 1))
    names = [frame.name for frame in frames]
    with closing(Store(config.checkpoint)) as store:
        node = Node(config, store)
        node.active.add_keyframes(node.keyframes(frames))
        node.active.finalize()
        assert node.active.state is ReconState.IDLE
        here = store.names
        assert sorted(here) in (names[:4], names[4:])
    with closing(Store(config.checkpoint)) as store:  # the next process
        (part,) = ledger.list_left_folders(config.checkpoint)
        assert store.names == here and part.name.startswith("scene-0001-")
        output = Output(config, store, lambda _: None, pytest.fail)
        waiting = InactiveSubmaps(
            store, config.reconstruction, output, LoopDetector(store.directory, config.reconstruction, output.index)
        )
        while waiting.verify_next(BACKGROUND) or waiting.finalize_next(BACKGROUND):
            pass
    assert submaps(config) == [names[:4], names[4:]]


@pytest.fixture
def rounds(monkeypatch) -> list[list[str]]:
    """The keyframes of each round of fallbacks, which all gain nothing."""
    found: list[list[str]] = []

    def run_fallbacks(estimate, rejected, config, run):
        found.append(sorted(estimate.graph.names))
        message = f"{estimate.verdict.message} Also tried: nothing."
        return replace(estimate, verdict=replace(estimate.verdict, message=message))

    monkeypatch.setattr(incremental, "run_fallbacks", run_fallbacks)
    return found


def forgetful(work: IncrementalReconstruction) -> IncrementalReconstruction:
    """The same keyframes and matches, of which no estimate is remembered."""
    known = work.state
    return IncrementalReconstruction(work.config, replace(known, memory=replace(known.memory, recent=())))


def test_fallbacks_that_gained_nothing_are_not_repeated_for_the_same_keyframes_and_matches(config, rounds):
    frames = places(seeds=(0, 1))
    recipe = config.reconstruction
    with closing(Store(config.checkpoint)) as store:
        for each in store_all(store, frames):
            assert each is not None
        work = IncrementalReconstruction(recipe)
        for frame in frames[:4]:
            work.add_keyframe(prepare(frame, recipe))
        message = work.estimate_thoroughly().verdict.message
        again = forgetful(work)
        assert again.estimate_thoroughly().verdict.message == message and message.endswith("Also tried: nothing.")
        assert len(rounds) == 1
        again.add_keyframe(prepare(frames[4], recipe))
        again.estimate_thoroughly()
        assert len(rounds) == 2  # another keyframe, other matches
        checkpoint.save(store, again, final=False)
    with closing(Store(config.checkpoint)) as store:  # the next process
        restored = checkpoint.restore(store, recipe).work
        assert forgetful(restored).estimate_thoroughly().verdict.message.endswith("Also tried: nothing.")
        assert len(rounds) == 2
        assert make_fallback_key(restored.graph, recipe) == make_fallback_key(again.graph, recipe)
        longer = msgspec.structs.replace(recipe, fallbacks=msgspec.structs.replace(recipe.fallbacks, budget=9.0))
        assert make_fallback_key(restored.graph, longer) != make_fallback_key(restored.graph, recipe)


def test_what_gained_nothing_is_kept_as_soon_as_a_scene_was_judged(config, rounds):
    with closing(Store(config.checkpoint)) as store:
        node = Node(config, store)
        node.active.add_keyframes(node.keyframes(places(seeds=(0, 1))[:4]))
        node.active.finalize()
        tried = len(rounds)
    with closing(Store(config.checkpoint)) as store:
        found = checkpoint.restore(store, config.reconstruction)
        again = Node(config, store)
        again.active.resume(found)
        again.active.settled = False
        again.active.finalize()
    assert tried > 0 and len(rounds) == tried


def test_making_a_scene_final_takes_no_more_fallbacks_than_its_budget(config, monkeypatch):
    spent = []

    def climb_for_ever(estimate, rejected, recipe, run):
        began = time.monotonic()
        try:
            while True:
                time.sleep(0.01)
                run.pause()
        finally:
            spent.append(time.monotonic() - began)

    frames = photographs()[:3]
    with closing(Store(config.checkpoint)) as store:
        node = Node(msgspec.structs.replace(config, fallback_timeout_s=0.3), store)
        node.active.add_keyframes(node.keyframes(frames))
        for at in range(2):  # what does not belong to the scene, and is tried with it in several ways
            frame = replace(places(seeds=(0, 1))[3 + at], name=f"other{at}.png", frame_id=10 + at)
            node.active._work.add_keyframe(prepare(frame, node.recipe))
            node.active._work.defer_keyframes([frame.name])
        monkeypatch.setattr(incremental, "run_fallbacks", climb_for_ever)
        node.active.finalize()
        assert node.active.state in (ReconState.IDLE, ReconState.LOST)
    assert spent and sum(spent) < 0.5


def test_a_pause_does_not_count_as_fallback_time(monkeypatch):
    work = IncrementalReconstruction(Recipe(no_fallbacks=False))
    for frame in photographs()[:2]:
        work.add_keyframe(prepare(frame, work.config))
    done = []

    def run_fallbacks(estimate, rejected, recipe, run):
        run.pause()
        done.append(True)
        return estimate

    monkeypatch.setattr(incremental, "run_fallbacks", run_fallbacks)
    with work.fallback_budget(0.2):
        work.estimate_thoroughly(RunContext(lambda: time.sleep(0.25)))
    assert done


def test_what_an_earlier_process_stored_comes_before_what_comes_now_and_counts_as_waiting(config, monkeypatch):
    with closing(Store(config.checkpoint)) as store:
        recipe, inbox = config.reconstruction, Inbox()
        stored = store_all(store, photographs())
        keyframes = [ArrivedKeyframe(prepare(each.frame, recipe), time.monotonic()) for each in stored]
        node = Worker(config, store, inbox, lambda _: None, threading.Event())
        node.loading = 0
        node._backlog = keyframes[:5]
        inbox.enqueue([keyframes[5]], threading.Event())
        taken = []
        monkeypatch.setattr(node.active, "add_keyframes", taken.append)
        assert node.delay[0] > 0
        for _ in range(3):
            node._process_events(0.0)
    assert taken == [keyframes[:BATCH], keyframes[BATCH:5], keyframes[5:]]
