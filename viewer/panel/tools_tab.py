"""The tab with what can be done to the scene: measure, crop, clean up, undo, save."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

from open3d.visualization import gui  # pyright: ignore[reportMissingImports]

from splatnode.viewer.editing import edit_lines
from splatnode.viewer.measuring import measurement_lines
from splatnode.viewer.panel.controls import Change, Controls, Words, button, column
from splatnode.viewer.session import Session
from splatnode.viewer.state import ViewerState

_AXES = ("x", "y", "z")


class ToolsTab:
    def __init__(self, window: gui.Window, change: Change, command: Callable[[str], None]) -> None:
        em = window.theme.font_size
        self.root = column(window)
        controls = self._controls = Controls(change)
        self._measure = button(self.root, "Measure between two clicks (d)", lambda: command("d"))
        self._measure.toggleable = True
        self._measured = Words(window, self.root)
        Words(window, self.root, "Crop")
        self._boxed = controls.switch(self.root, "boxed", "show the box (b)")
        self._sliders: list[list[gui.Slider]] = []
        for axis, name in enumerate(_AXES):
            Words(window, self.root, f"{name}: from, to")
            pair = gui.VGrid(2, round(0.3 * em))
            self._sliders.append([self._side(controls, pair, axis, end) for end in (0, 1)])
            self.root.add_child(pair)
        button(self.root, "Keep only what is in the box (k)", lambda: command("k"))
        Words(window, self.root, "Clean up")
        button(self.root, "Keep only what two photographs confirm (o)", lambda: command("o"))
        self._left = Words(window, self.root)
        last = gui.Horiz(round(0.3 * em))
        self._undo = button(last, "Undo (z)", lambda: command("z"))
        self._save = button(last, "Save as a new result (w)", lambda: command("w"))
        self.root.add_child(last)

    def _side(self, controls: Controls, parent: gui.Widget, axis: int, end: int) -> gui.Slider:
        slider = controls.slider(parent, gui.Slider.DOUBLE, lambda s, _, value: _set_box_side(s, axis, end, value))
        slider.set_limits(0.0, 1.0)
        return slider

    def show(self, session: Session) -> None:
        self._controls.follow(session)
        state, moment = session.state, session.moment
        self._measure.is_on = state.measuring
        self._boxed.checked = state.boxed
        for sliders, span in zip(self._sliders, state.box, strict=True):
            for slider, value in zip(sliders, span, strict=True):
                slider.double_value = value
        self._undo.enabled = self._save.enabled = bool(state.edits)
        if moment is not None:
            self._measured.say(measurement_lines(state.measured, state.measuring, moment.snapshot.scale))
            self._left.say(edit_lines(moment, state.edits))


def _set_box_side(state: ViewerState, axis: int, end: int, value: float) -> ViewerState:
    """Sets one end of one side of the box and shows the box, so that the person sees what moves."""
    sides = [list(span) for span in state.box]
    sides[axis][end] = value
    x, y, z = ((low, high) for low, high in sides)
    return replace(state, box=(x, y, z), boxed=True)
