"""Where the picture is: by the project's own rasteriser in an image widget, or by Open3D in a scene widget.

The scene widget is there in any case, because without one Open3D 0.20 keeps the memory of every image that it has
shown.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
from open3d.visualization import gui, rendering  # pyright: ignore[reportMissingImports]

from splatnode.viewer.pace import choose_first_divisor, choose_next_divisor
from splatnode.viewer.scene3d import Scene3D, image3d, look_from
from splatnode.viewer.session import Session
from splatnode.viewer.state import open3d_draws
from splatnode.viewer.viewpoint import BACKGROUND, Viewpoint

Image = npt.NDArray[np.uint8]

# Open3D skips a drawing while the one before is under way, and shows what came into its scene a drawing later: so the
# window is drawn again. Keys and clicks make it draw by themselves, so that what they change is skipped more often. On
# software Vulkan each drawing takes 60 ms of a processor, which a node may want.
_REDRAWN_S = (0.3,)
_ASKED_REDRAWN_S = (0.3, 1.0)
_SCENE_REDRAWN_S = (0.0, 0.0, 0.3, 1.0)


class WindowStage:
    """Two widgets in the same place, of which one is visible. `software`: Vulkan runs on the processor."""

    def __init__(self, window: gui.Window, software: bool) -> None:
        self.picture = gui.ImageWidget(image3d(np.full((8, 8, 3), BACKGROUND, np.uint8)))
        self.scene = gui.SceneWidget()
        self.scene.scene = rendering.Open3DScene(window.renderer)
        self.scene.visible = False  # before it is first drawn: later, the memory is kept all the same
        self.size = (1, 1)  # pixels
        self._software = software
        self._content = Scene3D(self.scene)
        self._in_scene: tuple[object, ...] = ()  # what the scene widget shows
        self._painted_s = 0.0  # how long the last full picture took
        self._part: int | None = None  # how coarse the last picture of a drag was; None: there is no drag
        self._redraw_at: list[float] = []  # times to come

    @property
    def paint_time_s(self) -> float | None:
        """Seconds that a picture takes; None where Open3D draws it."""
        return self._painted_s if self.picture.visible else None

    def lay_out(self, frame: gui.Rect) -> bool:
        """Fills `frame`; returns whether the size changed."""
        if (frame.width, frame.height) == self.size:
            return False
        self.picture.frame = self.scene.frame = frame
        self.size = frame.width, frame.height
        return True

    def draw(self, session: Session, asked: bool, hurried: bool) -> None:
        """Shows the session's picture; `asked`: by the person, not by news; `hurried`: the next one comes at once."""
        view = session.viewpoint()
        if view is None or min(self.size) < 2:
            return
        blends = session.state.blend > 0 and session.camera_image() is not None
        own = blends or not open3d_draws(session.state, self._software)
        if self.picture.visible != own or self.scene.visible == own:
            self.picture.visible, self.scene.visible = own, not own
            self._content.set_drawing(not own)
        again = _SCENE_REDRAWN_S if not own else _ASKED_REDRAWN_S if asked else _REDRAWN_S
        self._redraw_at = [time.monotonic() + after for after in again]
        if own:
            self._paint(session, hurried)
        else:
            self._draw_scene(session, view)

    def redraw_if_due(self) -> bool:
        """Whether the window is to be drawn once more, though nothing has changed."""
        if not self._redraw_at or time.monotonic() < self._redraw_at[0]:
            return False
        del self._redraw_at[0]
        self.scene.force_redraw()
        return True

    def take_image(self, session: Session, taken: Callable[[Image], None]) -> None:
        """Calls `taken` with the picture that is shown, now or a drawing later."""
        if not self.picture.visible:
            self.scene.scene.scene.render_to_image(lambda image: taken(np.asarray(image)))
        elif (image := session.paint(*self.size)) is not None:
            taken(image)

    def _paint(self, session: Session, hurried: bool) -> None:
        width, height = self.size
        self._part = (self._part or choose_first_divisor(self._painted_s)) if hurried else None
        started, paintings = time.perf_counter(), session.paintings
        image = session.paint(width, height, self._part or 1)
        if image is not None:
            self.picture.update_image(image3d(image))
        took = time.perf_counter() - started
        if self._part is not None:
            self._part = choose_next_divisor(self._part, took)
        elif session.paintings > paintings:
            self._painted_s = took

    def _draw_scene(self, session: Session, view: Viewpoint) -> None:
        state = session.state
        wanted = (session.gaussians(), state.gaussians, state.as_points, state.point_size)
        if len(self._in_scene) != len(wanted) or any(a is not b for a, b in zip(self._in_scene, wanted, strict=True)):
            self._content.show_gaussians(session.gaussians(), state)
            self._in_scene = wanted
        self._content.show_shapes(session.shapes_with_legend(*self.size))
        look_from(self.scene, view, *self.size)
        self.scene.force_redraw()
