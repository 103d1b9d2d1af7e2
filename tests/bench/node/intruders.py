"""Faults of `tests.bench faults` with keys: who is not allowed, and who meets another machine than expected."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from splatnode.capture.messaging.network import RECON_SCENE, Network, NotAllowed, allow, create_keys, expect_server
from splatnode.capture.messaging.pubsub import StateClient
from splatnode.capture.process.config import parse_config
from splatnode.recon.result.message import SceneHeader
from tests.bench.node.trial import RECON, Trial, expect, expect_whole, wait_for
from tests.support.node import Node, running


def unauthorised(trial: Trial) -> None:
    """A client whose key is not allowed hears nothing, and the node goes on."""
    network, stranger = _over_tcp(trial)
    with running(trial.node(network=network)) as node:
        node.start("recon")
        node.start("capture")
        wait_for(lambda: "event=ready" in node.log("recon"), "recon that runs")
        outsider = StateClient(RECON_SCENE, parse_config(network | {"keys": str(stranger)}, Network), SceneHeader)
        refused = False
        deadline = time.monotonic() + 15
        while not refused and time.monotonic() < deadline:
            try:
                expect(outsider.poll(1.0) is None, "a stranger heard the scene")
            except NotAllowed:
                refused = True
        outsider.close()
        expect(refused, "the stranger was not told that it is not allowed")
        expect_whole(node)


def wrong_key(trial: Trial) -> None:
    """recon that expects another machine than it meets says so, goes on, and gets no keyframe."""
    network, stranger = _over_tcp(trial)
    expect_server(stranger, (stranger / "public.key").read_bytes().strip())
    with running(trial.node(network=network)) as node:
        node.start("capture")
        other = Node(
            trial.folder / "other",
            {"camera": {"kind": "folder", "folder": str(trial.images)}},
            RECON,
            network | {"keys": str(stranger), "directory": str(trial.folder / "other" / "run")},
        )
        with running(other):
            process = other.start("recon")
            wait_for(lambda: "does not have the key" in other.log("recon"), "word of the wrong key")
            trial.some_time(3.0)
            expect(process.poll() is None, "recon with the wrong key ended")
            expect(node.spooled() > 0, "a keyframe was given to it")
            expect(other.end("recon") == 0, "recon with the wrong key did not end cleanly")
        node.start("recon")
        expect_whole(node)


def revoked_key(trial: Trial) -> None:
    """A key that is taken back: who is connected stays so until it connects anew, and is then told what to do."""
    network, stranger = _over_tcp(trial)
    allow(Path(network["keys"]), "stranger", (stranger / "public.key").read_bytes())
    theirs = parse_config(network | {"keys": str(stranger)}, Network)
    with running(trial.node(network=network)) as node:
        node.start("recon")
        node.start("capture")
        connected = StateClient(RECON_SCENE, theirs, SceneHeader)
        wait_for(lambda: connected.poll(0.2) is not None, "scene for who is allowed")
        (Path(network["keys"]) / "allowed" / "stranger.key").unlink()
        expect(
            "does not let this machine in. Run there: splatnode keygen" in _refusal(theirs), "no word to the revoked"
        )
        node.end("recon")
        node.start("recon")
        wait_for(lambda: _is_refused(connected), "refusal of who was connected")
        connected.close()
        expect("refused a connection" in node.log("recon"), "the log does not tell who was refused")
        expect_whole(node)


def rotated_keys(trial: Trial) -> None:
    """The robot gets new keys: who expects the old ones is told so, and with the new ones it goes on."""
    network, other = _over_tcp(trial)
    own = Path(network["keys"])
    allow(own, "other", (other / "public.key").read_bytes())
    theirs = parse_config(network | {"keys": str(other)}, Network)
    with running(trial.node(network=network)) as node:
        node.start("capture")
        node.start("recon")
        wait_for(lambda: "event=ready" in node.log("recon"), "recon that runs")
        for name in ("secret.key", "public.key", "server.key"):
            (own / name).unlink()
        new = create_keys(own)
        for verb in ("recon", "capture"):
            node.end(verb)
            node.start(verb)
        expect("does not have the key that server.key" in _refusal(theirs), "no word of the new key")
        expect_server(other, new)
        client = StateClient(RECON_SCENE, theirs, SceneHeader)
        wait_for(lambda: client.poll(0.2) is not None, "scene with the new key")
        client.close()
        (other / "secret.key").unlink()  # and the client gets new keys
        own_of_client = create_keys(other)
        expect("does not let this machine in" in _refusal(theirs), "no word of the client's new key")
        allow(own, "other", own_of_client)
        client = StateClient(RECON_SCENE, theirs, SceneHeader)
        wait_for(lambda: client.poll(0.2) is not None, "scene with the client's new key")
        client.close()
        expect_whole(node)


def _refusal(network: Network) -> str:
    return refusal(StateClient(RECON_SCENE, network, SceneHeader))


def refusal(client: StateClient) -> str:
    """What a client of the scene is told that is not let in; it is closed then."""
    deadline = time.monotonic() + 30
    try:
        while time.monotonic() < deadline:
            expect(client.poll(0.5) is None, "who is not allowed heard the scene")
    except NotAllowed as error:
        return str(error)
    finally:
        client.close()
    return "nothing within 30 s"


def _is_refused(client: StateClient) -> bool:
    try:
        client.poll(0.2)
    except NotAllowed:
        return True
    return False


def _over_tcp(trial: Trial) -> tuple[dict[str, Any], Path]:
    """A network over loopback with keys, and the keys of a machine that is not allowed."""
    own, stranger = trial.folder / "keys", trial.folder / "stranger"
    public = create_keys(own)
    create_keys(stranger)
    expect_server(own, public)
    expect_server(stranger, public)
    return {"tcp": "127.0.0.1", "keys": str(own), "first_port": trial.chance.randrange(20000, 30000)}, stranger
