"""The window: a picture that is turned with the mouse, and a panel with words and switches.

Everything runs in the main thread, as Open3D asks; what comes from elsewhere is looked for at each tick, and only the
newest counts. Pictures by the project's own rasteriser go into an image widget, Open3D's into a scene widget; the
scene widget is there in any case, because without one Open3D 0.20 keeps the memory of every image that it has shown.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import open3d as o3d  # pyright: ignore[reportMissingImports]
from open3d.visualization import gui, rendering  # pyright: ignore[reportMissingImports]

from recon.export import write_file
from viewer import words
from viewer.canvas import BACKGROUND
from viewer.help_sheet import HelpSheet
from viewer.panel import Panel
from viewer.pointer import Pointer
from viewer.scene3d import Scene3D, image3d, look_from
from viewer.session import Session
from viewer.state import Engine, open3d_draws

Image = npt.NDArray[np.uint8]

_SMOOTH_S = 0.04  # a picture that takes longer is painted at half the resolution while the pointer drags it
_REDRAWN_S = (0.0, 0.0, 0.3, 1.0)  # after the last change the window is drawn again: Open3D may skip a drawing
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
    """Opens the window, calls `opened`, and returns when it is closed. Raises what went wrong while it was open.

    `software`: Vulkan is played by the processor. There the project's own rasteriser draws, unless the person asks for
    Open3D; its splat shader is not used even then, because it leaves whole rows of its tiles black.
    """
    # It would say, at each picture, which of the far shell's Gaussians are too wide for it.
    o3d.utility.set_verbosity_level(o3d.utility.VerbosityLevel.Error)
    app = gui.Application.instance
    app.initialize()
    state = session.state
    session.state = replace(state, engine=Engine.CORE if software else Engine.OPEN3D)
    window = _Window(app, session, software, screenshots, size)
    # A handler that raises would do so where Open3D calls Python, before anything there can catch it.
    handlers = {number: signal.signal(number, window.stop) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        opened()
        app.run()
    finally:
        for number, handler in handlers.items():
            signal.signal(number, handler)
        session.close()
    if window.error is not None:
        raise window.error


class _Window:
    def __init__(
        self, app: gui.Application, session: Session, software: bool, screenshots: Path, size: tuple[int, int]
    ) -> None:
        self.error: BaseException | None = None
        self._software = software
        self._app, self._session, self._screenshots = app, session, screenshots
        self._window = app.create_window("splatnode", *size)
        self._picture = gui.ImageWidget(image3d(np.full((8, 8, 3), BACKGROUND, np.uint8)))
        self._scene_widget = gui.SceneWidget()
        self._scene_widget.scene = rendering.Open3DScene(self._window.renderer)
        self._scene_widget.visible = False  # before it is first drawn: later, the memory is kept all the same
        self._scene = Scene3D(self._scene_widget.scene)
        self._panel = Panel(self._window, self._guarded(self._change), self._guarded(self._command))
        self._help = HelpSheet(self._window)
        for widget in (self._picture, self._scene_widget, self._panel.root, self._help.root):
            self._window.add_child(widget)
        self._picture.set_on_mouse(self._guarded(self._mouse, gui.ImageWidget.EventCallbackResult.HANDLED))
        self._scene_widget.set_on_mouse(self._guarded(self._mouse, gui.Widget.EventCallbackResult.CONSUMED))
        self._window.set_on_layout(self._guarded(self._layout))
        self._window.set_on_key(self._guarded(self._key, False))
        self._window.set_on_tick_event(self._guarded(self._tick, False))
        self._dirty = True
        self._size = (1, 1)  # of the picture, pixels
        self._pointer = Pointer(session)
        self._painted_s = 0.0  # how long the last full picture took
        self._shown: tuple[object, ...] = ()  # what the scene widget shows
        self._analysed: object = None
        self._words_at = 0.0
        self._redraw_at: list[float] = []  # times to come
        self._stopped_by = 0  # a signal
        self._notice = ""

    def stop(self, number: int, _frame: object) -> None:
        """The handler of a signal: closes the window at the next tick."""
        self._stopped_by = number

    def _guarded(self, function: Callable, otherwise: object = None) -> Callable:
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
        if self._stopped_by:
            raise KeyboardInterrupt if self._stopped_by == signal.SIGINT else SystemExit(0)
        if self._session.receive():
            self._dirty = True
        analysis = self._session.analysis()
        if analysis is not self._analysed:
            self._analysed, self._dirty = analysis, True
        if time.monotonic() - self._words_at > 0.5:
            self._say()
        if not self._dirty:
            return self._redraw_again()
        self._dirty = False
        self._draw()
        self._say()
        return True

    def _draw(self) -> None:
        session, (width, height) = self._session, self._size
        view = session.viewpoint()
        if view is None or width < 2 or height < 2:
            return
        blends = session.state.blend > 0 and session.photograph() is not None
        own = blends or not open3d_draws(session.state, self._software)
        if self._picture.visible != own or self._scene_widget.visible == own:
            self._picture.visible, self._scene_widget.visible = own, not own
            self._scene.set_drawing(not own)
        self._redraw_at = [time.monotonic() + after for after in _REDRAWN_S]
        started = time.perf_counter()
        if own:
            half = self._pointer.dragging and self._painted_s > _SMOOTH_S
            image = session.paint(*((width // 2, height // 2) if half else (width, height)))
            if image is not None:
                self._picture.update_image(image3d(image))
            if not half:
                self._painted_s = time.perf_counter() - started
            return
        state = session.state
        wanted = (session.gaussians(), state.gaussians, state.as_points, state.point_size)
        if len(self._shown) != len(wanted) or any(a is not b for a, b in zip(self._shown, wanted, strict=True)):
            self._scene.show_gaussians(session.gaussians(), state)
            self._shown = wanted
        self._scene.show_shapes(session.shapes())
        look_from(self._scene_widget, view, width, height)
        self._scene_widget.force_redraw()

    def _redraw_again(self) -> bool:
        """Whether the window is drawn once more: pictures and splats appear a drawing later than they were given."""
        if not self._redraw_at or time.monotonic() < self._redraw_at[0]:
            return False
        del self._redraw_at[0]
        self._scene_widget.force_redraw()
        return True

    def _say(self) -> None:
        self._words_at = time.monotonic()
        seconds = self._painted_s if self._picture.visible else None
        state = self._session.state
        refused = state.engine is Engine.OPEN3D and not open3d_draws(state, self._software)
        self._panel.show(self._session, seconds, words.NO_SPLATS if refused else self._notice)
        self._help.show(self._session.state.help)

    def _layout(self, context: gui.LayoutContext) -> None:
        area = self._window.content_rect
        panel = min(round(_PANEL_EMS * self._window.theme.font_size), area.width // 2)
        frame = gui.Rect(area.x, area.y, area.width - panel, area.height)
        self._panel.root.frame = gui.Rect(area.get_right() - panel, area.y, panel, area.height)
        self._help.lay_out(context, frame)
        if (frame.width, frame.height) == self._size:  # the panel's words have changed, no more
            return
        self._picture.frame = self._scene_widget.frame = frame
        self._size, self._dirty = (frame.width, frame.height), True

    # ---- What the person does -------------------------------------------------------------------------------------

    def _change(self, state) -> None:
        self._session.state = state
        self._dirty = True

    def _command(self, key: str) -> None:
        if key == "r":
            self._session.whole_scene()
        elif key == "s":
            self._screenshot()
        elif key == "q":
            self._window.close()
        else:
            self._session.press(key)
        self._dirty = True

    def _key(self, event: gui.KeyEvent) -> bool:
        if event.type != gui.KeyEvent.Type.DOWN:
            return False
        key = _KEYS.get(event.key) or (chr(event.key) if 32 < event.key < 127 else "")
        self._command(key)
        return bool(key)

    def _mouse(self, event: gui.MouseEvent):
        frame = self._picture.frame
        self._dirty |= self._pointer.moved(event, float(event.x - frame.x), float(event.y - frame.y), self._size)
        return gui.Widget.EventCallbackResult.CONSUMED

    def _screenshot(self) -> None:
        path = self._screenshots / time.strftime("splatnode_%Y%m%d_%H%M%S.png")
        if self._picture.visible:
            image = self._session.paint(*self._size)
            if image is not None:
                self._save(path, image)
            return
        scene = self._scene_widget.scene.scene
        scene.render_to_image(self._guarded(lambda image: self._save(path, np.asarray(image))))

    def _save(self, path: Path, image: Image) -> None:
        _, png = cv2.imencode(".png", cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
        write_file(path, png.tobytes())
        self._notice = f"saved {path}"
