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
from splatnode.recon.metric.config import MetricConfig
from splatnode.recon.metric.evidence import NOTHING, Evidence, gather_evidence
from splatnode.recon.metric.metres import apply_metric_scale
from splatnode.recon.modelling import add_landmarks
from splatnode.recon.result.snapshot import Snapshot


class MetricScaler:
    """Puts scenes into metres as `splatnode replay` does. For one thread."""

    def __init__(self, config: MetricConfig) -> None:
        self._config = config
        self._told: WeakKeyDictionary[Frame, Evidence] = WeakKeyDictionary()

    def scale_snapshot(self, snapshot: Snapshot, work: IncrementalReconstruction) -> Snapshot:
        """Returns the snapshot for viewers, in metres where a scale source is available, else unchanged.

        A network, which takes seconds, is asked about a final scene alone. Landmarks are gathered for a final scene, by
        which it is measured in its files, too; for others where stereo pairs are measured by them.
        """
        evidence = self.collect_evidence(work.graph.keyframes)
        config = self._config if snapshot.final else msgspec.structs.replace(self._config, network=False)
        came = evidence.tracked or evidence.motions
        if evidence.pairs or (snapshot.final and (config != MetricConfig() or came)):
            snapshot = add_landmarks(snapshot, work.find_reconstruction())
        measured = apply_metric_scale(snapshot, config, evidence)
        return measured if snapshot.final else replace(measured, landmarks=None)

    def scale_result(self, snapshot: Snapshot, work: IncrementalReconstruction) -> Snapshot:
        """Returns the snapshot for a result folder, with its estimate's landmarks if still known."""
        with_all = add_landmarks(snapshot, work.find_reconstruction())
        return apply_metric_scale(with_all, self._config, self.collect_evidence(work.graph.keyframes))

    def collect_evidence(self, keyframes: Sequence[Keyframe]) -> Evidence:
        """Collects the keyframes' scale evidence: markers, poses, motions, gravity, right images."""
        for frame in (each.frame for each in keyframes):
            if frame not in self._told:
                self._told[frame] = gather_evidence((frame,), self._config)
        return reduce(Evidence.merge, (self._told[each.frame] for each in keyframes), NOTHING)
