"""What others are told of the map: it is taken back before anything is shown that it is not of."""

from __future__ import annotations

import logging
from typing import Any

from splatnode.capture.messaging.state import StateServer
from splatnode.capture.messaging.wire import Numbering, WireError
from splatnode.recon.daemon.free_space import NOT_FINAL, OccupancyResult
from splatnode.recon.daemon.output import PublishedSnapshot
from splatnode.recon.occupancy.message import encode_map, no_map

log = logging.getLogger(__name__)

NO_SCENE = "none"  # in place of a scene's id


class OccupancyPublisher:
    """Says what is known of free space, each thing once. For one thread, that which shows scenes."""

    def __init__(self, server: StateServer, numbering: Numbering) -> None:
        """`numbering`: of the maps alone, in the session of the scenes."""
        self._server, self._numbering = server, numbering
        self._told: tuple[str, OccupancyResult | str] | None = None  # scene, and its map or why there is none

    def serve(self) -> None:
        """Replies to who asks."""
        self._server.serve(0)

    def publish(self, found: OccupancyResult | str, shown: PublishedSnapshot | None, sequence: int) -> None:
        """`found` is the map of a scene, or why there is none; `shown` what viewers see, by message `sequence`."""
        scene_id = NO_SCENE if shown is None else shown.scene_id
        now = _match_shown_scene(found, shown)
        if (scene_id, now) == self._told:
            return
        self._told = scene_id, now
        numbers = self._numbering.next()
        if isinstance(now, OccupancyResult):
            now = self._send_map(now, scene_id, sequence, numbers)
        if now:
            self._server.publish(no_map(scene_id, now, numbers))

    def _send_map(self, mapped: OccupancyResult, scene_id: str, sequence: int, numbers: dict[str, Any]) -> str:
        """Sends a map; why not, where there is none to be sent."""
        if mapped.occupancy is None:
            return mapped.why
        try:
            self._server.publish(*encode_map(mapped.occupancy, scene_id, sequence, numbers))
        except WireError as error:
            log.warning("the map of %s cannot be sent: %s", scene_id, error)
            return f"the map is too large: {error}; choose a larger map.voxel"
        return ""


def _match_shown_scene(found: OccupancyResult | str, shown: PublishedSnapshot | None) -> OccupancyResult | str:
    """The map if it is of what viewers see; else why there is none."""
    if shown is not None and not shown.snapshot.verdict.publishable:
        verdict = shown.snapshot.verdict
        return f"there is no scene: {verdict.code.value}. {verdict.message}"
    if isinstance(found, str):
        return found
    return found if shown is not None and found.of.snapshot is shown.snapshot else NOT_FINAL
