"""The tab with what there is to say of the scene: verdict, next view, bounds, places, numbers."""

from __future__ import annotations

from open3d.visualization import gui  # pyright: ignore[reportMissingImports]

from splatnode.recon.result.verdict import Code
from splatnode.viewer import words
from splatnode.viewer.panel.controls import Words, column
from splatnode.viewer.session import Session

_GOOD, _BAD = gui.Color(0.5, 0.9, 0.5), gui.Color(1.0, 0.65, 0.4)


class SceneTab:
    def __init__(self, window: gui.Window) -> None:
        self.root = column(window)
        names = ("verdict", "advice", "scale", "bounds", "places", "counts")
        self._words = {name: Words(window, self.root) for name in names}

    def show(self, session: Session, seconds: float | None) -> None:
        state, moment, analysis, age = session.state, session.moment, session.analysis(), session.source.age_s
        if moment is None:
            self._words["verdict"].say([words.waiting_line(age)])
            return
        self._words["verdict"].label.text_color = _GOOD if moment.snapshot.verdict.code is Code.OK else _BAD
        self._words["verdict"].say(words.verdict_lines(moment))
        advice = words.advice_line(analysis.advice if analysis else None, moment)
        self._words["advice"].say([f"Next view: {advice}"])
        self._words["scale"].say(words.scale_lines(moment, session.ground()))
        camera = session.camera()
        self._words["bounds"].say([*words.bounds_lines(moment, camera), *words.depth_lines(moment, camera)])
        self._words["places"].say(words.place_lines(moment))
        rate = [f"{1 / seconds:.0f} pictures/s ({1000 * seconds:.0f} ms each)"] if seconds else []
        feed = words.feed_line(age, moment.snapshot.final) + (", paused" if state.paused else "")
        self._words["counts"].say([*words.count_lines(moment), *rate, feed])
