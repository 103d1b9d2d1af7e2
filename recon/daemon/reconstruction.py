"""A reconstruction without an end: keyframes are set aside and brought back, an earlier process' work is taken over."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from splatnode.recon.config import Config
from splatnode.recon.estimation import Judgement
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.frames.screening import summarise
from splatnode.recon.matching.two_view import TwoView
from splatnode.recon.pipeline import Reconstruction


class LiveReconstruction(Reconstruction):
    """What the daemon needs beyond the steps of every reconstruction."""

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self._beside = self.graph.without(())  # what is known of keyframes that were set aside, and of others

    @property
    def aside(self) -> list[Keyframe]:
        """Keyframes that are known and do not belong to the scene, in the order in which their frames came."""
        belonging = set(self.names)
        found = [keyframe for keyframe in self._beside.keyframes if keyframe.name not in belonging]
        return sorted(found, key=lambda keyframe: keyframe.frame.frame_id)

    @property
    def proven(self) -> frozenset[str]:
        """The keyframes that a publishable verdict was last given on thoroughly."""
        return self._judging.proven

    def set_aside(self, names: Collection[str]) -> None:
        """Takes keyframes out of the scene as `retract` does, and remembers them and what their pairs say."""
        self._beside = self.graph.joined(self._beside)
        self._leave_out(names)

    def bring_back(self, names: Collection[str]) -> None:
        """The keyframes among these that were set aside are keyframes as before."""
        others = {keyframe.name for keyframe in self.aside}.difference(names)
        self.graph = self.graph.joined(self._beside.without(others))

    def retract(self, names: Collection[str]) -> None:
        """Forgets keyframes, those that were set aside too."""
        self._beside = self._beside.without(names)
        super().retract(names)

    def judge_quickly(self) -> Judgement | None:
        """As `judge` if that is known or continues what is known; None where it cannot be said quickly."""
        self.clock.lap("wait")
        judgement = self._judging.quickly(self.graph, self.rejected)
        self.clock.lap("poses")
        return judgement

    def refused(self, names: Collection[str]) -> bool:
        """Whether a thorough judgement of these keyframes, just these, is known to forbid a scene."""
        return self._judging.refused(names)

    def restore(
        self,
        keyframes: Sequence[Keyframe],
        pairs: Mapping[tuple[str, str], TwoView],
        pending: Collection[tuple[str, str]] = (),
    ) -> None:
        """Takes over keyframes whose pairs, by their names, an earlier process knew; it had not looked at `pending`."""
        self.graph.keyframes[:] = keyframes
        place = {keyframe.name: index for index, keyframe in enumerate(keyframes)}
        self.graph.pairs = {(place[i], place[j]): pair for (i, j), pair in pairs.items() if i in place and j in place}
        self.graph.pending = {(place[i], place[j]) for i, j in pending if i in place and j in place}
        self._looks |= {keyframe.name: summarise(keyframe.frame) for keyframe in keyframes}

    def restore_judgement(self, judgement: Judgement, proven: Collection[str]) -> None:
        """Takes over what an earlier process had judged of just the keyframes that there are."""
        self._judging.restore(self.graph, judgement, proven)
