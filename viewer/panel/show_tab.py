"""The tab with what is shown and how: switches, colours, who draws, and where in time."""

from __future__ import annotations

from dataclasses import replace

from open3d.visualization import gui  # pyright: ignore[reportMissingImports]

from splatnode.viewer import words
from splatnode.viewer.panel.controls import Change, Controls, Words, column
from splatnode.viewer.session import Session
from splatnode.viewer.state import POINT_SIZES, Colouring, Engine, go_to_moment, moment_index

_SWITCHES = (
    ("gaussians", "Gaussians (1)"),
    ("as_points", "as points (g)"),
    ("cameras", "cameras (2)"),
    ("photographs", "photographs (3)"),
    ("path", "path (4)"),
    ("tracked", "live camera (5)"),
    ("advice", "next view (6)"),
    ("uncertainty", "uncertainty (7)"),
    ("graph", "graph of a map (8)"),
    ("ground", "ground, axes (9)"),
)


class ShowTab:
    def __init__(self, window: gui.Window, change: Change) -> None:
        self.root = column(window)
        controls = self._controls = Controls(change)
        pairs = gui.VGrid(2, round(0.3 * window.theme.font_size))
        self._switches = {field: controls.switch(pairs, field, text) for field, text in _SWITCHES}
        self.root.add_child(pairs)
        Words(window, self.root, "Colour of the Gaussians (c)")
        self._colouring = controls.choice(
            self.root, [c.value for c in Colouring], lambda s, i, _: replace(s, colouring=list(Colouring)[i])
        )
        Words(window, self.root, "Drawn by (e)")
        self._engine = controls.choice(
            self.root, [e.value for e in Engine], lambda s, i, _: replace(s, engine=list(Engine)[i])
        )
        Words(window, self.root, "Size of the points, in pixels ([ and ])")
        self._points = controls.slider(
            self.root, gui.Slider.INT, lambda s, _, value: replace(s, point_size=int(value), as_points=True)
        )
        self._points.set_limits(*POINT_SIZES)
        self._when = Words(window, self.root, "Time")
        self._time = controls.slider(
            self.root, gui.Slider.INT, lambda s, session, value: go_to_moment(s, session.history, int(value))
        )

    def show(self, session: Session) -> None:
        self._controls.follow(session)
        state, history = session.state, session.history
        for field, switch in self._switches.items():
            switch.checked = getattr(state, field)
        self._points.int_value = state.point_size
        self._colouring.selected_index = list(Colouring).index(state.colouring)
        self._engine.selected_index = list(Engine).index(state.engine)
        self._when.say([f"Time: {words.time_line(state, history)}"])
        self._time.enabled = len(history) > 1
        self._time.set_limits(0, max(len(history) - 1, 1))
        self._time.int_value = moment_index(state, history)
