"""A result or a running node in viser, a page in a browser: its server, and what its visitors see.

The only file that imports viser, which is an extra. By itself viser lets in whoever reaches its port, takes the next
port where one is taken, waits for ever where it cannot listen, and opens a tunnel to the internet for any visitor who
asks. Here it listens on the loopback address unless told, answers its own page alone, and opens no tunnel. Visitors see
Gaussians, cameras with their photographs, the live camera, and the verdict. Everything but `_make_click_handler` runs
on one thread.
"""

from __future__ import annotations

import contextlib
import errno
import http
import importlib
import ipaddress
import socket
import time
from collections.abc import Callable, Iterator
from typing import Any, NoReturn
from urllib.parse import urlsplit

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from splatnode.capture.process.text import sanitize_text
from splatnode.recon.result.export.limits import compute_base_rgb
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.viewer.analysis import camera_colours
from splatnode.viewer.shapes import TRACKED_COLOUR, Colour, draw_given_pose, frustum_depth
from splatnode.viewer.sources import Source
from splatnode.viewer.state import BACKGROUND, Moment, Viewpoint, move_to_camera, overview
from splatnode.viewer.web import LOOPBACK, Access

_LIVE = "/live camera"
_NEAR = 0.01  # world units, of what is drawn
_MOST_DROPPED = 50  # that are told of
_LARGEST_VARIANCE = 3e4  # covariances travel as 16-bit floats, which end at 65504
_LARGEST_GROWTH = 64.0  # of the scene on its way: beyond it, small Gaussians gain nothing


class ViserStage:
    """The scene, and the switches beside it, which are the same for all visitors; each has an own viewpoint."""

    def __init__(self, server: Any) -> None:
        self.server = server
        server.scene.set_background_image(np.full((1, 1, 3), BACKGROUND, np.uint8), format="png")
        self.cameras = server.gui.add_checkbox("Cameras", initial_value=True)
        self.photographs = server.gui.add_checkbox("Photographs", initial_value=True)
        self._texts = [_text(server, "Scene", "None has come yet.")]
        self._nodes: dict[str, Any] = {}  # by their names in viser's tree
        self._frusta: list[tuple[Any, npt.NDArray[np.uint8] | None]] = []  # each with its photograph
        self._switched = True, True  # as drawn: cameras, photographs
        self._tracked: tuple[CameraEstimate | None, Any] = None, None
        self._centres = np.zeros((0, 3))  # of the cameras
        self._depth = 1.0  # of a frustum
        self._scene_id: str | None = None

    def draw(self, moment: Moment) -> None:
        """Shows the moment in place of the one before. Where it is another scene, visitors are taken to it."""
        snapshot, server = moment.snapshot, self.server
        self._centres = np.array([camera.T_world_camera[:3, 3] for camera in snapshot.cameras]).reshape(-1, 3)
        self._depth = frustum_depth(moment)
        with server.atomic():
            before, self._nodes, self._frusta = self._nodes, {}, []
            if len(snapshot.gaussians):
                self._nodes["/gaussians"] = server.scene.add_gaussian_splats(
                    "/gaussians", **make_splat_arguments(snapshot.gaussians)
                )
            for camera, colour in zip(snapshot.cameras, camera_colours(snapshot.cameras), strict=True):
                self._draw_camera(camera, colour, moment)
            for name in sorted(before.keys() - self._nodes.keys(), reverse=True):  # the others replaced their namesakes
                before[name].remove()
            for text in self._texts:
                text.remove()
            self._texts = [_text(server, title, text) for title, text in _describe_snapshot(snapshot)]
        if moment.scene_id != self._scene_id and self._nodes:  # before, there was nothing to be taken to
            self._scene_id = moment.scene_id
            self._set_initial_view(overview(moment))

    def _set_initial_view(self, view: Viewpoint) -> None:
        """Takes visitors there, and those who come later. Not within a scene: viser moves all who look already."""
        server, first = self.server, self.server.initial_camera
        with server.atomic():
            server.scene.set_up_direction(tuple(view.up))
            first.up, first.position, first.look_at = view.up, view.T_world_camera[:3, 3], view.pivot
            first.fov = _vertical_field_of_view(view.lens[0], view.lens[2])
        for client in server.get_clients().values():
            _go(client, view)

    def track(self, camera: CameraEstimate | None) -> None:
        """Shows where the live camera is; None: that is not known."""
        before, frustum = self._tracked
        if camera is before:
            return
        if camera is not None:
            frustum = _frustum(self.server, _LIVE, camera, 1.2 * self._depth, TRACKED_COLOUR)
        elif frustum is not None:
            frustum.remove()
            frustum = None
        self._tracked = camera, frustum

    def apply_client_changes(self) -> None:
        """Does what visitors have asked for since."""
        switched = self.cameras.value, self.photographs.value
        if switched != self._switched:
            self._switched = switched
            with self.server.atomic():
                for frustum, photograph in self._frusta:
                    frustum.visible = switched[0]
                    frustum.image = photograph if switched[1] else None
        for client in self.server.get_clients().values():
            away = np.linalg.norm(self._centres - client.camera.position, axis=1)
            # A photograph right at the eye would be all that is seen: it is nearer than what is drawn.
            client.camera.near = 2.0 * self._depth if (away < self._depth).any() else _NEAR

    def _draw_camera(self, camera: CameraEstimate, colour: Colour, moment: Moment) -> None:
        own = sanitize_text(camera.name).replace("/", "∕")  # a stroke in a name would be a branch of the tree
        name = f"/cameras/{own}"
        photograph = moment.snapshot.images.get(camera.name)
        shown = photograph if self._switched[1] else None
        frustum = _frustum(self.server, name, camera, self._depth, colour, shown)
        frustum.visible = self._switched[0]
        frustum.on_click(_make_click_handler(camera, moment))
        self._frusta.append((frustum, photograph))
        label = self.server.scene.add_label(f"{name}/name", sanitize_text(camera.name), font_screen_scale=0.7)
        self._nodes |= {name: frustum, f"{name}/name": label}
        if camera.given is not None:  # no child of the frustum, which has the pose that was estimated
            place, ends = f"/given/{own}", draw_given_pose(camera, self._depth).astype(np.float32)
            rgb = tuple(round(255 * part) for part in colour)
            self._nodes[place] = self.server.scene.add_line_segments(
                place, points=ends, colors=rgb, thickness=1.0, thickness_units="screen"
            )


def make_splat_arguments(gaussians: GaussianArrays) -> dict[str, Any]:
    """The arguments of `add_gaussian_splats`: view-dependent colour is left out, which viser does not draw.

    The scene is sent larger and drawn smaller by as much, so that covariances of small Gaussians are no 0 in 16 bits.
    """
    axes = Rotation.from_quat(gaussians.quats[:, [1, 2, 3, 0]]).as_matrix() * gaussians.scales[:, None, :]
    covariances = axes @ axes.transpose(0, 2, 1)
    growth = float(np.clip(np.sqrt(_LARGEST_VARIANCE / covariances.max()), 1e-3, _LARGEST_GROWTH))
    return {
        "centers": (growth * gaussians.means).astype(np.float32),
        "covariances": (growth**2 * covariances).astype(np.float32),
        "rgbs": compute_base_rgb(gaussians),
        "opacities": gaussians.opacities[:, None],
        "scale": 1.0 / growth,
    }


def _frustum(
    server: Any,
    name: str,
    camera: CameraEstimate,
    depth: float,
    colour: Colour,
    image: npt.NDArray[np.uint8] | None = None,
) -> Any:
    up = camera.height / (2.0 * camera.K[1, 1])  # half a picture, at a depth of 1
    aspect = camera.width / camera.height
    return server.scene.add_camera_frustum(
        name,
        fov=_vertical_field_of_view(camera.K, camera.height),
        aspect=aspect,
        scale=depth * np.cbrt(aspect * up * up / 3.0),  # viser draws frusta of one scale with one volume
        thickness=1.5,
        thickness_units="screen",
        color=tuple(round(255 * part) for part in colour),
        image=image,
        wxyz=Rotation.from_matrix(camera.T_world_camera[:3, :3]).as_quat()[[3, 0, 1, 2]],
        position=camera.T_world_camera[:3, 3],
        cast_shadow=False,
        receive_shadow=False,
    )


def _make_click_handler(camera: CameraEstimate, moment: Moment) -> Callable[[Any], None]:
    """Returns the callback that takes the visitor who clicks a camera to its view."""
    view = move_to_camera(overview(moment), camera)
    return lambda event: _go(event.client, view)


def _go(client: Any, view: Viewpoint) -> None:
    at = client.camera
    with client.atomic():
        at.up_direction = -view.T_world_camera[:3, 1]
        at.position, at.look_at = view.T_world_camera[:3, 3], view.pivot
        at.fov = _vertical_field_of_view(view.lens[0], view.lens[2])


def _text(server: Any, title: str, text: str) -> Any:
    """Plain text: viser runs what stands in its Markdown."""
    return server.gui.add_text(title, text, multiline=True, disabled=True)


def _describe_snapshot(snapshot: Snapshot) -> Iterator[tuple[str, str]]:
    """Titles and texts beside the picture."""
    verdict = snapshot.verdict
    yield verdict.code.value, sanitize_text(" ".join(filter(None, (verdict.message, verdict.advice))))
    state = "final" if snapshot.final else "being made"
    yield "Scene", f"{len(snapshot.cameras)} cameras, {len(snapshot.gaussians)} Gaussians, {state}"
    if snapshot.dropped:
        yield (
            "Left out",
            "\n".join(sanitize_text(f"{each.name}: {each.reason}") for each in snapshot.dropped[:_MOST_DROPPED]),
        )


def _vertical_field_of_view(K: npt.NDArray[np.float64], height: float) -> float:
    """Radians from the upper edge of the picture to the lower one."""
    return 2.0 * float(np.arctan2(height / 2.0, K[1, 1]))


viser: Any = importlib.import_module("viser")  # by its name: where it is not installed, pyright takes this file for it
websockets: Any = importlib.import_module("websockets.asyncio.server")  # brought by viser

PORT = 8080
_POLL_S = 0.1
_TITLE = "splatnode"
_EVERYWHERE = ("0.0.0.0", "::")


def show(source: Source, listen: str | None, port: int, say: Callable[[str], None]) -> NoReturn:
    """Serves until the process is told to end. Raises OSError where it cannot listen, and what the source raises."""
    with contextlib.closing(source), open_server(listen or LOOPBACK, port) as server:
        stage = ViserStage(server)
        say(_invitation(listen, server.get_port()))
        while True:
            moment = source.take()
            if moment is not None:
                stage.draw(moment)
            stage.track(source.live_camera)
            stage.apply_client_changes()
            time.sleep(_POLL_S)


@contextlib.contextmanager
def open_server(address: str, port: int) -> Iterator[Any]:
    """A server of viser's that listens there, port 0: any that is free. Raises OSError where it cannot listen."""
    port = _free_port(address, port)  # viser would wait for ever, or go elsewhere
    importlib.import_module("rich").get_console().quiet = True  # to which viser prints; the address is told by us
    with _refuse_foreign_origins(address) as guarded:
        server = _Server(host=address, port=port, label=_TITLE, verbose=False)
    try:
        if server.get_port() != port:
            raise _port_in_use_error(address, port)
        if not guarded:
            raise RuntimeError(
                "this release of viser starts in another way than 1.1.1, and would answer any site's page"
            )
        server.gui.configure_theme(show_share_button=False)
        yield server
    finally:
        server.stop()


def _free_port(address: str, port: int) -> int:
    """The port, or any that is free for 0. Raises OSError where that address has none."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    try:
        with socket.create_server((address, port), family=family) as tried:
            return tried.getsockname()[1]
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            raise _port_in_use_error(address, port) from None
        raise OSError(f"cannot listen on {address}, port {port}: {error.strerror}") from None


def _port_in_use_error(address: str, port: int) -> OSError:
    return OSError(f"cannot listen on {address}, port {port}: another program listens there. --port takes another port")


def _invitation(listen: str | None, port: int) -> str:
    """One line: what to open, and what to know of it."""
    if listen is None:
        return (
            f"splatnode: open http://{LOOPBACK}:{port}/ in a browser on this machine; on another one first run "
            f"ssh -L {port}:{LOOPBACK}:{port} {socket.gethostname()}, then open the same address there. Ctrl-C ends it"
        )
    host = socket.gethostname() if listen in _EVERYWHERE else f"[{listen}]" if ":" in listen else listen
    return (
        f"splatnode: open http://{host}:{port}/ in a browser. Everybody who reaches it can look: viser has no key, and "
        "nothing is encrypted. splatnode view --web --listen has a key. Ctrl-C ends it"
    )


class _Server(viser.ViserServer):
    """Opens no tunnel, whoever asks."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Does not."""


@contextlib.contextmanager
def _refuse_foreign_origins(address: str) -> Iterator[list[int]]:
    """While a server starts: it is made to refuse what pages of other sites ask of it, which viser does not.

    Gives the ports for which that was done.

    A page of any site may open a web socket to this machine; the browser tells of which site it is. And a name of the
    site's own may lead here, so that on the loopback address only its own names are answered.
    """
    original = websockets.serve
    loopback = Access(address, 0, None) if ipaddress.ip_address(address).is_loopback else None
    ports: list[int] = []

    def serve_same_origin(
        handler: object, host: str, port: int, *, process_request: Callable[..., Any], **options: Any
    ) -> Any:
        def answer(connection: Any, request: Any) -> Any:
            asked, origin = request.headers.get("Host"), request.headers.get("Origin")
            by_its_name = loopback is None or loopback.is_allowed_host(asked)
            if not by_its_name or (origin is not None and urlsplit(origin).netloc != asked):
                return connection.respond(http.HTTPStatus.FORBIDDEN, "This server answers its own page.\n")
            return process_request(connection, request)

        ports.append(port)
        return original(handler, host, port, process_request=answer, **options)

    websockets.serve = serve_same_origin
    try:
        yield ports
    finally:
        websockets.serve = original
