"""The panel beside the picture: buttons that stay where they are, tabs, and below them what was done last."""

from __future__ import annotations

from collections.abc import Callable

from open3d.visualization import gui  # pyright: ignore[reportMissingImports]

from splatnode.viewer.panel.tabs import Change, PhotographsTab, SceneTab, ShowTab, ToolsTab, Words, button
from splatnode.viewer.session import Session

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
