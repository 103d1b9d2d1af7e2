"""What a node says of free space, as a thread hears it."""

from __future__ import annotations

import logging
import threading
from dataclasses import dataclass
from typing import Any

from splatnode.capture.messaging.network import RECON_MAP, Network
from splatnode.capture.messaging.pubsub import StateClient
from splatnode.capture.messaging.wire import WireError
from splatnode.capture.process.logs import Problems, is_logged
from splatnode.recon.occupancy.grid import OccupancyMap
from splatnode.recon.occupancy.message import MapHeader, decode_map

log = logging.getLogger(__name__)

SILENT = "the node has said nothing of a map: set occupancy.live in the configuration of splatnode recon"
_POLL_S = 0.25


@dataclass(frozen=True, eq=False)
class NodeMap:
    """A node's current knowledge of free space."""

    scene_id: str  # of the place; empty where the node has said nothing
    occupancy: OccupancyMap | None  # in the world of that scene, as it is now
    why: str  # there is no map; empty where there is one
    provisional: bool = (
        False  # the scene grows: the map is less certain, and is withdrawn when the scene is made afresh
    )
    views: int | None = None  # that a provisional map is made of
    bounds: tuple[float, float] | None = (
        None  # of its least certain camera, 95 %: degrees, and of its centre, in the unit
    )


NOTHING_HEARD = NodeMap("", None, SILENT)


@dataclass(frozen=True, eq=False)
class ReceivedMap:
    """The newest message about the map, and the message of recon.scene that it belongs to."""

    told: NodeMap
    scene: tuple[str, int] | None = None  # session and sequence
    world: tuple[str, int] | None = None  # session and revision of a provisional one


class LiveMap:
    """Hears the maps of a node; keeps the newest."""

    def __init__(self, network: Network) -> None:
        """Raises what opening the network raises."""
        self._client = StateClient(RECON_MAP, network, MapHeader)
        self._refusals = Problems()
        self._heard = ReceivedMap(NOTHING_HEARD)
        self._error: BaseException | None = None
        self._closing = threading.Event()
        self._thread = threading.Thread(target=self._listen, name="live map", daemon=True)
        self._thread.start()

    @property
    def newest(self) -> ReceivedMap:
        """Raises what the connection failed with, for example PermissionError."""
        if self._error is not None:
            raise self._error
        return self._heard

    def close(self) -> None:
        self._closing.set()
        self._thread.join()
        self._client.close()

    def _listen(self) -> None:
        try:
            while not self._closing.is_set():
                message = self._client.poll(_POLL_S)
                if message is None:
                    continue
                header: MapHeader = message.header
                try:
                    told = NodeMap(header.scene_id, decode_map(message), header.why, **_describe_provisional(header))
                except WireError as error:
                    if is_logged(self._refusals.add("maps that were refused", error)):
                        log.warning("a map of the node was refused: %s", error)
                    told = NodeMap(header.scene_id, None, f"the node's map was refused: {error}")
                growing = None if header.map is None else header.map.provisional
                world = None if growing is None else (header.session, growing.revision)
                self._heard = ReceivedMap(told, header.map and (header.session, header.map.scene_sequence), world)
        except Exception as error:
            self._error = error


def _describe_provisional(header: MapHeader) -> dict[str, Any]:
    """The fields of a NodeMap that a map of a growing scene has."""
    growing = None if header.map is None else header.map.provisional
    if growing is None:
        return {}
    known = growing.rotation_deg is not None and growing.centre is not None
    bounds = (growing.rotation_deg, growing.centre) if known else None
    return {"provisional": True, "views": growing.views, "bounds": bounds}
