"""What is known of the keyframes' cameras, and the verdict on it: soon and for now, or thoroughly and for good."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, replace

from splatnode.recon.config import Config
from splatnode.recon.frames.screening import Rejected
from splatnode.recon.matching.view_graph import ViewGraph
from splatnode.recon.registration import continuation
from splatnode.recon.registration.register import RegisteredCamera, Registration, register
from splatnode.recon.result.verdict import Verdict
from splatnode.recon.verification.decision import decide, refuse_before_registration
from splatnode.recon.verification.evidence import Evidence
from splatnode.recon.verification.verify import verify, verify_further

REMEMBERED = 3  # judgements: a keyframe may be tried, and taken back
REMEMBERED_REFUSED = 100  # sets of keyframes of which nothing came: they need not be tried again
BEYOND_DOUBT = 50  # points of a further camera that two others see; another place, taken for this one, had up to 20
FOR_NOW = "For now: all evidence is weighed when no keyframe waits."

Known = tuple[tuple[str, ...], int]  # keyframes, and how many frames were left out


@dataclass(frozen=True, eq=False)
class Judgement:
    registration: Registration | None
    evidence: Evidence | None  # None where there is nothing to verify
    verdict: Verdict


class Judging:
    """Remembers the last judgements, by the keyframes that they are about."""

    def __init__(self, config: Config) -> None:
        self._config = config
        self._judged: dict[Known, Judgement] = {}
        self._refused: dict[frozenset[str], None] = {}  # sets of keyframes, the latest last
        self.proven: frozenset[str] = frozenset()  # keyframes of the last thorough judgement that was publishable

    def thorough(
        self, graph: ViewGraph, rejected: Sequence[Rejected], pause: Callable[[], None] = lambda: None
    ) -> Judgement:
        """From all pairs, made anew; at once for keyframes that were judged so a moment ago.

        `pause` is called about once a second and may raise to abandon the work.
        """
        known = _known(graph, rejected)
        judgement = self._judged.get(known)
        if judgement is None or judgement.verdict.provisional:
            judgement = self._remember(known, self._made_anew(graph, rejected, pause))
            if judgement.verdict.publishable:
                self.proven = frozenset(known[0])
            else:
                latest = list(self._refused)[1 - REMEMBERED_REFUSED :]
                self._refused = dict.fromkeys([*latest, frozenset(known[0])])
        return judgement

    def restore(self, graph: ViewGraph, judgement: Judgement, proven: Collection[str]) -> None:
        """Takes over what an earlier process had judged of the keyframes of `graph`, and had proven."""
        self._remember(_known(graph, ()), judgement)
        self.proven = frozenset(proven)

    def refused(self, names: Collection[str]) -> bool:
        """Whether a thorough judgement of these keyframes is known, and forbade a scene."""
        return frozenset(names) in self._refused

    def soon(self, graph: ViewGraph, rejected: Sequence[Rejected]) -> Judgement:
        """As `quickly`, else as `thorough`."""
        return self.quickly(graph, rejected) or self.thorough(graph, rejected)

    def quickly(self, graph: ViewGraph, rejected: Sequence[Rejected]) -> Judgement | None:
        """What was judged a moment ago, or what continues it and speaks for all its keyframes; None without either."""
        known = _known(graph, rejected)
        if known in self._judged:
            return self._judged[known]
        continued = self._continued(graph)
        return self._remember(known, continued) if continued else None

    def _made_anew(self, graph: ViewGraph, rejected: Sequence[Rejected], pause: Callable[[], None]) -> Judgement:
        """A registration of the keyframes, judged by its evidence; none where it would be of no use."""
        graph.complete(pause)
        refusal = refuse_before_registration(graph, rejected, self._config.decision)
        if refusal is not None:
            return Judgement(None, None, refusal)
        registration = register(graph.keyframes, graph.pairs, self._config.registration, pause)
        pause()
        evidence = verify(graph, registration, self._config.verification, pause)
        return Judgement(registration, evidence, decide(graph, registration, evidence, self._config.decision))

    def _continued(self, graph: ViewGraph) -> Judgement | None:
        """The newest judgement that can be continued, with cameras for all keyframes that it did not have, or None."""
        place = {keyframe.name: index for index, keyframe in enumerate(graph.keyframes)}
        for (names, _), judged in reversed(self._judged.items()):
            if judged.registration and judged.evidence and judged.verdict.publishable and place.keys() >= set(names):
                further = place.keys() - set(names)
                start = [replace(camera, index=place[names[camera.index]]) for camera in judged.registration.cameras]
                return self._continued_from(start, judged.evidence, graph, {place[name] for name in further})
        return None

    def _continued_from(
        self, start: Sequence[RegisteredCamera], evidence: Evidence, graph: ViewGraph, further: Collection[int]
    ) -> Judgement | None:
        registration = continuation.extended(graph.keyframes, graph.pairs, start, self._config.registration)
        if registration is None or not {camera.index for camera in registration.cameras}.issuperset(further):
            return None
        continued = verify_further(graph, registration, evidence, self._config.verification)
        if continued is None:
            return None
        names = {graph.keyframes[index].name for index in further}
        if any(camera.confirmed < BEYOND_DOUBT for camera in continued.cameras if camera.name in names):
            return None
        verdict = decide(graph, registration, continued, self._config.decision)
        if not verdict.publishable:
            return None
        message = f"{verdict.message} {FOR_NOW}"
        return Judgement(registration, continued, replace(verdict, message=message, provisional=True))

    def _remember(self, known: Known, judgement: Judgement) -> Judgement:
        self._judged.pop(known, None)
        self._judged = dict([*self._judged.items(), (known, judgement)][-REMEMBERED:])
        return judgement


def _known(graph: ViewGraph, rejected: Sequence[Rejected]) -> Known:
    return tuple(keyframe.name for keyframe in graph.keyframes), len(rejected)
