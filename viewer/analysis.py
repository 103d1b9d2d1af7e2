"""What takes longer than a picture: support and advice, worked out beside the window for the moment that is shown."""

from __future__ import annotations

import threading
from dataclasses import dataclass

from splatnode.viewer.advice import Advice, next_view, surface_points
from splatnode.viewer.moment import Moment
from splatnode.viewer.support import Support, support


@dataclass(frozen=True, eq=False)
class Analysis:
    moment: Moment
    support: Support
    advice: Advice


def analyse(moment: Moment) -> Analysis:
    """Which cameras see what, and where the next one should be."""
    snapshot = moment.snapshot
    supported = support(snapshot.gaussians, snapshot.cameras)
    points = surface_points(snapshot.gaussians, snapshot.cameras, supported)
    return Analysis(moment, supported, next_view(snapshot.cameras, points))


class Analyst:
    """Works on one moment at a time, always the one asked for last. The answer to an older question is dropped."""

    def __init__(self) -> None:
        self._asked: Moment | None = None
        self._done: Analysis | None = None
        self._changed = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._work, name="analyst", daemon=True)
        self._thread.start()

    def request_analysis(self, moment: Moment) -> Analysis | None:
        """The analysis of `moment`; None while it is not ready. Never waits."""
        with self._changed:
            if self._done is not None and self._done.moment is moment:
                return self._done
            if self._asked is not moment:
                self._asked = moment
                self._changed.notify()
            return None

    def close(self) -> None:
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()

    def _work(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._closing or self._is_pending())
                if self._closing or self._asked is None:
                    return
                moment = self._asked
            analysis = analyse(moment)
            with self._changed:
                self._done = analysis

    def _is_pending(self) -> bool:
        return self._asked is not None and (self._done is None or self._done.moment is not self._asked)
