"""What photographs themselves tell of metres, gathered before the scene is known."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.process.progress import Step, Tell, told_to_nobody
from splatnode.recon.metric.config import Config
from splatnode.recon.metric.marker_detection import Sighting, sightings


@dataclass(frozen=True, eq=False)
class Evidence:
    """What was found in photographs, whatever becomes of them."""

    sightings: tuple[Sighting, ...] = ()  # of printed markers

    def and_also(self, further: Evidence) -> Evidence:
        """With what further photographs tell."""
        return Evidence((*self.sightings, *further.sightings))


NOTHING = Evidence()


def gathered(frames: Iterable[Frame | DroppedFrame], config: Config, tell: Tell = told_to_nobody) -> Evidence:
    """What the frames tell of what `config` asks for. Raises ValueError where intrinsics cannot be used."""
    if config.marker_m is None:
        return NOTHING
    tell(Step("looking for markers"))
    return Evidence(tuple(sightings(frames, config.marker_dictionary)))
