"""The window: a picture that is turned with the mouse, and a panel with words and switches.

Everything runs in the main thread, as Open3D asks; what comes from elsewhere is looked for at each tick, and only the
newest counts.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import open3d as o3d  # pyright: ignore[reportMissingImports]
from open3d.visualization import gui  # pyright: ignore[reportMissingImports]

from splatnode.capture.image_file import encode_png
from splatnode.recon.result.export import ResultWriteError, write_files
from splatnode.viewer import text
from splatnode.viewer.editing import EditError
from splatnode.viewer.panel import Panel
from splatnode.viewer.session import Session
from splatnode.viewer.stage import Image, WindowStage
from splatnode.viewer.state import Engine, help_lines, open3d_draws
from splatnode.viewer.viewpoint import orbit, pan, zoom

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
        self._panel.show(self._session, self._stage.paint_time_s, text.NO_SPLATS if refused else self._notice)
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
