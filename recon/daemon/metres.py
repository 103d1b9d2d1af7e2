"""The metres of what the daemon shows and writes: what its keyframes tell of them, looked for once in each."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import reduce
from weakref import WeakKeyDictionary

import msgspec

from splatnode.capture.frame import Frame
from splatnode.recon.frames.keyframe import Keyframe
from splatnode.recon.incremental import IncrementalReconstruction
from splatnode.recon.metric.config import Config
from splatnode.recon.metric.evidence import NOTHING, Evidence, gathered
from splatnode.recon.metric.metres import in_metres
from splatnode.recon.modelling import with_landmarks
from splatnode.recon.result.snapshot import Snapshot


class Metres:
    """Puts scenes into metres as `splatnode replay` does. For one thread."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._told: WeakKeyDictionary[Frame, Evidence] = WeakKeyDictionary()

    def of_shown(self, snapshot: Snapshot, work: IncrementalReconstruction) -> Snapshot:
        """What viewers get, in metres where a source has spoken, else as it is.

        A network, which takes seconds, is asked about a final scene alone. Landmarks are gathered for a final scene, by
        which it is measured in its files, too; for others where stereo pairs are measured by them.
        """
        evidence = self.told_by(work.graph.keyframes)
        config = self._config if snapshot.final else msgspec.structs.replace(self._config, network=False)
        came = evidence.tracked or evidence.motions
        if evidence.pairs or (snapshot.final and (config != Config() or came)):
            snapshot = with_landmarks(snapshot, work.remembered())
        measured = in_metres(snapshot, config, evidence)
        return measured if snapshot.final else replace(measured, landmarks=None)

    def of_written(self, snapshot: Snapshot, work: IncrementalReconstruction) -> Snapshot:
        """What a result folder gets: with the landmarks of its estimate, if that is known still."""
        with_all = with_landmarks(snapshot, work.remembered())
        return in_metres(with_all, self._config, self.told_by(work.graph.keyframes))

    def told_by(self, keyframes: Sequence[Keyframe]) -> Evidence:
        """Of what is configured, and what came with the keyframes: poses, motions, gravity, right images."""
        for frame in (each.frame for each in keyframes):
            if frame not in self._told:
                self._told[frame] = gathered((frame,), self._config)
        return reduce(Evidence.and_also, (self._told[each.frame] for each in keyframes), NOTHING)
