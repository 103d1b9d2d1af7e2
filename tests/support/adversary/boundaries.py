"""The table of boundaries: what is drawn for each, what reads it, and the only errors that may come of it."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Callable
from pathlib import Path
from typing import Any

from splatnode.capture import recording
from splatnode.capture.config import CaptureConfig, PreviewHeader, decode_preview
from splatnode.capture.frame import Frame
from splatnode.capture.image_file import UnusableImage, decode_image
from splatnode.capture.messaging import network
from splatnode.capture.messaging.keyframe_queue import Spool, SpoolConfig, read_message
from splatnode.capture.messaging.messages import (
    ConsumerStatus,
    Delivery,
    DroppedHeader,
    FrameHeader,
    Key,
    Limits,
    Request,
    WireError,
    decode,
    decode_frame,
)
from splatnode.capture.messaging.network import REQUEST_LIMITS
from splatnode.capture.messaging.pubsub import Answer, Want
from splatnode.capture.process.config import ConfigError, load_config
from splatnode.capture.status import CaptureStatus, Heartbeat
from splatnode.extras.evaluate.dataset import EvaluationFileError, load_scene
from splatnode.recon.daemon import ReconStatus
from splatnode.recon.daemon.checkpoint import Store
from splatnode.recon.daemon.config import DaemonConfig as ReconConfig
from splatnode.recon.daemon.ledger import CheckpointError, Ledger
from splatnode.recon.daemon.node import Command
from splatnode.recon.locating import (
    QUERY_LIMITS,
    LocateAnswer,
    LocateRequest,
    decode_query_image,
    parse_outcome,
)
from splatnode.recon.occupancy import MapHeader
from splatnode.recon.occupancy import decode_map as map_from
from splatnode.recon.result.export import read_cameras, read_gaussians
from splatnode.recon.result.export.limits import SceneFileError
from splatnode.recon.result.message import SceneHeader, decode_snapshot
from splatnode.viewer.sources import load_result
from tests.support.adversary import cameras, documents, images, messages, scenes, stored
from tests.support.adversary.boundary import Boundary, Reader, attempt, case_of, cases_of
from tests.support.adversary.documents_read import DOCUMENTS
from tests.support.adversary.files_read import FILES
from tests.support.adversary.live_ports import PORTS

__all__ = ["BOUNDARIES", "Boundary", "Reader", "attempt", "case_of", "cases_of"]

_LIMITS = Limits(header_bytes=1 << 16, arrays=64, total_bytes=1 << 20)
_MAX_PIXELS = 4_000_000  # of the images that are drawn here: more than any honest one of them has


def _of(schema: Any, table: Any = lambda rng, header: ()) -> Callable[[random.Random], Any]:
    return lambda rng: messages.message(rng, schema, table)


def _draw_frame(rng: random.Random) -> tuple[messages.Parts, messages.Parts]:
    return messages.message(rng, Delivery), messages.message(rng, FrameHeader | DroppedHeader, _photograph)


def _read_frame(case: Any, folder: Path) -> object:
    delivery = decode(case[0], Delivery, _LIMITS).header
    message = decode(case[1], FrameHeader | DroppedHeader, _LIMITS).header
    with contextlib.suppress(WireError):  # it is of another frame
        decode_frame(Key(delivery.session, delivery.sequence), case[1], _LIMITS)
    return decode_frame(Key(message.session, message.sequence), case[1], _LIMITS)


def _read_scene(parts: Any, folder: Path) -> object:
    from splatnode.viewer.sources import _sanitize_snapshot

    return _sanitize_snapshot(decode_snapshot(decode(parts, SceneHeader, _LIMITS)).snapshot)


def _read_map(parts: Any, folder: Path) -> object:
    return map_from(decode(parts, MapHeader, _LIMITS))


def _read_query(parts: Any, folder: Path) -> object:
    return decode_query_image(decode(parts, LocateRequest, QUERY_LIMITS))


def _read_location(parts: Any, folder: Path) -> object:
    return parse_outcome(decode(parts, LocateAnswer, REQUEST_LIMITS).header)


def _decoding(schema: Any, limits: Limits = _LIMITS) -> Callable[[Any, Path], object]:
    """Of a message whose arrays nobody reads."""
    return lambda parts, folder: decode(parts, schema, limits).header


def _photograph(rng: random.Random, header: Any) -> list[messages.Row]:
    return messages.frame_rows(rng, header) if isinstance(header, dict) and header.get("type") == "frame" else []


def _preview(rng: random.Random, header: Any) -> list[messages.Row]:
    kinds = (lambda _: images.sound(".jpg"), images.jpeg, images.image)
    return [messages.bytes_row(rng.choice(kinds)(rng))]


def _scene(rng: random.Random, header: Any) -> list[messages.Row]:
    found = header.get("cameras") if isinstance(header, dict) else None
    thumbnails = [_preview(rng, header)[0] for _ in found] if isinstance(found, list) and len(found) < 10 else []
    return [*messages.gaussian_rows(rng), *thumbnails]


def _states(rng: random.Random, header: Any) -> list[messages.Row]:
    found = isinstance(header, dict) and header.get("map") is not None
    return [("u1", [2, 3, 4], bytes(rng.randrange(4) for _ in range(24)))] if found else []


def _reading(name: str, read: Callable[[Path], object]) -> Callable[[Any, Path], object]:
    def reading(data: bytes, folder: Path) -> object:
        path = folder / name
        path.write_bytes(data)
        return read(path)

    return reading


def _read_truth(files: dict[str, bytes], folder: Path) -> object:
    (folder / "images").mkdir()
    (folder / "images" / "view_0.png").write_bytes(images.sound(".png"))
    place = folder / "sparse" / "0" if any(name.endswith((".txt", ".bin")) for name in files) else folder
    stored.lay(dict(files), place)
    scene = load_scene(folder)
    return [scene.image(name) for name in scene.paths]


def _draw_truth(rng: random.Random) -> dict[str, bytes]:
    kind = rng.randrange(4)
    if kind == 0:
        return {"cameras.json": documents.json_file(rng, cameras.recorded(rng))}
    if kind == 1:
        return {"transforms.json": documents.json_file(rng, cameras.transforms(rng))}
    return cameras.colmap_text(rng) if kind == 2 else cameras.colmap_binary(rng)


def _draw_result(rng: random.Random) -> dict[str, bytes]:
    return {
        "scene.ply": scenes.ply(rng),
        "cameras.json": documents.json_file(rng, scenes.cameras(rng)),
        "report.json": documents.json_file(rng, scenes.report(rng)),
    }


def _read_result(files: dict[str, bytes], folder: Path) -> object:
    stored.lay(dict(files), folder / "result")
    return load_result(folder / "result")


def _draw_spool(rng: random.Random) -> stored.Files:
    frames = [stored.message_file(rng, _of(FrameHeader | DroppedHeader, _photograph)(rng)) for _ in range(2)]
    return stored.state_folder(rng, frames)


def _read_spool(files: stored.Files, folder: Path) -> object:
    stored.lay(files, folder / "spool")
    spool = Spool(SpoolConfig(folder))
    try:
        return [spool.get(key) for key in spool]
    finally:
        spool.close()


def _draw_store(rng: random.Random) -> tuple[stored.Files, stored.Files]:
    ledger = stored.message_file(rng, messages.message(rng, Ledger))
    frame = stored.message_file(rng, _of(FrameHeader, _photograph)(rng))
    return stored.state_folder(rng, [frame, ledger]), stored.state_folder(rng, [frame])


def _read_store(files: tuple[stored.Files, stored.Files], folder: Path) -> object:
    stored.lay(files[0], folder / "state")
    stored.lay(files[1], folder / "state" / "frames")
    store = Store(folder / "state")
    try:
        return list(store.frames()), store.load("scene", Ledger)
    finally:
        store.close()


def _read_keys(files: stored.Files, folder: Path) -> object:
    stored.lay(files, folder / "keys")
    return network.read_keys(folder / "keys")


def _read_recording(files: stored.Files, folder: Path) -> object:
    stored.lay(files, folder / "recorded")
    return [item.name for item in recording.read(folder / "recorded").frames((), _MAX_PIXELS)]


def _read_photograph(data: bytes, folder: Path) -> object:
    found = decode_image(data, _MAX_PIXELS)
    told = {"captured_at": found.captured_at, "exposure": found.exposure}
    return Frame(0, "a.png", 0, found.image, found.intrinsics, mask=found.mask, **told)


_CAPTURE = {
    "camera": {"kind": "folder", "folder": "photos"},
    "spool": {"max_mb": 5},
    "reader": {"frame_timeout_s": 1.0},
}
_RECON = {"network": {"first_port": 5000}, "checkpoint": "state", "reconstruction": {"seed": 1, "max_gaussians": 9}}
_MESSAGING, _EXPORT = "splatnode.capture.messaging", "splatnode.recon.result.export"
_TRUE, _CAPTURE_ROOM = "splatnode.extras.evaluate", "splatnode.capture"
_WIRE = Reader((WireError,), (f"{_MESSAGING}.wire", f"{_MESSAGING}.values"))
_FRAMES = Reader((WireError,), (*_WIRE.modules, f"{_MESSAGING}.keyframe_messages"))
_PREVIEWS = Reader((WireError,), ("splatnode.capture.config", f"{_MESSAGING}.jpeg"))
_SCENES = Reader((WireError,), ("splatnode.recon.result.message",))
_IMAGES = Reader(
    (UnusableImage,),
    tuple(f"splatnode.capture.{name}" for name in ("image_file", "image_header", "exposure_settings")),
)
_CAMERAS = Reader((SceneFileError,), (f"{_EXPORT}.cameras",))
_RESULTS = Reader((SceneFileError, FileNotFoundError), ("splatnode.recon.result.stored_snapshot",))
_TRUTH = Reader((EvaluationFileError, SceneFileError, FileNotFoundError), (f"{_TRUE}.truth", f"{_TRUE}.true_cameras"))
_RECORDINGS = Reader((ValueError,), ("splatnode.capture.recording",))
_YAML = Reader((ConfigError,), ("splatnode.capture.process.config", "splatnode.capture.process.config"))
_STORED = Reader((ValueError,), (f"{_MESSAGING}.message_file",))
_SPOOL = Reader((IsADirectoryError,), (f"{_MESSAGING}.spool",))
_CHECKPOINT = Reader((CheckpointError, IsADirectoryError), ("splatnode.recon.daemon.checkpoint",))
_KEYS = Reader((network.KeyFileError,), (f"{_MESSAGING}.keys",))


def _formats(name: str) -> Reader:
    return Reader((SceneFileError,), (f"{_EXPORT}.formats.{name}",))


def _document(tree: Callable[[random.Random], Any]) -> Callable[[random.Random], bytes]:
    return lambda rng: documents.json_file(rng, tree(rng))


def _settings(tree: Any) -> Callable[[random.Random], bytes]:
    return lambda rng: documents.yaml_file(rng, tree)


def _capture_config(path: Path) -> object:
    return load_config(path, CaptureConfig)


def _recon_config(path: Path) -> object:
    return load_config(path, ReconConfig)


def _draw_stored(rng: random.Random) -> bytes:
    return stored.message_file(rng, [b"a", b"bc"])


def _read_preview(parts: Any, folder: Path) -> object:
    return decode_preview(decode(parts, PreviewHeader, _LIMITS))


_MESSAGES = (
    Boundary("keyframes", _draw_frame, _read_frame, _FRAMES, 10, 6, mutants=4, tidy=False),
    Boundary(
        "keyframe requests", _of(Request), _decoding(Request, REQUEST_LIMITS), _WIRE, 10, 4, mutants=4, tidy=False
    ),
    Boundary(
        "keyframe answers",
        _of(ConsumerStatus),
        _decoding(ConsumerStatus, REQUEST_LIMITS),
        _WIRE,
        10,
        1,
        mutants=4,
        tidy=False,
    ),
    Boundary("previews", _of(PreviewHeader, _preview), _read_preview, _PREVIEWS, 200, 1, mutants=4, tidy=False),
    Boundary("scenes", _of(SceneHeader, _scene), _read_scene, _SCENES, 50, 3, mutants=4, tidy=False),
    Boundary("maps", _of(MapHeader, _states), _read_map, _WIRE, 20, 1, mutants=4, tidy=False),
    Boundary("recon's heartbeats", _of(ReconStatus), _decoding(ReconStatus), _WIRE, 10, 2, mutants=4, tidy=False),
    Boundary("capture's heartbeats", _of(CaptureStatus), _decoding(CaptureStatus), _WIRE, 10, 1, mutants=4, tidy=False),
    Boundary("any heartbeats", _of(CaptureStatus), _decoding(Heartbeat), _WIRE, 10, 1, mutants=4, tidy=False),
    Boundary(
        "commands",
        _of(Command | Answer),
        _decoding(Command | Answer, REQUEST_LIMITS),
        _WIRE,
        10,
        2,
        mutants=4,
        tidy=False,
    ),
    Boundary("queries of places", _of(LocateRequest, _preview), _read_query, _PREVIEWS, 200, 1, mutants=4, tidy=False),
    Boundary("answers on places", _of(LocateAnswer), _read_location, _WIRE, 10, 2, mutants=4, tidy=False),
    Boundary("states", _of(Want), _decoding(Want, REQUEST_LIMITS), _WIRE, 10, 2, mutants=4, tidy=False),
)
_FILES = (
    Boundary("photographs", images.image, _read_photograph, _IMAGES, 100, 3, mutants=2, tidy=False),
    Boundary(
        "scene.ply", scenes.ply, _reading("scene.ply", read_gaussians), _formats("ply"), 20, 0.7, mutants=2, tidy=False
    ),
    Boundary(
        "scene.spz", scenes.spz, _reading("scene.spz", read_gaussians), _formats("spz"), 20, 0.7, mutants=2, tidy=False
    ),
    Boundary(
        "scene.splat",
        scenes.splat,
        _reading("scene.splat", read_gaussians),
        _formats("splat"),
        20,
        0.5,
        mutants=2,
        tidy=False,
    ),
    Boundary(
        "cameras.json",
        _document(scenes.cameras),
        _reading("cameras.json", read_cameras),
        _CAMERAS,
        20,
        mutants=2,
        tidy=False,
    ),
    Boundary("results", _draw_result, _read_result, _RESULTS, 50, 0.5, mutants=2),
    Boundary("true cameras", _draw_truth, _read_truth, _TRUTH, 50, 0.5, mutants=2),
    Boundary("recordings", stored.recording, _read_recording, _RECORDINGS, 100, 0.5, mutants=2),
)
_CONFIGURATIONS = (
    Boundary(
        "capture.yaml",
        _settings(_CAPTURE),
        _reading("capture.yaml", _capture_config),
        _YAML,
        50,
        0.4,
        mutants=1,
        tidy=False,
    ),
    Boundary(
        "recon.yaml", _settings(_RECON), _reading("recon.yaml", _recon_config), _YAML, 50, 0.4, mutants=1, tidy=False
    ),
)
_STATE = (
    Boundary("messages on disk", _draw_stored, _reading("ledger", read_message), _STORED, 10, 1, mutants=2),
    Boundary("spool", _draw_spool, _read_spool, _SPOOL, 20, 0.3, mutants=2),
    Boundary("checkpoint", _draw_store, _read_store, _CHECKPOINT, 20, 0.3, mutants=2),
    Boundary("keys", stored.keys, _read_keys, _KEYS, 10, 0.5, mutants=2),
)
BOUNDARIES = (*_MESSAGES, *_FILES, *_CONFIGURATIONS, *_STATE, *DOCUMENTS, *FILES, *PORTS)
