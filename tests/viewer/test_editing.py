"""Crop and clean-up: what is taken away, undo, and the new result, which overwrites nothing."""

from __future__ import annotations

import numpy as np
import pytest

from splatnode.recon.result.export.limits import Box, Selection
from splatnode.recon.result.snapshot import SHELL, GaussianArrays, encode_unconfirmed
from splatnode.viewer.session import (
    EditError,
    Session,
    add_edit,
    apply_edits,
    box,
    box_lines,
    compute_crop_bounds,
    edit_lines,
    write_edited,
)
from splatnode.viewer.sources import FixedSource, load_result
from splatnode.viewer.state import Graph, Moment, ViewerState
from tests.viewer.test_scene import camera, moment, together, wall

LEFT_HALF = Selection(box=Box((-1.0, -1.0, 0.0), (0.0, 1.0, 2.0)))
SEEN = Selection(only_seen=True)


def two_walls() -> Moment:
    """One that two photographs confirm, and behind it a guess and a shell."""
    parts = wall(9), wall(9, depth=1.5, source=encode_unconfirmed(0)), wall(5, depth=9.0, half=3.0, source=SHELL)
    return moment(together(*parts), camera(0.0), camera(0.1, frame_id=1))


def test_edits_take_away_one_after_another():
    gaussians = two_walls().snapshot.gaussians
    assert apply_edits(gaussians, ()) is gaussians
    assert (apply_edits(gaussians, (SEEN,)).means[:, 2] == 1.0).all()
    both = apply_edits(gaussians, (SEEN, LEFT_HALF))
    assert len(both) == 45 and (both.means[:, 0] <= 0).all()
    assert len(apply_edits(gaussians, (Selection(box=Box((8, 8, 8), (9, 9, 9))),))) == 0


def test_what_cannot_be_done_is_told_and_changes_nothing():
    there = two_walls()
    assert add_edit(there, (), SEEN) == (SEEN,)
    with pytest.raises(EditError, match="nothing to take away"):
        add_edit(there, (SEEN,), SEEN)
    with pytest.raises(EditError, match="Nothing would be left"):
        add_edit(there, (), Selection(box=Box((8, 8, 8), (9, 9, 9))))
    with pytest.raises(EditError, match="does not tell which"):
        add_edit(moment(wall(5, source=SHELL), camera(0.0)), (), SEEN)
    with pytest.raises(EditError, match="single scene"):
        add_edit(Moment(there.snapshot, 0.0, graph=Graph((), (), 0, 1, False)), (), LEFT_HALF)


def test_the_room_holds_what_was_photographed_and_boxes_are_cut_from_it():
    corners = compute_crop_bounds(two_walls())
    assert (corners[0] < [-0.3, -0.3, 1.0]).all() and (corners[1] > [0.3, 0.3, 1.0]).all() and corners[1, 2] < 1.5
    whole = box(corners, ((0.0, 1.0), (0.0, 1.0), (0.0, 1.0)))
    assert np.allclose([whole.least, whole.most], corners)
    half = box(corners, ((0.5, 1.0), (0.0, 1.0), (0.9, 0.1)))  # the last one is upside down: as thin as can be
    assert half.least[0] == pytest.approx(corners[:, 0].mean()) and half.least[2] < half.most[2]
    edges = box_lines(whole).ends
    assert edges.shape == (12, 2, 3) and np.allclose((edges[:, 0] != edges[:, 1]).sum(1), 1)
    assert compute_crop_bounds(moment(GaussianArrays.empty())).shape == (2, 3)


def test_a_session_crops_undoes_and_saves_as_a_new_result(tmp_path):
    there = two_walls()
    session = Session(FixedSource(there), ViewerState(advice=False))
    session.receive()
    with pytest.raises(EditError, match="nothing new"):
        session.save(tmp_path)
    session.keep_seen()
    session.state = ViewerState(advice=False, edits=session.state.edits, box=((0.0, 0.5), (0.0, 1.0), (0.0, 1.0)))
    session.crop()
    assert len(session.gaussians()) == 45 and edit_lines(there, session.state.edits) == [
        "45 of 187 Gaussians left (2 steps)."
    ]
    first, second = session.save(tmp_path), session.save(tmp_path)
    assert first != second
    again = load_result(first)
    assert np.allclose(again.snapshot.gaussians.means, session.gaussians().means)
    assert (again.snapshot.gaussians.source_frame == 0).all() and len(again.snapshot.cameras) == 2
    session.press("z")
    assert len(session.gaussians()) == 81
    session.press("z")
    session.press("z")
    assert len(session.gaussians()) == 187 and len(there.snapshot.gaussians) == 187
    session.close()


def test_another_place_begins_without_edits():
    feed = FixedSource(two_walls())
    session = Session(feed, ViewerState(advice=False, edits=(SEEN,), measured=(np.zeros(3),)))
    session.receive()
    feed._moment = Moment(two_walls().snapshot, 1.0, "elsewhere")
    session.receive()
    assert session.state.edits == () and session.state.measured == ()
    session.close()


def test_sources_that_do_not_fit_the_scene_are_told_and_left_out(tmp_path, caplog):
    new = write_edited(two_walls(), (SEEN,), tmp_path)
    (new / "sources.bin").write_bytes(b"1234")
    assert (load_result(new).snapshot.gaussians.source_frame == SHELL).all()
    assert "not known which photographs" in caplog.text
