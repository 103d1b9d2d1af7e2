"""The unit of a result's lengths, which every file that is written states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from splatnode.capture.process.printable import LONGEST_TEXT, sanitize_text

TWO_SIDED_95 = 1.96  # standard deviations to either side that hold 95 % of a normal distribution


@dataclass(frozen=True)
class Scale:
    """Whether lengths are metres, and how that is known."""

    metric: bool = False  # lengths are metres
    source: str | None = None  # of the metres, or why there are none although they were asked for
    # Of metres: a true length is at least and at most so many times the stated one, with a probability of 95 %
    interval_95: tuple[float, float] | None = None

    @property
    def word(self) -> str:
        return "metric" if self.metric else "relative"

    @property
    def sentence(self) -> str:
        meaning = "metres" if self.metric else "no metric unit"
        return f"{self.word} ({meaning}{f': {self.source}' if self.source else ''})"

    def record(self) -> dict[str, object]:
        """As JSON files state it."""
        return {"scale": self.word, "scale_source": self.source, "scale_interval_95": self.interval_95}


RELATIVE = Scale()


def join_sentences(said: Sequence[str], longest: int = LONGEST_TEXT) -> str:
    """Joins `said` into one text of at most `longest` characters: what fits, and how many more there are."""
    for kept in range(len(said), 0, -1):
        left_out = [f"and {len(said) - kept} more"] if kept < len(said) else []
        text = "; ".join([*said[:kept], *left_out])
        if len(text) <= longest:
            return text
    return sanitize_text("; ".join(said), longest)
