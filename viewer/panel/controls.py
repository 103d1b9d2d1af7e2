"""Controls with their labels: switches, lists to choose from, sliders, and words that are wrapped."""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import replace

from open3d.visualization import gui  # pyright: ignore[reportMissingImports]

from splatnode.capture.process.printable import sanitize_text
from splatnode.viewer.session import Session
from splatnode.viewer.state import ViewerState

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
