"""The panel beside the picture: switches first, which stay where they are, and below them words of any length."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from dataclasses import replace

from open3d.visualization import gui  # pyright: ignore[reportMissingImports]

from splatnode.capture.process.printable import printable
from splatnode.recon.result.verdict import Code
from splatnode.viewer import words
from splatnode.viewer.session import Session
from splatnode.viewer.state import POINT_SIZES, Colouring, Engine, State, go_to_camera, go_to_moment, moment_index

_LINE = 47  # characters that fit into the panel's width
_FREE = "free viewpoint"
_SWITCHES = (
    ("gaussians", "Gaussians (1)"),
    ("as_points", "as points (g)"),
    ("cameras", "cameras (2)"),
    ("photographs", "photographs (3)"),
    ("path", "path (4)"),
    ("tracked", "tracked camera (5)"),
    ("advice", "next view (6)"),
    ("uncertainty", "uncertainty (7)"),
    ("graph", "graph (8)"),
)
_BUTTONS = (("Pause", "space"), ("Follow", "f"), ("Overview", "r"), ("Save", "s"), ("Help", "h"))
_TOGGLES = {"space": "paused", "f": "follow", "h": "help"}  # key -> the field of the state that it switches on and off
_GOOD, _BAD = gui.Color(0.5, 0.9, 0.5), gui.Color(1.0, 0.65, 0.4)


class Panel:
    """Its widgets follow the state; what the person does to them becomes another state."""

    def __init__(self, window: gui.Window, change: Callable[[State], None], command: Callable[[str], None]) -> None:
        em = window.theme.font_size
        self._window, self._change = window, change
        self._session: Session | None = None
        self.root = gui.ScrollableVert(round(0.3 * em), gui.Margins(round(0.5 * em)))
        self._labels: dict[str, gui.Label] = {}
        buttons, self._toggles = gui.Horiz(round(0.3 * em)), dict[str, gui.Button]()
        for text, key in _BUTTONS:
            button = gui.Button(text)
            button.horizontal_padding_em, button.vertical_padding_em = 0.4, 0.1
            button.set_on_clicked(lambda key=key: command(key))
            if key in _TOGGLES:
                button.toggleable = True
                self._toggles[_TOGGLES[key]] = button
            buttons.add_child(button)
        self.root.add_child(buttons)
        pairs = gui.VGrid(2, round(0.3 * em))
        self._switches = {field: self._switch(pairs, field, text) for field, text in _SWITCHES}
        self.root.add_child(pairs)
        self._colouring = self._choice(
            [c.value for c in Colouring], lambda s, i, _: replace(s, colouring=list(Colouring)[i])
        )
        self._engine = self._choice([e.value for e in Engine], lambda s, i, _: replace(s, engine=list(Engine)[i]))
        self._cameras = self._choice([_FREE], lambda s, i, name: go_to_camera(s, name if i else None))
        self._names: tuple[str, ...] = ()
        self._points = self._slider("point size", gui.Slider.INT, lambda s, _, value: replace(s, point_size=int(value)))
        self._points.set_limits(*POINT_SIZES)
        self._blend = self._slider(
            "photograph over the render, at a camera", gui.Slider.DOUBLE, lambda s, _, value: replace(s, blend=value)
        )
        self._blend.set_limits(0.0, 1.0)
        self._time = self._slider("time", gui.Slider.INT, lambda s, past, value: go_to_moment(s, past, int(value)))
        for name in ("notice", "verdict", "advice", "bounds", "places", "counts", "dropped"):
            self._add_label(name)

    def show(self, session: Session, seconds: float | None, notice: str) -> None:
        """Everything as it is now; `seconds` is what a picture takes, None where that is not known."""
        self._session = session
        state, moment, analysis = session.state, session.moment, session.analysis()
        age = session.source.age_s
        feed = words.feed_line(age, bool(moment and moment.snapshot.final))
        rate = [f"{1 / seconds:.0f} pictures/s ({1000 * seconds:.0f} ms each)"] if seconds else []
        for field, button in self._toggles.items():
            button.is_on = getattr(state, field)
        for field, switch in self._switches.items():
            switch.checked = getattr(state, field)
        self._points.int_value = state.point_size
        self._colouring.selected_index = list(Colouring).index(state.colouring)
        self._engine.selected_index = list(Engine).index(state.engine)
        self._set("notice", [notice] if notice else [])
        if moment is None:
            self._set("verdict", [words.waiting_line(age)])
            return
        verdict = moment.snapshot.verdict
        self._labels["verdict"].text_color = _GOOD if verdict.code is Code.OK else _BAD
        self._set("verdict", words.verdict_lines(moment))
        self._set("advice", ["Next view: " + words.advice_line(analysis.advice if analysis else None, moment)])
        self._set("bounds", words.bounds_lines(moment, session.camera()))
        self._set("places", words.place_lines(moment))
        self._set("counts", [*words.count_lines(moment), *rate, feed + (", paused" if state.paused else "")])
        self._set("dropped", words.dropped_lines(moment))
        self._set("time", [words.time_line(state, session.history)])
        self._time.enabled = len(session.history) > 1
        self._time.set_limits(0, max(len(session.history) - 1, 1))
        self._time.int_value = moment_index(state, session.history)
        self._show_cameras(tuple(camera.name for camera in moment.snapshot.cameras), state.camera)
        self._blend.double_value = state.blend

    def _show_cameras(self, names: tuple[str, ...], chosen: str | None) -> None:
        if names != self._names:
            self._cameras.clear_items()
            for name in (_FREE, *names):
                self._cameras.add_item(name)
            self._names = names
        self._cameras.selected_index = 1 + names.index(chosen) if chosen in names else 0

    def _set(self, name: str, lines: list[str]) -> None:
        text = "\n".join(textwrap.fill(printable(line), _LINE) for line in lines)
        label = self._labels[name]
        if label.text != text:
            label.text = text
            self._window.set_needs_layout()

    def _add_label(self, name: str, text: str = "") -> None:
        self._labels[name] = gui.Label(text)
        self.root.add_child(self._labels[name])

    def _switch(self, grid: gui.VGrid, field: str, text: str) -> gui.Checkbox:
        switch = gui.Checkbox(text)
        switch.set_on_checked(
            lambda checked: self._session and self._change(replace(self._session.state, **{field: checked}))
        )
        grid.add_child(switch)
        return switch

    def _slider(self, name: str, kind, changed: Callable) -> gui.Slider:
        """A slider below its label, which is called by its first text."""
        self._add_label(name, name)
        slider = gui.Slider(kind)
        slider.set_on_value_changed(
            lambda value: self._session and self._change(changed(self._session.state, self._session.history, value))
        )
        self.root.add_child(slider)
        return slider

    def _choice(self, items: list[str], changed: Callable) -> gui.Combobox:
        box = gui.Combobox()
        for item in items:
            box.add_item(item)
        box.set_on_selection_changed(
            lambda text, index: self._session and self._change(changed(self._session.state, index, text))
        )
        self.root.add_child(box)
        return box
