"""The cameras and points of a set of photographs, found once for all methods that would find the same."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

from splatnode.capture.frame import Frame
from splatnode.recon.config import Config
from splatnode.recon.pipeline import Reconstruction, finished
from splatnode.recon.result.report import peak_rss_mb
from splatnode.recon.result.snapshot import Snapshot


@dataclass(frozen=True, eq=False)
class Start:
    """A reconstruction that has its points and no Gaussians yet; it is sent from process to process."""

    work: Reconstruction
    seconds: float  # that it took so far
    peak_rss_mb: float | None


def foundation(config: Config) -> Config:
    """The part of a configuration that decides cameras and points; all else is at its defaults."""
    return Config(
        size=config.size,
        prior=config.prior,
        matching=config.matching,
        registration=config.registration,
        screening=config.screening,
        verification=config.verification,
        decision=config.decision,
    )


def find_start(frames: Sequence[Frame], config: Config) -> Start:
    """Cameras and points as `config` finds them, or a verdict that forbids them."""
    work = Reconstruction(config)
    for frame in frames:
        work.take(frame)
    work.find_points()
    return Start(work, work.clock.last - work.clock.started, peak_rss_mb())


def continued(start: Start, config: Config) -> Iterator[Snapshot]:
    """What `reconstruct` gives from here on with `config`, of the same foundation; its clock goes on where it stopped.

    A start serves one reconstruction: another one needs a copy of its own.
    """
    work = start.work
    work.config = config
    work.clock.resume()
    yield from finished(work, at_once=True)
