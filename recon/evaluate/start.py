"""The cameras and points of a set of photographs, found once for all methods that would find the same."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.recon.clock import Clock
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.modelling import create_initial_scene
from splatnode.recon.pipeline import estimate_frames, model_scene
from splatnode.recon.result.report import peak_rss_mb
from splatnode.recon.result.snapshot import Snapshot


@dataclass(frozen=True, eq=False)
class Start:
    """Cameras and depth, no Gaussians yet; it is sent from process to process, and serves several reconstructions."""

    estimate: Reconstruction
    dropped: list[DroppedFrame]
    clock: Clock
    peak_rss_mb: float | None

    @property
    def seconds(self) -> float:
        """Returns the seconds that it took so far."""
        return self.clock.last - self.clock.started


def extract_start_config(config: ReconstructionConfig) -> ReconstructionConfig:
    """The part of a configuration that decides cameras and points; all else is at its defaults."""
    return ReconstructionConfig(
        size=config.size,
        prior=config.prior,
        matching=config.matching,
        registration=config.registration,
        screening=config.screening,
        verification=config.verification,
        decision=config.decision,
        quick=config.quick,
        ladder=config.ladder,
    )


def find_start(frames: Sequence[Frame], config: ReconstructionConfig) -> Start:
    """Cameras and depth as `config` finds them, or a verdict that forbids them."""
    clock = Clock()
    estimate, dropped = estimate_frames(frames, config, clock)
    return Start(estimate, dropped, clock, peak_rss_mb())


def continue_reconstruction(start: Start, config: ReconstructionConfig) -> Iterator[Snapshot]:
    """Yields what `reconstruct` gives from here on with `config`; the clock resumes where it stopped."""
    clock = replace(start.clock, seconds=dict(start.clock.seconds))
    clock.resume()
    begun = create_initial_scene(start.estimate, config)
    yield from model_scene(start.estimate.summary, begun, start.dropped, config, clock)
