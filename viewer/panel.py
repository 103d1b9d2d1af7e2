"""The panel beside the picture: buttons that stay where they are, tabs, and below them what was done last.

Its controls have their labels: switches, lists to choose from, sliders, and words that are wrapped.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import replace

from open3d.visualization import gui  # pyright: ignore[reportMissingImports]

from splatnode.capture.process.text import sanitize_text
from splatnode.recon.result.verdict import Code
from splatnode.viewer import text as viewer_text
from splatnode.viewer.editing import edit_lines
from splatnode.viewer.session import Session
from splatnode.viewer.shapes import measurement_lines
from splatnode.viewer.state import POINT_SIZES, Colouring, Engine, ViewerState, go_to_camera, go_to_moment, moment_index

LINE = 46  # characters that fit into the panel's width
Change = Callable[[ViewerState], None]


class Words:
    """A label whose text is wrapped, and that asks for another layout only where it changes."""

    def __init__(self, window: gui.Window, parent: gui.Layout1D, text: str = "") -> None:
        self.label = gui.Label(text)
        self._window = window
        parent.add_child(self.label)

    def say(self, lines: Sequence[str]) -> None:
        text = "\n".join(textwrap.fill(sanitize_text(line), LINE) for line in lines)
        if self.label.text != text:
            self.label.text = text
            self._window.set_needs_layout()


class Controls:
    """Makes controls of which each turns the state into another one; before the first `follow` they do nothing."""

    def __init__(self, change: Change) -> None:
        self._change = change
        self._session: Session | None = None

    def follow(self, session: Session) -> None:
        """From now on the state is that of this session."""
        self._session = session

    def switch(self, parent: gui.Widget, field: str, text: str) -> gui.Checkbox:
        """A check box for a field of the state."""
        box = gui.Checkbox(text)
        box.set_on_checked(lambda checked: self._apply(lambda state: replace(state, **{field: checked})))
        parent.add_child(box)
        return box

    def choice(
        self, parent: gui.Widget, items: list[str], changed: Callable[[ViewerState, int, str], ViewerState]
    ) -> gui.Combobox:
        """A drop-down list; `changed` gets the state, the index and the text of what was chosen."""
        box = gui.Combobox()
        for item in items:
            box.add_item(item)
        box.set_on_selection_changed(lambda text, index: self._apply(lambda state: changed(state, int(index), text)))
        parent.add_child(box)
        return box

    def slider(
        self, parent: gui.Widget, kind, changed: Callable[[ViewerState, Session, float], ViewerState]
    ) -> gui.Slider:
        slider = gui.Slider(kind)

        def handle_change(value) -> None:
            if self._session is not None:
                self._change(changed(self._session.state, self._session, value))

        slider.set_on_value_changed(handle_change)
        parent.add_child(slider)
        return slider

    def _apply(self, changed: Callable[[ViewerState], ViewerState]) -> None:
        if self._session is not None:
            self._change(changed(self._session.state))


def button(parent: gui.Widget, text: str, pressed: Callable[[], None]) -> gui.Button:
    made = gui.Button(text)
    made.horizontal_padding_em, made.vertical_padding_em = 0.4, 0.1
    made.set_on_clicked(pressed)
    parent.add_child(made)
    return made


def column(window: gui.Window) -> gui.ScrollableVert:
    """Creates the column of controls of a tab."""
    em = window.theme.font_size
    return gui.ScrollableVert(round(0.3 * em), gui.Margins(round(0.5 * em)))


# The tab with the photographs: those that are placed, to go to, and those that were left out, with the reasons.

_ROWS = 12  # of the list that are seen at a time
_MOST_DROPPED = 200  # that are listed


class PhotographsTab:
    def __init__(self, window: gui.Window, change: Change) -> None:
        self.root = column(window)
        self._change = change
        self._session: Session | None = None
        self._names: tuple[str, ...] = ()
        controls = self._controls = Controls(change)
        self._free = button(self.root, "Leave the photograph (x)", lambda: self._select_image(-1))
        Words(window, self.root, "Photograph over the picture, at its camera (, and .)")
        self._blend = controls.slider(self.root, gui.Slider.DOUBLE, lambda s, _, value: replace(s, blend=value))
        self._blend.set_limits(0.0, 1.0)
        self._placed = Words(window, self.root, "Placed")
        self._list = gui.ListView()
        self._list.set_max_visible_items(_ROWS)
        self._list.set_on_selection_changed(lambda _text, _twice: self._select_image(self._list.selected_index))
        self.root.add_child(self._list)
        self._bounds = Words(window, self.root)
        self._dropped = Words(window, self.root)

    def show(self, session: Session) -> None:
        self._session = session
        self._controls.follow(session)
        state, moment = session.state, session.moment
        if moment is None:
            return
        names = tuple(camera.name for camera in moment.snapshot.cameras)
        if names != self._names:
            self._names = names
            self._list.set_items([sanitize_text(name) for name in names])
            self._placed.say([f"Placed: {len(names)}. A click goes there (n and p: the next, the one before)."])
        index = names.index(state.camera) if state.camera in names else -1
        if self._list.selected_index != index:
            self._list.selected_index = index
        self._free.enabled = index >= 0
        self._blend.enabled = session.camera_image() is not None
        self._blend.double_value = state.blend
        camera = session.camera() if index >= 0 else None
        known = [*viewer_text.bounds_lines(moment, camera), *viewer_text.depth_lines(moment, camera)]
        self._bounds.say(known if index >= 0 else [])
        left_out = viewer_text.rejection_lines(moment, _MOST_DROPPED)
        self._dropped.say([f"Left out: {len(moment.snapshot.dropped)}", *left_out])

    def _select_image(self, index: int) -> None:
        if self._session is not None:
            name = self._names[index] if 0 <= index < len(self._names) else None
            self._change(go_to_camera(self._session.state, name))


# The tab with what there is to say of the scene: verdict, next view, bounds, places, numbers.

_GOOD, _BAD = gui.Color(0.5, 0.9, 0.5), gui.Color(1.0, 0.65, 0.4)


class SceneTab:
    def __init__(self, window: gui.Window) -> None:
        self.root = column(window)
        names = ("verdict", "advice", "scale", "bounds", "places", "counts")
        self._words = {name: Words(window, self.root) for name in names}

    def show(self, session: Session, seconds: float | None) -> None:
        state, moment, analysis, age = session.state, session.moment, session.analysis(), session.source.age_s
        if moment is None:
            self._words["verdict"].say([viewer_text.waiting_line(age)])
            return
        self._words["verdict"].label.text_color = _GOOD if moment.snapshot.verdict.code is Code.OK else _BAD
        self._words["verdict"].say(viewer_text.verdict_lines(moment))
        advice = viewer_text.advice_line(analysis.advice if analysis else None, moment)
        self._words["advice"].say([f"Next view: {advice}"])
        self._words["scale"].say(viewer_text.scale_lines(moment, session.ground()))
        camera = session.camera()
        self._words["bounds"].say([*viewer_text.bounds_lines(moment, camera), *viewer_text.depth_lines(moment, camera)])
        self._words["places"].say(viewer_text.place_lines(moment))
        rate = [f"{1 / seconds:.0f} pictures/s ({1000 * seconds:.0f} ms each)"] if seconds else []
        feed = viewer_text.feed_line(age, moment.snapshot.final) + (", paused" if state.paused else "")
        self._words["counts"].say([*viewer_text.count_lines(moment), *rate, feed])


# The tab with what is shown and how: switches, colours, who draws, and where in time.

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
    ("given", "given poses (0)"),
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
        self._when.say([f"Time: {viewer_text.time_line(state, history)}"])
        self._time.enabled = len(history) > 1
        self._time.set_limits(0, max(len(history) - 1, 1))
        self._time.int_value = moment_index(state, history)


# The tab with what can be done to the scene: measure, crop, clean up, undo, save.

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


_BUTTONS = (("Pause", "space"), ("Follow", "f"), ("Overview", "r"), ("Picture", "s"), ("Help", "h"))
_TOGGLES = {"space": "paused", "f": "follow", "h": "help"}  # key -> the field of the state that it switches on and off
_HEAD, _FOOT = 2.2, 5.5  # heights in letter widths of the theme


class Panel:
    """Its widgets follow the state; what the person does to them becomes another state, or a command by its key."""

    def __init__(self, window: gui.Window, change: Change, command: Callable[[str], None]) -> None:
        em = self._em = window.theme.font_size
        margins = gui.Margins(round(0.5 * em), round(0.3 * em), round(0.5 * em), round(0.3 * em))
        self._head, self._foot = gui.Horiz(round(0.3 * em), margins), gui.Vert(0, margins)
        self._toggles: dict[str, gui.Button] = {}
        for text, key in _BUTTONS:
            made = button(self._head, text, lambda key=key: command(key))
            if key in _TOGGLES:
                made.toggleable = True
                self._toggles[_TOGGLES[key]] = made
        self._scene = SceneTab(window)
        self._show, self._photographs = ShowTab(window, change), PhotographsTab(window, change)
        self._tools = ToolsTab(window, change, command)
        self._tabs = gui.TabControl()
        named = (("Scene", self._scene), ("Show", self._show), ("Photographs", self._photographs))
        for name, tab in (*named, ("Tools", self._tools)):
            self._tabs.add_tab(name, tab.root)
        self._notice = Words(window, self._foot)
        self.widgets = (self._head, self._tabs, self._foot)

    def lay_out(self, frame: gui.Rect) -> None:
        head, foot = round(_HEAD * self._em), round(_FOOT * self._em)
        self._head.frame = gui.Rect(frame.x, frame.y, frame.width, head)
        self._tabs.frame = gui.Rect(frame.x, frame.y + head, frame.width, max(frame.height - head - foot, 1))
        self._foot.frame = gui.Rect(frame.x, frame.get_bottom() - foot, frame.width, foot)

    def show(self, session: Session, seconds: float | None, notice: str) -> None:
        """Everything as it is now; `seconds` is what a picture takes, None where that is not known."""
        for field, toggle in self._toggles.items():
            toggle.is_on = getattr(session.state, field)
        self._scene.show(session, seconds)
        for tab in (self._show, self._photographs, self._tools):
            tab.show(session)
        self._notice.say([notice] if notice else [])
