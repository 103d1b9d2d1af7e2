"""The window: a picture that is turned with the mouse, and a panel with words and switches.

Everything runs in the main thread, as Open3D asks; what comes from elsewhere is looked for at each tick, and only the
newest counts. The panel has buttons that stay where they are, tabs, and below them what was done last. Its controls
have their labels: switches, lists to choose from, sliders, and words that are wrapped.
"""

from __future__ import annotations

import signal
import textwrap
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import open3d as o3d  # pyright: ignore[reportMissingImports]
from open3d.visualization import gui  # pyright: ignore[reportMissingImports]

from splatnode.capture.image_file import encode_png
from splatnode.capture.process.text import sanitize_text
from splatnode.recon.result.export import ResultWriteError, write_files
from splatnode.recon.result.verdict import Code
from splatnode.viewer import session
from splatnode.viewer import session as viewer_text
from splatnode.viewer.session import EditError, Session, edit_lines
from splatnode.viewer.shapes import measurement_lines
from splatnode.viewer.stage import Image, WindowStage
from splatnode.viewer.state import (
    POINT_SIZES,
    Colouring,
    Engine,
    ViewerState,
    go_to_camera,
    go_to_moment,
    help_lines,
    moment_index,
    open3d_draws,
    orbit,
    pan,
    zoom,
)

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
        for label, key in _BUTTONS:
            made = button(self._head, label, lambda key=key: command(key))
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


# What can be done with mouse and keys, on a sheet over the picture.


class HelpSheet:
    """Two columns, each one label: in a grid the rows would stand far apart."""

    def __init__(self, window: gui.Window) -> None:
        em = window.theme.font_size
        self._window = window
        self.root = gui.Horiz(round(em), gui.Margins(round(em)))
        self.root.background_color = gui.Color(0.1, 0.11, 0.13, 0.92)
        self.root.visible = False
        for column in zip(*help_lines(), strict=True):
            self.root.add_child(gui.Label("\n".join(column)))

    def lay_out(self, context: gui.LayoutContext, area: gui.Rect) -> None:
        """In the middle of `area`, as large as it must be."""
        wanted = self.root.calc_preferred_size(context, gui.Widget.Constraints())
        width, height = min(wanted.width, area.width), min(wanted.height, area.height)
        self.root.frame = gui.Rect(
            area.x + (area.width - width) // 2, area.y + (area.height - height) // 2, width, height
        )

    def show(self, shown: bool) -> None:
        if self.root.visible != shown:
            self.root.visible = shown
            self._window.set_needs_layout()


# The pointer over the picture: it orbits, pans and zooms, or goes to the camera that was clicked.

_TURN_PER_PIXEL = 0.006  # radians
_ZOOM_PER_NOTCH = 0.88
_CLICK_PX = 4  # a pointer that moves less between press and release clicks


class Pointer:
    """Remembers between events where it went down, and what it has done since."""

    def __init__(self, session: Session) -> None:
        self.dragging = False
        self._session = session
        self._pressed: tuple[float, float] | None = None  # where it went down, None: it is up
        self._last = (0.0, 0.0)

    def handle_event(self, event: gui.MouseEvent, x: float, y: float, size: tuple[int, int]) -> bool:
        """Handles an event at a pixel of the picture, which has this size; returns whether it changes the picture."""
        if event.type == gui.MouseEvent.Type.BUTTON_DOWN:
            self._pressed = self._last = (x, y)
        elif event.type == gui.MouseEvent.Type.DRAG and self._pressed is not None:
            return self._drag(event, x, y, size)
        elif event.type == gui.MouseEvent.Type.BUTTON_UP and self._pressed is not None:
            if not self.dragging:
                self._session.click(x, y, *size)
            self._pressed, self.dragging = None, False
            return True
        elif event.type == gui.MouseEvent.Type.WHEEL:
            view = self._session.viewpoint_to_move()
            if view is not None:
                self._session.move(zoom(view, _ZOOM_PER_NOTCH**event.wheel_dy))
                return True
        return False

    def _drag(self, event: gui.MouseEvent, x: float, y: float, size: tuple[int, int]) -> bool:
        start = self._pressed or (x, y)
        if not self.dragging and max(abs(x - start[0]), abs(y - start[1])) < _CLICK_PX:
            return False
        view = self._session.viewpoint_to_move()
        right, down = x - self._last[0], y - self._last[1]
        self._last, self.dragging = (x, y), True
        if view is None:
            return False
        if event.is_button_down(gui.MouseButton.LEFT):
            self._session.move(orbit(view, -_TURN_PER_PIXEL * right, _TURN_PER_PIXEL * down))
        else:
            self._session.move(pan(view, right, down, float(view.K(*size)[0, 0])))
        return True


_IDLE_AFTER_S = 1.0  # without anything to do, ticks begin to sleep
_IDLE_SLEEP_S = 0.05  # Open3D ticks a hundred times a second, which would take 2 % of a processor
_WORDS_EVERY_S = 0.5  # the panel's words are brought up to date: times and ages in them change by themselves
_OPENED_AT = 3  # ticks: the first picture is on the screen then
_PANEL_EMS = 22  # the panel's width, in letter widths of the theme
_KEYS = {
    gui.KeyName.SPACE: "space",
    gui.KeyName.LEFT: "left",
    gui.KeyName.RIGHT: "right",
}


def show(
    session: Session,
    *,
    software: bool,
    screenshots: Path,
    opened: Callable[[], None] = lambda: None,
    size: tuple[int, int],
) -> None:
    """Opens the window, calls `opened` once something is drawn, and returns when it is closed.

    Raises what went wrong while it was open.

    `software`: Vulkan runs on the processor. There the project's own rasteriser draws, unless the person asks for
    Open3D; its splat shader is not used even then, because it leaves whole rows of its tiles black.
    """
    # It would say, at each picture, which of the far shell's Gaussians are too wide for it.
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    app = gui.Application.instance
    app.initialize()
    state = session.state
    session.state = replace(state, engine=Engine.CORE if software else Engine.OPEN3D)
    window = _Window(app, session, software, screenshots, size, opened)
    # A handler that raises would do so where Open3D calls Python, before anything there can catch it.
    handlers = {number: signal.signal(number, window.stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        app.run()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        session.close()
    if window.error is not None:
        raise window.error


class _Window:
    def __init__(
        self,
        app: gui.Application,
        session: Session,
        software: bool,
        screenshots: Path,
        size: tuple[int, int],
        opened: Callable[[], None],
    ) -> None:
        self.error: BaseException | None = None
        self._software = software
        self._app, self._session, self._screenshots = app, session, screenshots
        self._window = app.create_window("splatnode", *size)
        self._stage = WindowStage(self._window, software)
        self._panel = Panel(self._window, self._guard_callback(self._change), self._guard_callback(self._command))
        self._help = HelpSheet(self._window)
        for widget in (self._stage.picture, self._stage.scene, *self._panel.widgets, self._help.root):
            self._window.add_child(widget)
        self._stage.picture.set_on_mouse(self._guard_callback(self._mouse, gui.ImageWidget.EventCallbackResult.HANDLED))
        self._stage.scene.set_on_mouse(self._guard_callback(self._mouse, gui.Widget.EventCallbackResult.CONSUMED))
        self._window.set_on_layout(self._guard_callback(self._layout))
        self._window.set_on_key(self._guard_callback(self._key, False))
        self._window.set_on_tick_event(self._guard_callback(self._tick, False))
        self._asked = True  # by the person, for another picture
        self._pointer = Pointer(session)
        self._analysed: object = None
        self._words_at = 0.0
        self._busy_at = 0.0
        self._stopped_by = 0  # a signal
        self._notice = ""
        self._opened = opened
        self._ticks = 0

    def stop(self, number: int, _frame: object) -> None:
        """The handler of a signal: closes the window at the next tick."""
        self._stopped_by = number

    def _guard_callback(self, function: Callable, otherwise: object = None) -> Callable:
        """`function`, whose exception ends the run of the window and is raised where it was opened."""

        def call(*arguments):
            try:
                return function(*arguments)
            except BaseException as error:
                self.error = self.error or error
                # Not from within: a window that goes while it is at work takes the process with it.
                self._app.post_to_main_thread(self._window, self._app.quit)
                return otherwise

        return call

    # ---- What happens by itself -----------------------------------------------------------------------------------

    def _tick(self) -> bool:
        """Looks for news and redraws where there are any."""
        self._ticks += 1
        if self._ticks == _OPENED_AT:
            self._opened()
        if self._stopped_by:
            raise KeyboardInterrupt if self._stopped_by == signal.SIGINT else SystemExit(0)
        news = self._session.receive()
        analysis = self._session.analysis()
        if analysis is not self._analysed:
            self._analysed, news = analysis, True
        if time.monotonic() - self._words_at > _WORDS_EVERY_S:
            self._say()
        if not (news or self._asked):
            if time.monotonic() - self._busy_at > _IDLE_AFTER_S:
                time.sleep(_IDLE_SLEEP_S)
            return self._stage.redraw_if_due()
        asked, self._asked, self._busy_at = self._asked, False, time.monotonic()
        self._stage.draw(self._session, asked, self._pointer.dragging)
        self._say()
        return True

    def _say(self) -> None:
        self._words_at = time.monotonic()
        state = self._session.state
        refused = state.engine is Engine.OPEN3D and not open3d_draws(state, self._software)
        self._panel.show(self._session, self._stage.paint_time_s, session.NO_SPLATS if refused else self._notice)
        self._help.show(self._session.state.help)

    def _layout(self, context: gui.LayoutContext) -> None:
        area = self._window.content_rect
        panel = min(round(_PANEL_EMS * self._window.theme.font_size), area.width // 2)
        frame = gui.Rect(area.x, area.y, area.width - panel, area.height)
        self._panel.lay_out(gui.Rect(area.get_right() - panel, area.y, panel, area.height))
        self._help.lay_out(context, frame)
        self._asked |= self._stage.lay_out(frame)  # otherwise the panel's words have changed, no more

    # ---- What the person does -------------------------------------------------------------------------------------

    def _change(self, state) -> None:
        self._session.state = state
        self._asked = True

    def _command(self, key: str) -> None:
        if key == "r":
            self._session.whole_scene()
        elif key == "s":
            self._screenshot()
        elif key in ("k", "o", "w"):
            self._edit(key)
        elif key == "q":
            self._window.close()
        else:
            self._session.press(key)
        self._asked = True

    def _edit(self, key: str) -> None:
        """Crops, cleans up or saves; what cannot be done is told."""
        try:
            if key == "k":
                self._session.crop()
            elif key == "o":
                self._session.keep_seen()
            else:
                self._notice = f"saved {self._session.save(self._screenshots)}: a new result to view or export"
                return
            self._notice = ""
        except (EditError, ResultWriteError) as error:
            self._notice = str(error)

    def _key(self, event: gui.KeyEvent) -> bool:
        if event.type != gui.KeyEvent.Type.DOWN:
            return False
        key = _KEYS.get(event.key) or (chr(event.key) if 32 < event.key < 127 else "")
        self._command(key)
        return bool(key)

    def _mouse(self, event: gui.MouseEvent):
        frame = self._stage.picture.frame
        self._asked |= self._pointer.handle_event(
            event, float(event.x - frame.x), float(event.y - frame.y), self._stage.size
        )
        return gui.Widget.EventCallbackResult.CONSUMED

    def _screenshot(self) -> None:
        path = self._screenshots / time.strftime("splatnode_%Y%m%d_%H%M%S.png")
        self._stage.take_image(self._session, self._guard_callback(lambda image: self._save(path, image)))

    def _save(self, path: Path, image: Image) -> None:
        write_files(path.parent, {path.name: encode_png(image)})
        self._notice = f"saved {path}"
