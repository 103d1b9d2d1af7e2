"""The thread that tells clients where their images were taken, in the scene that is shown: also while it grows.

It works beside the worker, and makes no keyframe wait: the landmarks of a scene are gathered when the first image of
it comes, from the estimate that the scene was made with.
"""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass, replace

import msgspec

from splatnode.capture.messaging.network import RECON_LOCATE, Network
from splatnode.capture.messaging.pubsub import QueryServer
from splatnode.capture.messaging.wire import Message, WireError
from splatnode.capture.process.logs import Problems, is_logged
from splatnode.capture.process.system import is_shortage
from splatnode.capture.process.text import sanitize_text
from splatnode.recon.estimation import Reconstruction
from splatnode.recon.locating.localize import follow, localize_image
from splatnode.recon.locating.message import (
    QUERY_LIMITS,
    LocateAnswer,
    LocateRequest,
    decode_query_image,
    make_outcome_records,
)
from splatnode.recon.locating.outcome import Located, NotLocated
from splatnode.recon.modelling import add_landmarks
from splatnode.recon.result.snapshot import Landmarks, Snapshot
from splatnode.recon.threads import apply_thread_limit

log = logging.getLogger(__name__)

WAIT_S = 0.1  # for an image
NO_SCENE = "none"  # in place of a scene's id
NOTHING_YET = "there is no scene yet: it begins with the second or third keyframe"
UNKNOWN = "the cameras of the scene that is shown are being estimated anew; ask again in a moment"
MOST_FOLLOWED = 64  # connections whose last image is known


class LocatorConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    live: bool = False  # answer clients that ask where their images were taken, as the service recon.locate


@dataclass(frozen=True, eq=False)
class LocatableScene:
    """The scene that viewers see, with what its landmarks are gathered from."""

    snapshot: Snapshot
    scene_id: str
    session: str  # of the message that shows it
    sequence: int
    revision: int  # of its world
    provisional: bool
    estimate: Reconstruction | None  # None: it is not known any more


class Locator:
    """Answers requests of `recon.locate`. `show` is for the thread that shows scenes, `run` for one of its own."""

    def __init__(self, network: Network, problems: Problems, stopping: threading.Event) -> None:
        """Raises what binding the service raises."""
        self._server = QueryServer(RECON_LOCATE, network, LocateRequest, QUERY_LIMITS)
        self._problems, self._stopping = problems, stopping
        self._shown: LocatableScene | None = None
        self._landmarks: tuple[LocatableScene, Landmarks | None] | None = None
        self._last: dict[bytes, tuple[int, Located]] = {}  # by connection: the revision, and where its last image was

    def close(self) -> None:
        self._server.close()

    def show(self, scene: LocatableScene) -> None:
        """From now on images are looked for in this scene."""
        self._shown = scene

    def run(self) -> None:
        """Until the daemon stops; on one processor, which leaves the others to the worker."""
        with apply_thread_limit(1):
            while not self._stopping.is_set():
                for identity, message in self._server.receive(WAIT_S):
                    self._server.reply(identity, self._answer(identity, message))

    def _answer(self, identity: bytes, message: Message[LocateRequest]) -> LocateAnswer:
        scene, request = self._shown, message.header
        if scene is None:
            return LocateAnswer(request.number, NO_SCENE, "0" * 32, 0, 0, True, why=NOTHING_YET)
        world = request.number, scene.scene_id, scene.session, scene.sequence, scene.revision, scene.provisional
        try:
            found = self._locate(identity, message, scene)
        except (WireError, ValueError) as error:  # of this image
            return LocateAnswer(*world, why=sanitize_text(str(error)))
        except Exception as error:
            if is_logged(self._problems.add("images that could not be located", f"{type(error).__name__}: {error}")):
                log.exception("an image could not be located")
            why = "memory or disk did not suffice" if is_shortage(error) else "the node failed; see its log"
            return LocateAnswer(*world, why=why)
        if isinstance(found, str):
            return LocateAnswer(*world, why=sanitize_text(found))
        return LocateAnswer(*world, **make_outcome_records(found))  # pyright: ignore[reportArgumentType]

    def _locate(
        self, identity: bytes, message: Message[LocateRequest], scene: LocatableScene
    ) -> Located | NotLocated | str:
        """The outcome, or why no place was looked for. Raises WireError, ValueError where the image cannot be used."""
        verdict = scene.snapshot.verdict
        if not verdict.publishable:
            return f"there is no scene: {verdict.code.value}. {verdict.message}"
        landmarks = self._gather_landmarks(scene)
        if landmarks is None:
            return UNKNOWN
        image, request = decode_query_image(message), message.header
        revision, near = self._last.pop(identity, (-1, None))
        if request.follows and near is not None and revision == scene.revision:
            found = follow(landmarks, image, near, request.intrinsics)
        else:
            found = localize_image(landmarks, image, request.intrinsics)
        if isinstance(found, Located):
            self._last[identity] = scene.revision, found
            while len(self._last) > MOST_FOLLOWED:
                del self._last[next(iter(self._last))]
        return found

    def _gather_landmarks(self, scene: LocatableScene) -> Landmarks | None:
        """The landmarks of a scene in its world and unit, gathered once."""
        if self._landmarks is None or self._landmarks[0] is not scene:
            known = scene.snapshot.landmarks or add_landmarks(scene.snapshot, scene.estimate).landmarks
            metric = scene.snapshot.scale.metric
            self._landmarks = scene, known and replace(known, metric=metric)
        return self._landmarks[1]
