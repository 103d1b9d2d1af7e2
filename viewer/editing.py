"""Crop and clean-up: what is taken out of the scene that is shown, step by step, and the new result that is written.

The file that was opened, and the scene of the node, stay as they are.
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export import SceneFileError, sanitize_gaussians, write_files
from splatnode.recon.result.export.formats.ply import encode_ply
from splatnode.recon.result.export.limits import Box, Selection
from splatnode.recon.result.export.stored import SOURCES, encode_cameras, encode_sources
from splatnode.recon.result.snapshot import SHELL, GaussianArrays, find_confirmed
from splatnode.viewer.shapes import Colour, Lines
from splatnode.viewer.state import Moment, Span
from splatnode.viewer.viewpoint import scene_pivot, scene_spread

Edits = tuple[Selection, ...]  # in the order in which they were made; undo takes the last one away

BOX_COLOUR: Colour = (1.0, 0.6, 0.9)
_AROUND = 3.0  # times the median distance from the middle: what is farther does not widen the room
_WITHIN = (0.5, 99.5)  # percent of the Gaussians, on each axis
_WIDER = 0.05  # of the room, on each side
_SMALLEST = 1e-5  # of how far it is away, a room
_THINNEST = 0.01  # of the room, a box


class EditError(Exception):
    """An edit cannot be applied; the message says why."""


def apply_edits(gaussians: GaussianArrays, edits: Edits) -> GaussianArrays:
    """Returns the Gaussians that the edits leave, or none where one of the edits leaves nothing."""
    try:
        for edit in edits:
            gaussians = edit.apply(gaussians, "the scene")
    except SceneFileError:  # a scene that changed since: what was asked for is not in it any more
        return GaussianArrays.empty()
    return gaussians


def add_edit(moment: Moment, edits: Edits, edit: Selection) -> Edits:
    """The edits with another one. Raises EditError where it cannot be told what it leaves, or where that is nothing."""
    if moment.graph is not None:
        raise EditError("A map shows only what is near: cut a single scene, or use splatnode export --crop.")
    before = apply_edits(moment.snapshot.gaussians, edits)
    if edit.only_seen and not (before.source_frame != SHELL).any():
        raise EditError(
            f"This file does not tell which Gaussians two photographs confirm: that is in the {SOURCES} of a result."
        )
    try:
        after = edit.apply(before, "the scene")
    except SceneFileError:
        raise EditError("Nothing would be left: nothing was changed.") from None
    if len(after) == len(before):
        raise EditError("There was nothing to take away.")
    return (*edits, edit)


def compute_crop_bounds(moment: Moment) -> npt.NDArray[np.float64]:
    """(2, 3) the least and the greatest corner of the room that boxes are cut from: around what was photographed.

    That is what two photographs confirm, where it is known; without the far and a few in a hundred in any case.
    """
    gaussians = moment.snapshot.gaussians
    confirmed = find_confirmed(gaussians.source_frame)
    means = (gaussians.means[confirmed] if confirmed.any() else gaussians.means).astype(np.float64)
    if not len(means):
        return np.array([[-1.0] * 3, [1.0] * 3])
    pivot = scene_pivot(moment)
    near = means[np.linalg.norm(means - pivot, axis=1) <= _AROUND * scene_spread(moment, pivot)]
    least, most = np.percentile(near if len(near) else means, _WITHIN, axis=0)
    wider = _WIDER * np.maximum(most - least, _SMALLEST * (1.0 + np.abs(most)))
    return np.array([least - wider, most + wider])


def box(corners: npt.NDArray[np.float64], spans: tuple[Span, Span, Span]) -> Box:
    """The box that the spans cut from a room (2, 3)."""
    least, size = corners[0], corners[1] - corners[0]
    sides = [
        (float(start + length * low), float(start + length * max(high, low + _THINNEST)))
        for start, length, (low, high) in zip(least, size, spans, strict=True)
    ]
    (x0, x1), (y0, y1), (z0, z1) = sides
    return Box((x0, y0, z0), (x1, y1, z1))


def box_lines(cut: Box) -> Lines:
    """Its twelve edges."""
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    at = np.where(corners == 0, np.array(cut.least), np.array(cut.most))
    ends = [(at[a], at[b]) for a in range(8) for b in range(a + 1, 8) if np.abs(corners[a] - corners[b]).sum() == 1]
    return Lines(np.array(ends), BOX_COLOUR, 2)


def edit_lines(moment: Moment, edits: Edits) -> list[str]:
    """Describes how many Gaussians the edits leave."""
    if not edits:
        return ["Nothing is taken away yet."]
    whole, left = len(moment.snapshot.gaussians), len(apply_edits(moment.snapshot.gaussians, edits))
    return [f"{left} of {whole} Gaussians left ({len(edits)} step{'s' * (len(edits) != 1)})."]


def write_edited(moment: Moment, edits: Edits, folder: Path) -> Path:
    """Writes what is left as a new result in a new folder of `folder`, which it returns; nothing is overwritten.

    Raises EditError where nothing was taken away or nothing is left, ResultWriteError.
    """
    if not edits:
        raise EditError("Nothing was taken away: there is nothing new to save.")
    snapshot = moment.snapshot
    left = sanitize_gaussians(apply_edits(snapshot.gaussians, edits))
    if not len(left):
        raise EditError("Nothing is left: there is nothing to save.")
    files = {"scene.ply": encode_ply(left, snapshot.scale)}
    if snapshot.cameras:
        files["cameras.json"] = encode_cameras(snapshot.cameras, snapshot.scale)
    if (left.source_frame != SHELL).any():
        files[SOURCES] = encode_sources(left.source_frame)
    new = _new_folder(folder)
    write_files(new, files)
    return new


def _new_folder(folder: Path) -> Path:
    """A name that nothing has yet."""
    stem = time.strftime("edited_%Y%m%d_%H%M%S")
    names = [stem, *(f"{stem}_{number}" for number in range(2, 1000))]
    return next(folder / name for name in names if not (folder / name).exists())
