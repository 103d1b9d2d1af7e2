"""The tab with the photographs: those that are placed, to go to, and those that were left out, with the reasons."""

from __future__ import annotations

from dataclasses import replace

from open3d.visualization import gui  # pyright: ignore[reportMissingImports]

from splatnode.capture.process.printable import sanitize_text
from splatnode.viewer import words
from splatnode.viewer.panel.controls import Change, Controls, Words, button, column
from splatnode.viewer.session import Session
from splatnode.viewer.state import go_to_camera

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
        known = [*words.bounds_lines(moment, camera), *words.depth_lines(moment, camera)]
        self._bounds.say(known if index >= 0 else [])
        left_out = words.rejection_lines(moment, _MOST_DROPPED)
        self._dropped.say([f"Left out: {len(moment.snapshot.dropped)}", *left_out])

    def _select_image(self, index: int) -> None:
        if self._session is not None:
            name = self._names[index] if 0 <= index < len(self._names) else None
            self._change(go_to_camera(self._session.state, name))
