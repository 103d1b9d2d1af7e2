"""A running node, as a program that listens to it: scenes, and what is known of free space."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any

from splatnode.api.arguments import enter_api
from splatnode.api.result import Camera, Result, camera_of, result_of
from splatnode.capture.messaging.messages import WireError, make_jpeg_array
from splatnode.capture.messaging.network import RECON_LOCATE, RECON_MAP, Network
from splatnode.capture.messaging.pubsub import NoAnswer, QueryClient, StateClient
from splatnode.capture.process.config import parse_config, read_yaml
from splatnode.capture.process.terminal import Problems, is_logged
from splatnode.recon.locating import LocateAnswer, Located, LocateRequest, NotLocated, parse_outcome
from splatnode.recon.occupancy import MapHeader, OccupancyMap, decode_map
from splatnode.recon.result.report import write_result_folder
from splatnode.recon.result.snapshot import Snapshot
from splatnode.viewer.sources import LiveSource
from splatnode.viewer.state import Moment

if TYPE_CHECKING:
    from splatnode.api.photographs import Lens, Picture

# What a node says of free space, as a thread hears it.

log = logging.getLogger(__name__)

SILENT = "the node has said nothing of a map: set occupancy.live in the configuration of splatnode recon"
_POLL_S = 0.25


@dataclass(frozen=True, eq=False)
class NodeMap:
    """A node's current knowledge of free space."""

    scene_id: str  # of the place; empty where the node has said nothing
    occupancy: OccupancyMap | None  # in the world of that scene, as it is now
    why: str  # there is no map; empty where there is one
    provisional: bool = False  # the scene grows: less certain, and withdrawn when the scene is made afresh
    views: int | None = None  # that a provisional map is made of
    # Of its least certain camera, 95 %: degrees, and of its centre, in the unit
    bounds: tuple[float, float] | None = None


NOTHING_HEARD = NodeMap("", None, SILENT)


@dataclass(frozen=True, eq=False)
class ReceivedMap:
    """The newest message about the map, and the message of recon.scene that it belongs to."""

    node_map: NodeMap
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
                    node_map = NodeMap(
                        header.scene_id, decode_map(message), header.why, **_describe_provisional(header)
                    )
                except WireError as error:
                    if is_logged(self._refusals.add("maps that were refused", error)):
                        log.warning("a map of the node was refused: %s", error)
                    node_map = NodeMap(header.scene_id, None, f"the node's map was refused: {error}")
                growing = None if header.map is None else header.map.provisional
                world = None if growing is None else (header.session, growing.revision)
                self._heard = ReceivedMap(node_map, header.map and (header.session, header.map.scene_sequence), world)
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


# A running node, as a program that listens to it.

FIRST_PORT = Network().first_port
OUTDATED = "the scene has changed since its map was made"
_JPEG_QUALITY = 95  # of an image that is sent
_LOOK_S = 0.05  # between looks at whether a map has come


@dataclass(frozen=True, eq=False)
class NodeUpdate:
    """A scene of a node, as it has just become."""

    scene_id: str  # another one is another place, with a world of its own
    result: Result  # `result.final`: verified with all evidence, and refined; `result.scale_interval`: None, or metres


@dataclass(frozen=True, eq=False)
class LiveLocation:
    """The place where an image was taken, in the scene that a node showed then."""

    scene_id: str  # of the place; `none` where the node has no scene
    found: Located | NotLocated | None  # in the world of that scene; None: nothing was looked for
    why: str  # nothing was looked for; empty where something was
    provisional: bool  # the scene grows: bounds are wider, and it will be made afresh, which withdraws this
    revision: int  # of the scene's world
    session: str  # of the node


@dataclass(frozen=True, eq=False)
class ReceivedFiles:
    """A snapshot that came over the network, as it can be written."""

    snapshot: Snapshot

    def write(self, out: Path) -> None:
        write_result_folder(self.snapshot, out, seed=0, preset_name="received from a node")


class Node:
    """A connection to a node: its scenes as they change, and where its live camera is.

    Made by `connect`. A thread listens; what nobody has taken is replaced by what is newer. As a context manager it
    closes itself.
    """

    def __init__(self, network: Network) -> None:
        self._network = network
        self._locating: QueryClient | None = None  # once somebody asks
        self._asked, self._asking = 0, threading.Lock()
        self._live = LiveSource(network)
        try:
            self._map = LiveMap(network)
        except BaseException:
            self._live.close()
            raise

    def __iter__(self) -> Iterator[NodeUpdate]:
        """Each update as it comes, the present scene first; ends when the connection is closed by another thread.

        Raises PermissionError where the node does not let this program in.
        """
        while (update := self.wait()) is not None:
            yield update

    @enter_api()
    def wait(self, timeout_s: float | None = None) -> NodeUpdate | None:
        """The next update; None where none comes in so many seconds, or when the connection is closed.

        Raises PermissionError where the node does not let this program in.
        """
        moment = self._live.wait(timeout_s)
        return None if moment is None else _update(moment)

    @property
    def live_camera(self) -> Camera | None:
        """Returns the live camera in the newest scene; None where it is not known, as before the scene is final.

        The node looks once a second; the camera has no bounds, and its K is that of the preview.
        """
        tracked = self._live.live_camera
        return None if tracked is None else camera_of(tracked)

    @property
    @enter_api()
    def map(self) -> NodeMap:
        """Which space is free, occupied, or not seen, where the node's configuration has `occupancy.live`.

        A map is of a scene that is final, as this program has heard it last; with `occupancy.provisional` also of one
        that grows, which `provisional` says. Else there is none, and `why` says so.
        Raises PermissionError where the node does not let this program in.
        """
        heard = self._map.newest
        if heard.world is not None:  # it grows with the scene
            session, worlds = self._live.worlds
            world = worlds.get(heard.node_map.scene_id)
            if world is not None and session == heard.world[0] and world.revision > heard.world[1]:
                return NodeMap(heard.node_map.scene_id, None, OUTDATED)
            return heard.node_map
        if heard.node_map.occupancy is not None and heard.scene != self._live.scene:
            return NodeMap(heard.node_map.scene_id, None, OUTDATED)
        return heard.node_map

    @enter_api()
    def wait_for_map(self, timeout_s: float | None = None) -> NodeMap:
        """As `map`, as soon as there is one; what is known after so many seconds, or when the connection is closed."""
        until = None if timeout_s is None else time.monotonic() + timeout_s
        while (found := self.map).occupancy is None and not self._live.closed.wait(_LOOK_S):
            if until is not None and time.monotonic() >= until:
                return self.map
        return found

    @enter_api()
    def localise(
        self,
        image: str | PathLike[str] | Picture,
        *,
        intrinsics: Lens | None = None,
        follows: bool = False,
        timeout_s: float = 10.0,
    ) -> LiveLocation:
        """Asks the node where an image was taken, in the scene that it shows, also while that grows.

        The node's configuration needs `localization.live`. `image` and `intrinsics` are as for `Result.localise`;
        `follows`: the image was taken near to the last one, which makes the search faster. `find_withdrawal` tells
        whether the answer still holds. Raises TimeoutError where no answer comes in time, PermissionError, and
        ValueError for an image that cannot be used.
        """
        from splatnode.api.photographs import load_query_frame  # brings what matches photographs

        frame = load_query_frame(image, intrinsics)
        with self._asking:
            self._locating = self._locating or QueryClient(RECON_LOCATE, self._network, LocateAnswer)
            self._asked += 1
            request = LocateRequest(self._asked, frame.intrinsics, follows)
            try:
                answer = self._locating.ask(request, [make_jpeg_array(frame.image, _JPEG_QUALITY)], timeout_s)
            except NoAnswer as error:
                raise TimeoutError(f"{error}. Set `localization: {{live: true}}` in recon's file") from None
        world = answer.scene_id, parse_outcome(answer), answer.why, answer.provisional
        return LiveLocation(*world, answer.revision, answer.session)

    def find_withdrawal(self, location: LiveLocation) -> str:
        """Says why an answer of `localise` does not hold any more, by the node's last heartbeat; empty where it holds.

        A scene's world changes when it is made afresh, loses a keyframe, or its cameras move beyond their bounds.
        """
        session, worlds = self._live.worlds
        if not session or location.found is None:
            return "" if location.found is not None else location.why
        world = worlds.get(location.scene_id)
        if session != location.session:
            return "the node was started again"
        if world is None:
            newest = max((each.revision for each in worlds.values()), default=0)
            return "" if newest < location.revision else "the node does not tell of this scene any more"
        return (world.why or "the scene has changed") if world.revision > location.revision else ""

    @property
    def silent_s(self) -> float:
        """Seconds since anything was heard of the node, which speaks each second; infinite before the first time."""
        return self._live.age_s

    def close(self) -> None:
        """Ends the connection, and whoever waits for an update."""
        self._live.close()
        self._map.close()
        with self._asking:
            if self._locating is not None:
                self._locating.close()

    def __enter__(self) -> Node:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@enter_api()
def connect(
    address: str | PathLike[str] | None = None,
    *,
    keys: str | PathLike[str] | None = None,
    first_port: int | None = None,
) -> Node:
    """A connection to a node, whether it runs already or starts later.

    - `address`: None for the node of this user on this machine; the folder of its sockets (`network.directory`); its
      configuration file (.yaml); or, over a network, the machine's address such as "192.168.1.7".
    - `keys`: over a network, the folder that `splatnode keygen` made.
    - `first_port`: over a network, `network.first_port` of the node. None: its default, 47310.

    Raises ValueError where the address or the keys cannot be used, PermissionError where the folder is not private.
    """
    return Node(_network(address, keys, first_port))


def _network(address: str | PathLike[str] | None, keys: str | PathLike[str] | None, first_port: int | None) -> Network:
    if address is None:
        return Network()
    path = Path(address)
    if path.suffix.lower() in (".yaml", ".yml"):
        return parse_config(read_yaml(path).get("network", {}), Network, "network")
    if path.is_dir():
        return Network(directory=path)
    if isinstance(address, PathLike) or "/" in address:
        raise ValueError(
            f"{address} is no folder and no .yaml file; give the node's network.directory or configuration"
        )
    if keys is None:
        raise ValueError(f"keys must be the folder that `splatnode keygen` made, to connect to {address}; got None")
    return Network(tcp=address, keys=Path(keys), first_port=first_port or FIRST_PORT)


def _update(moment: Moment) -> NodeUpdate:
    return NodeUpdate(moment.scene_id, result_of(moment.snapshot, ReceivedFiles(moment.snapshot)))
