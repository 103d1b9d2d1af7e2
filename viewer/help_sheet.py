"""What can be done with mouse and keys, on a sheet over the picture."""

from __future__ import annotations

from open3d.visualization import gui  # pyright: ignore[reportMissingImports]

from splatnode.viewer.state import help_lines


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
