"""The boundaries of documents, requests and words: what result folders tell, what batches keep, what people type."""

from __future__ import annotations

import argparse
import contextlib
import functools
import io
import json
import os
import random
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from splatnode.capture import film
from splatnode.capture.image_header import name_time
from splatnode.capture.messaging.keyframe_queue import Quarantine, QuarantineConfig
from splatnode.capture.process.config import record_in
from splatnode.capture.process.files import NotOwnerOnly
from splatnode.capture.process.text import is_printable, sanitize_name
from splatnode.capture.status import LastRun
from splatnode.command_line import build_parser
from splatnode.extras import batch
from splatnode.extras.batch import BatchRecording, read_list
from splatnode.extras.jobs import End
from splatnode.recon.result import submap_index
from splatnode.recon.result.export import read_digests
from splatnode.recon.result.export.limits import SceneFileError
from splatnode.recon.result.message import SceneHeader, decode_snapshot
from splatnode.recon.result.snapshot import GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.viewer import session as viewer_text
from splatnode.viewer import web
from splatnode.viewer.shapes import ground
from splatnode.viewer.sources import _sanitize_snapshot
from splatnode.viewer.state import Moment
from splatnode.viewer.web import Board, Content, load_or_create_key
from tests.support.adversary import documents, edges, images, messages, requests, stored
from tests.support.adversary.boundary import Boundary, Reader
from tests.support.adversary.schema_values import value

_RECORDING, _END = BatchRecording("a", "/a"), End(0, "", 1.0, 1.0)


class Refused(ValueError):
    """What was asked for was not given, as it should be."""


def of_schema(schema: Any) -> Callable[[random.Random], bytes]:
    """JSON that is a `schema`, but for some of its values; now and then the text is not JSON's."""

    def draw(rng: random.Random) -> bytes:
        tree = value(rng, schema, rng.choice((0.0, 0.0, 0.004, 0.02, 0.1)))
        if rng.random() < 0.1:
            return documents.json_file(rng, tree)
        text = json.dumps(tree, default=lambda each: each.hex())
        if rng.random() < 0.02 and text.startswith("{"):  # a key twice
            text = text[:-1] + "," + text[1:]
        return text.encode("utf-8", "surrogatepass")

    return draw


def _written(name: str, read: Callable[[Path], object]) -> Callable[[bytes, Path], object]:
    def reading(data: bytes, folder: Path) -> object:
        (folder / name).write_bytes(data)
        return read(folder / name)

    return reading


def _read_whole(path: Path) -> object:
    return submap_index.read_map_set(path.parent)


def _read_report(path: Path) -> object:
    found = batch.read_outcome(_RECORDING, path.parent, _END)
    if not is_printable(found.message) or not is_printable(found.verdict):
        raise AssertionError(f"a row that is not printable: {found.message!a}")
    return found


def _read_ledger(path: Path) -> object:
    with batch.Ledger(path.parent, ["replay"]) as opened:
        return [opened.verdict(_RECORDING), *opened.rows([_RECORDING])]


def _draw_ledger(rng: random.Random) -> bytes:
    row = {"name": "a", "source": "/a", "verdict": "OK", "message": "", "published": True, "photographs": 3}
    row |= {"left_out": 0, "rotation_deg": 0.1, "centre_percent": 0.1, "focal_percent": 0.1, "gaussians": 10}
    row |= {"seconds": 1.0, "reconstruction_s": 1.0, "memory_mb": 10.0, "exit_code": 0, "ended_at": 1.0}
    trees = [{"batch": 1, "command": ["replay"]}, row, row]
    at = rng.randrange(3)
    trees[at] = edges.mangled(rng, trees[at], rng.choice((0, 1, 1, 2)))
    text = "\n".join(json.dumps(tree, default=lambda each: each.hex()) for tree in trees)
    return (text + rng.choice(("\n", "", "\r\n"))).encode("utf-8", "surrogatepass")


def _read_quarantine(files: stored.Files, folder: Path) -> object:
    stored.lay(files, folder / "quarantine")
    kept = Quarantine(folder / "quarantine", QuarantineConfig())
    return len(kept), kept.unseen, kept.newest(10)


def _draw_quarantine(rng: random.Random) -> stored.Files:
    record = (
        of_schema(dict[str, str])(rng)
        if rng.random() < 0.2
        else documents.json_file(rng, {"name": "a.png", "reason": "its stamp", "file": "b.frame"})
    )
    seen = edges.number_text(rng).encode("utf-8", "surrogatepass")
    return {"000000000001.frame": b"x", "000000000001.json": record, "seen": seen, "9" * 18 + ".frame": b""}


def _read_last_run(data: bytes, folder: Path) -> object:
    try:
        found = record_in(data, LastRun)
    except msgspec.MsgspecError as error:  # as last_run takes it
        raise Refused("the last run is not known") from error
    return str(found), found


def _read_manifest(path: Path) -> object:
    return read_digests(path)


def _read_list(path: Path) -> object:
    return [os.fsencode(each) for each in read_list(path, (), set())]


def _draw_list(rng: random.Random) -> bytes:
    lines = [rng.choice(("photos/a", "# b", "", edges.text(rng))) for _ in range(rng.choice((0, 1, 5)))]
    return "\n".join(lines).encode("utf-8", "surrogatepass") + rng.choice((b"", b"\n", b"\xff\0"))


def _draw_name(rng: random.Random) -> bytes:
    """The name of a photograph or of a recording and its part."""
    kind = rng.randrange(4)
    if kind == 0:
        text = f"{edges.odd(rng, 1341847980, 0.3)}.{edges.odd(rng, 722988, 0.3)}.png"
    elif kind == 1:
        text = f"IMG_{edges.odd(rng, 20240131, 0.3)}_{edges.odd(rng, 154501, 0.3)}.jpg"
    elif kind == 2:
        text = f"film.mp4#t={edges.odd(rng, 10, 0.5)},{edges.odd(rng, 20.5, 0.5)}"
    else:
        text = edges.text(rng) + edges.odd(rng, "#episode_000003/cam", 0.3)
    return text.encode("utf-8", "surrogatepass")


def _read_name(data: bytes, folder: Path) -> object:
    name = os.fsdecode(data.replace(b"\0", b""))
    shown = sanitize_name(name)
    if not is_printable(shown, 255):
        raise AssertionError(f"a name that is not printable: {shown!a}")
    told = name_time(name)
    return told, film._parse_seconds(Path("film.mp4"), name.partition("#")[2]) if "#t=" in name else None


def _draw_options(rng: random.Random) -> list[bytes]:
    return requests.arguments(rng, _options())


@functools.lru_cache(maxsize=1)
def _parser() -> argparse.ArgumentParser:
    return build_parser()


@functools.lru_cache(maxsize=1)
def _options() -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Each verb with its options, as the command line knows them."""
    (verbs,) = [each for each in _parser()._actions if isinstance(each, argparse._SubParsersAction)]
    return tuple(
        (name, tuple(option for action in verb._actions for option in action.option_strings))
        for name, verb in verbs.choices.items()
    )


def _read_arguments(words_: list[bytes], folder: Path) -> object:
    """As the shell would give them. Raises Refused where the command line refuses them in printable lines."""
    said, shown = io.StringIO(), io.StringIO()
    try:
        with contextlib.redirect_stderr(said), contextlib.redirect_stdout(shown):
            args = _parser().parse_args([os.fsdecode(word.replace(b"\0", b"")) for word in words_])
    except SystemExit as end:
        text = said.getvalue() + shown.getvalue()
        if end.code not in (0, 2) or any(not line.isprintable() for line in text.split("\n")):
            raise AssertionError(f"exit {end.code}, said {text!a:.500}") from end
        raise Refused(text.strip().rpartition("\n")[2]) from None
    return {name: each for name, each in vars(args).items() if not callable(each)}


class _Connection:
    """One that has sent its request already, and keeps what is answered."""

    def __init__(self, request: bytes) -> None:
        self._request, self.answered = request, bytearray()

    def makefile(self, mode: str, *_: Any) -> io.BufferedReader:
        return io.BufferedReader(io.BytesIO(self._request))  # pyright: ignore[reportArgumentType]

    def sendall(self, data: bytes) -> None:
        self.answered += data

    def settimeout(self, _: float) -> None: ...

    def setsockopt(self, *_: Any) -> None: ...

    def shutdown(self, _: int) -> None: ...


@functools.lru_cache(maxsize=2)
def _server(key: str | None) -> web.Server:
    """Bound to a port of this machine, and never started: requests are handed to it here."""
    server = web.Server(Board(), "127.0.0.1", 0, key)
    server.wait_s = 0.0
    server.access = replace(server.access, port=8347)
    server.board.publish({"good": None}, Content(Moment(_snapshot(), 0.0), None), live=False)
    return server


def _snapshot() -> Snapshot:
    verdict = Verdict(Code.OK, "fine", "", publishable=True)
    return Snapshot(0, verdict, (), GaussianArrays.empty(), {}, (), 1)


def _read_request(data: bytes, folder: Path) -> object:
    """The status of the answer. Raises Refused for any but 200 and 303."""
    statuses = []
    for key in (None, requests.KEY):
        connection: Any = _Connection(data)
        web._Request(connection, ("127.0.0.1", 1), _server(key))
        head = bytes(connection.answered).partition(b"\r\n\r\n")[0]
        if key and b" 200 OK" in head[:20] and key.encode() not in data:
            raise AssertionError(f"let in without the key: {head!r:.200}")
        if any(byte < 32 and byte not in b"\r\n" for byte in head) or b"\r\n" not in head + b"\r\n":
            raise AssertionError(f"the head of the answer has control characters: {head!r:.500}")
        statuses.append(head[9:12])
    if not any(status in (b"200", b"303") for status in statuses):
        raise Refused(str(statuses))
    return statuses


def _draw_shown(rng: random.Random) -> messages.Parts:
    def rows(rng: random.Random, header: Any) -> list[messages.Row]:
        found = header.get("cameras") if isinstance(header, dict) else None
        count = len(found) if isinstance(found, list) and len(found) < 10 else 0
        return [*messages.gaussian_rows(rng), *(messages.bytes_row(images.sound(".jpg")) for _ in range(count))]

    return messages.message(rng, SceneHeader, rows)


def _read_shown(parts: messages.Parts, folder: Path) -> object:
    """A scene as far as the browser's page and the panel show it."""
    from splatnode.capture.messaging.messages import Limits, decode

    snapshot = decode_snapshot(decode(parts, SceneHeader, Limits(1 << 16, 64, 4, 1 << 20))).snapshot
    moment = Moment(_sanitize_snapshot(snapshot), time.monotonic(), "scene-1")
    content = Content(moment, None)
    lines = [
        *viewer_text.verdict_lines(moment),
        *viewer_text.bounds_lines(moment),
        *viewer_text.depth_lines(moment),
        *viewer_text.view_depth_lines(moment, 100),
        *viewer_text.count_lines(moment),
        *viewer_text.place_lines(moment),
        *viewer_text.rejection_lines(moment, 200),
        *viewer_text.scale_lines(moment, ground(moment)),
    ]
    shapes = np.frombuffer(content.shapes, np.uint8).size + len(content.gaussians)
    return lines, shapes


def _read_key(path: Path) -> object:
    path.chmod(0o600)
    return load_or_create_key(path)


def _draw_key(rng: random.Random) -> bytes:
    return rng.choice(
        (
            requests.KEY.encode(),
            requests.KEY.encode() + b"\n",
            b"",
            b"\n",
            b"x" * 31,
            b"x" * 129,
            b"\xff" * 40,
            b"a\0" * 20,
            b"x" * 1001,
            edges.text(rng).encode("utf-8", "surrogatepass"),
        )
    )


_BATCH, _WEB = "splatnode.extras.batch", "splatnode.viewer.web"
_WHOLE = Reader((SceneFileError,), ("splatnode.recon.result.submap_index",))
_REPORTS = Reader((), (f"{_BATCH}.answer",))
_LEDGERS = Reader((batch.OtherBatch,), (f"{_BATCH}.ledger",))
_QUARANTINES = Reader((), ("splatnode.capture.messaging.keyframe_queue",))
_LAST_RUNS = Reader((Refused,), ("splatnode.capture.status",))
_MANIFESTS = Reader((), ("splatnode.recon.result.export",))
_LISTS = Reader((ValueError,), (f"{_BATCH}.sources",))
_NAMES = Reader((ValueError,), ("splatnode.capture.image_header", "splatnode.capture.film"))
_ARGUMENTS = Reader((Refused,), ("splatnode.capture.process.arguments", "splatnode.capture.process.text"))
_REQUESTS = Reader((Refused,), (f"{_WEB}.server", f"{_WEB}.access"))
_SHOWN = Reader((ValueError,), (f"{_WEB}.content", "splatnode.viewer.session"))
_KEYS = Reader((ValueError, NotOwnerOnly), (f"{_WEB}.access",))

DOCUMENTS = (
    Boundary(
        "places.json",
        of_schema(submap_index._File),
        _written("places.json", _read_whole),
        _WHOLE,
        50,
        1,
        mutants=4,
        tidy=False,
        printed=True,
    ),
    Boundary(
        "reports of a batch",
        of_schema(batch._Report),
        _written("report.json", _read_report),
        _REPORTS,
        20,
        1,
        mutants=4,
        tidy=False,
    ),
    Boundary(
        "batch.jsonl", _draw_ledger, _written("batch.jsonl", _read_ledger), _LEDGERS, 20, 0.5, mutants=3, tidy=False
    ),
    Boundary("quarantine", _draw_quarantine, _read_quarantine, _QUARANTINES, 20, 0.2, mutants=1, printed=True),
    Boundary("last runs", of_schema(LastRun), _read_last_run, _LAST_RUNS, 10, 4, mutants=8, tidy=False, printed=True),
    Boundary(
        "manifests",
        of_schema(dict[str, dict[str, dict[str, str]]]),
        _written("manifest.json", _read_manifest),
        _MANIFESTS,
        20,
        0.5,
        mutants=4,
        tidy=False,
    ),
    Boundary("lists", _draw_list, _written("list.txt", _read_list), _LISTS, 10, 1, mutants=3, tidy=False),
    Boundary("names", _draw_name, _read_name, _NAMES, 10, 4, mutants=3, tidy=False),
    Boundary("arguments", _draw_options, _read_arguments, _ARGUMENTS, 20, 2, mutants=3, tidy=False),
    Boundary("requests", requests.request, _read_request, _REQUESTS, 20, 1, mutants=3, tidy=False),
    Boundary("scenes that are shown", _draw_shown, _read_shown, _SHOWN, 50, 0.5, mutants=2, tidy=False, printed=True),
    Boundary("keys of the browser", _draw_key, _written("key", _read_key), _KEYS, 10, 0.3, mutants=2),
)
