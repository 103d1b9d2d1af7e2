"""What a run was timed on, and whether its seconds are worth telling: only where it had its cores alone."""

from __future__ import annotations

import platform
from collections.abc import Collection, Iterable
from dataclasses import dataclass
from pathlib import Path

from splatnode.recon.core import instruction_sets
from splatnode.recon.jobs.alone import ALONE, Moment, now, others_share


@dataclass(frozen=True)
class Timing:
    cores: int  # that the run could use
    processor: str
    others: float | None  # the share of their time that others took while the clock ran; None: nobody can tell

    @property
    def is_alone(self) -> bool:
        return had_alone(self.others)


def measure_timing(since: Moment) -> Timing:
    """Measures the timing of this process since then."""
    return Timing(len(since.cores), describe_processor(), others_share(since, now()))


def had_alone(others: float | None) -> bool:
    """Whether seconds are reported of a run during which others took this share of its cores."""
    return others is None or others <= ALONE


def find_largest_share(timings: Iterable[Timing | None]) -> float | None:
    """The largest share that others took in any of these; None: nobody can tell of any."""
    shares = [timed.others for timed in timings if timed is not None]
    return max((share for share in shares if share is not None), default=None)


def explain_missing_seconds(others: Collection[float | None]) -> str:
    """A sentence for runs of which others took these shares of the cores; empty where all were alone."""
    disturbed = sum(not had_alone(share) for share in others)
    if not disturbed:
        return ""
    return (
        f"seconds are not reported of {disturbed} of {len(others)} runs: others took more than {ALONE:.0%} of the time "
        "of their cores"
    )


def check_same_cores(known: Collection[int], each: int, where: Path) -> None:
    """Raises ValueError where `where` holds runs on `known` numbers of cores and the next ones would have `each`."""
    if other := sorted(set(known) - {each}):
        raise ValueError(
            f"{where} holds runs that had {_format_cores(other[0])} each, now each would have {_format_cores(each)}, and their "
            "seconds would be mixed: give the same --cores as before, or another --out"
        )


def describe_processor() -> str:
    """The name of this machine's, with the instructions that the core uses: one name has several generations."""
    used = instruction_sets()[:1]
    return ", ".join([_read_processor_name(), *used])


def _read_processor_name() -> str:
    try:
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    except OSError:
        pass
    return platform.processor() or platform.machine()


def _format_cores(number: int) -> str:
    return f"{number} core{'s' * (number != 1)}"
