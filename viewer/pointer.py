"""The pointer over the picture: it orbits, pans and zooms, or goes to the camera that was clicked."""

from __future__ import annotations

from open3d.visualization import gui  # pyright: ignore[reportMissingImports]

from splatnode.viewer.session import Session
from splatnode.viewer.viewpoint import orbit, pan, zoom

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
