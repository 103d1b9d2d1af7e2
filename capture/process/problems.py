"""What went wrong and was overcome, for people: counted, and told until somebody has seen it."""

from __future__ import annotations

import threading

from splatnode.capture.process.printable import LONGEST_TEXT, sanitize_text


class Problems:
    """Counts by kind, with the newest reason of each. To be used from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._totals: dict[str, int] = {}
        self._newest: dict[str, str] = {}
        self._seen: dict[str, int] = {}

    def add(self, kind: str, why: object) -> int:
        """One more of a `kind`, such as "frames that could not be examined"; returns how many there are now."""
        with self._lock:
            total = self._totals.get(kind, 0) + 1
            self._totals[kind], self._newest[kind] = total, sanitize_text(why)
            return total

    def count(self, kind: str, total: int, why: str) -> None:
        """So many of a `kind` are counted elsewhere."""
        with self._lock:
            self._totals[kind], self._newest[kind] = total, sanitize_text(why)

    def mark_seen(self) -> None:
        """Somebody has seen all that was told: it is not told again."""
        with self._lock:
            self._seen = dict(self._totals)

    def __str__(self) -> str:
        """One sentence for all that nobody has seen; empty where there is nothing."""
        with self._lock:
            unseen = {kind: total - self._seen.get(kind, 0) for kind, total in self._totals.items()}
            told = [f"{count} {kind}, the last: {self._newest[kind]}" for kind, count in unseen.items() if count > 0]
        return sanitize_text("; ".join(told), LONGEST_TEXT)


def is_logged(count: int) -> bool:
    """Whether the so manieth of a kind is logged: the 1st, 2nd, 4th, 8th, ..., so that nobody can fill the journal."""
    return count.bit_count() == 1
