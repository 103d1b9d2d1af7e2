"""Who is let in: private folders, keys, the allow list, and what strangers and crowds can do."""

from __future__ import annotations

import contextlib
import os
import socket
import subprocess
import sys

import msgspec
import pytest
import zmq

from splatnode.capture.messaging import network as keys
from splatnode.capture.messaging.messages import DroppedHeader, Numbering
from splatnode.capture.messaging.network import (
    CAPTURE_PREVIEW,
    RECON_SCENE,
    Network,
    NetworkError,
    NotAllowed,
    runtime_directory,
)
from splatnode.capture.messaging.pubsub import Publisher, StateClient, StateServer, Subscriber
from splatnode.command_line import main
from tests.capture.messaging.test_sockets import Note, heard, ipc, tcp, wait_for
from tests.conftest import ROOT
from tests.support.strays import STRAYS

SERVES = """
import pathlib, resource, sys
from splatnode.capture.messaging.messages import DroppedHeader
from splatnode.capture.messaging.network import Network
from splatnode.capture.messaging.network import RECON_SCENE
from splatnode.capture.messaging.pubsub import StateServer
from splatnode.capture.messaging.messages import Numbering
resource.setrlimit(resource.RLIMIT_NOFILE, (60, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
with StateServer(RECON_SCENE, Network(directory=pathlib.Path(sys.argv[1]))) as server:
    server.publish(DroppedHeader(**Numbering().next(), name="a.png", reason="blurred"))
    while True:
        server.serve(0.05)
"""


def test_a_crowd_on_a_socket_takes_nothing_from_the_others(tmp_path):
    network = ipc(tmp_path)
    directory = runtime_directory(network)
    process = subprocess.Popen([sys.executable, "-c", SERVES, directory], cwd=ROOT)
    try:
        requests = directory / RECON_SCENE.requests.name
        wait_for(requests.exists)
        with contextlib.ExitStack() as crowd, StateClient(RECON_SCENE, network, DroppedHeader) as client:
            for _ in range(100):
                crowd.enter_context(socket.socket(socket.AF_UNIX)).connect(str(requests))
            wait_for(lambda: client.poll(0.1))
    finally:
        process.kill()
        process.wait()


def test_the_directory_must_be_private(tmp_path):
    directory = runtime_directory(ipc(tmp_path))
    assert directory.stat().st_mode & 0o777 == 0o700
    directory.chmod(0o755)
    with pytest.raises(NetworkError, match="chmod 700"):
        Publisher(CAPTURE_PREVIEW, ipc(tmp_path))
    with pytest.raises(NetworkError, match="shorten"):
        Publisher(CAPTURE_PREVIEW, Network(directory=tmp_path / ("x" * 100)))


def test_where_the_directory_is(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "user"))
    monkeypatch.delenv("RUNTIME_DIRECTORY", raising=False)
    assert runtime_directory(Network()) == tmp_path / "user" / "splatnode"
    monkeypatch.setenv("RUNTIME_DIRECTORY", f"{tmp_path / 'service'}:{tmp_path / 'other'}")
    assert runtime_directory(Network()) == tmp_path / "service"


def test_tcp_needs_keys(tmp_path):
    with pytest.raises(NetworkError, match="splatnode keygen"):
        Publisher(CAPTURE_PREVIEW, Network(directory=tmp_path / "run", tcp="127.0.0.1"))
    with pytest.raises(keys.KeyFileError, match="no key"):
        Subscriber(CAPTURE_PREVIEW, Network(directory=tmp_path, tcp="127.0.0.1", keys=tmp_path), Note)


def other_machine(network, folder, knows_server=True):
    """The network as another machine sees it, and that machine's public key."""
    public = keys.create_keys(folder / "keys")
    server = keys.read_keys(network.keys).public if knows_server else keys.create_keys(folder / "wrong")
    keys.expect_server(folder / "keys", server)
    return msgspec.structs.replace(network, directory=folder / "run", keys=folder / "keys"), public


def test_the_allow_list_decides_at_each_handshake(tmp_path):
    network, numbering = tcp(tmp_path), Numbering()
    theirs, public = other_machine(network, tmp_path / "laptop")
    with Publisher(CAPTURE_PREVIEW, network) as publisher:
        with Subscriber(CAPTURE_PREVIEW, theirs, Note) as subscriber, pytest.raises(NotAllowed, match="--allow"):
            heard(publisher, subscriber, numbering)
        keys.allow(network.keys, "laptop", public)
        with Subscriber(CAPTURE_PREVIEW, theirs, Note) as subscriber:
            heard(publisher, subscriber, numbering)


def test_a_wrong_server_is_not_spoken_to(tmp_path):
    network, numbering = tcp(tmp_path), Numbering()
    theirs, public = other_machine(network, tmp_path / "laptop", knows_server=False)
    keys.allow(network.keys, "laptop", public)
    with (
        Publisher(CAPTURE_PREVIEW, network) as publisher,
        Subscriber(CAPTURE_PREVIEW, theirs, Note) as subscriber,
        pytest.raises(NotAllowed, match="server.key"),
    ):
        heard(publisher, subscriber, numbering)


@pytest.mark.parametrize("junk", [b"\x01\x00\x06\x00hello", b"GET / HTTP/1.0\r\n\r\n", bytes(range(256)) * 40])
def test_strangers_on_the_port_are_not_heard(tmp_path, junk):
    network = tcp(tmp_path)
    with StateServer(RECON_SCENE, network) as server:
        with socket.create_connection(("127.0.0.1", network.first_port + RECON_SCENE.requests.tcp_port)) as stranger:
            stranger.sendall(junk)
            server.serve(0.2)
        assert server.refused == 0


def test_keys_are_private_and_not_overwritten(tmp_path):
    public = keys.create_keys(tmp_path)
    assert keys.read_keys(tmp_path) == keys.Keys(public, (tmp_path / "secret.key").read_bytes().strip(), public)
    with pytest.raises(keys.KeyFileError, match="there already"):
        keys.create_keys(tmp_path)
    with pytest.raises(keys.KeyFileError, match="40 characters"):
        keys.allow(tmp_path, "laptop", b"short")
    with pytest.raises(ValueError, match="name"):
        keys.allow(tmp_path, "../laptop", public)
    (tmp_path / "secret.key").chmod(0o644)
    with pytest.raises(keys.KeyFileError, match="chmod 600"):
        keys.read_keys(tmp_path)


def test_a_public_key_is_never_taken_for_an_option(tmp_path, monkeypatch):
    pairs = iter([(b"-" + b"a" * 39, b"s" * 40), (b"a" * 40, b"t" * 40)])
    monkeypatch.setattr(keys.zmq, "curve_keypair", lambda: next(pairs))
    assert keys.create_keys(tmp_path) == b"a" * 40
    assert (tmp_path / keys.SECRET).read_bytes().strip() == b"t" * 40


@pytest.mark.parametrize("option", [["--allow", "laptop"], ["--server"]], ids=" ".join)
def test_an_older_key_that_begins_with_a_dash_is_given_after_a_space(tmp_path, option):
    keys.create_keys(tmp_path)
    assert main(["keygen", str(tmp_path), *option, " -" + "a" * 39]) == 0


@pytest.mark.parametrize("left", [b"", b"\n", b"abc"])
def test_a_secret_key_that_was_cut_short_is_replaced_and_said(tmp_path, caplog, left):
    keys.create_keys(tmp_path)
    (tmp_path / keys.SECRET).write_bytes(left)
    with pytest.raises(keys.KeyFileError, match="splatnode keygen"):
        keys.read_keys(tmp_path)
    public = keys.create_keys(tmp_path)
    assert "was cut short" in caplog.text and keys.read_keys(tmp_path).public == public
    with pytest.raises(keys.KeyFileError, match="there already"):
        keys.create_keys(tmp_path)


@pytest.mark.parametrize("make", STRAYS.values(), ids=STRAYS)
def test_what_is_no_key_file_is_not_waited_for(tmp_path, make):
    public = keys.create_keys(tmp_path)
    make(tmp_path / keys.ALLOWED / "laptop.key")
    allowed = keys.AllowList(tmp_path / keys.ALLOWED, public)
    assert allowed.callback("", public) and not allowed.callback("", b"x" * 40)
    (tmp_path / keys.SECRET).unlink()
    make(tmp_path / keys.SECRET)
    for act in (keys.read_keys, keys.create_keys):
        with pytest.raises(keys.KeyFileError):
            act(tmp_path)


def loosened(folder, what):
    """Puts a key that is allowed into `folder`, and lets others change `what` of it."""
    public = keys.create_keys(folder)
    other = zmq.curve_keypair()[0]
    keys.allow(folder, "laptop", other)
    path = folder / what
    path.chmod(path.stat().st_mode | 0o022)
    return public, other


@pytest.mark.parametrize("what", [".", "allowed", "allowed/laptop.key"])
def test_a_key_that_others_may_have_put_there_is_not_accepted_and_that_is_said_once(tmp_path, caplog, what):
    public, other = loosened(tmp_path / "keys", what)
    allowed = keys.AllowList(tmp_path / "keys" / keys.ALLOWED, public)
    for _ in range(3):
        assert allowed.callback("", public) and not allowed.callback("", other)
    assert caplog.text.count("chmod go-w") == 1
    (tmp_path / "keys" / what).chmod((tmp_path / "keys" / what).stat().st_mode & ~0o022)
    assert allowed.callback("", other)  # the modes are looked at at each handshake


@pytest.mark.parametrize("what", [".", "secret.key", "server.key"])
def test_keys_that_others_may_change_are_not_used(tmp_path, what):
    folder = tmp_path / "keys"
    keys.expect_server(folder, keys.create_keys(folder))
    (folder / what).chmod((folder / what).stat().st_mode | 0o022)
    with pytest.raises(keys.KeyFileError, match="chmod"):
        keys.read_keys(folder)


def test_a_stranger_who_tries_again_and_again_does_not_fill_the_journal(tmp_path, caplog):
    allowed = keys.AllowList(tmp_path / keys.ALLOWED, keys.create_keys(tmp_path))
    for number in range(500):
        for _ in range(3):
            assert not allowed.callback("", b"%040d" % number)
    assert len(caplog.records) == 100 and "nothing further" in caplog.records[-1].getMessage()


def test_a_secret_of_the_right_letters_that_is_no_number_is_refused(tmp_path):
    keys.create_keys(tmp_path)
    (tmp_path / keys.SECRET).write_bytes(b"#" * 40)
    with pytest.raises(keys.KeyFileError, match="secret.key"):
        keys.read_keys(tmp_path)


def test_the_public_key_is_that_of_the_secret_one(tmp_path):
    public = keys.create_keys(tmp_path)
    (tmp_path / keys.PUBLIC).unlink()
    assert keys.read_keys(tmp_path).public == public


@pytest.mark.parametrize("umask", [0, 0o077], ids=oct)
def test_keys_are_private_whatever_the_umask(tmp_path, umask):
    before = os.umask(umask)
    try:
        keys.allow(tmp_path / "a", "laptop", keys.create_keys(tmp_path / "a"))
    finally:
        os.umask(before)
    everything = [tmp_path / "a", *(tmp_path / "a").rglob("*")]
    assert len(everything) == 5 and not any(path.lstat().st_mode & 0o077 for path in everything)


def test_keys_that_the_disk_did_not_take_are_not_in_the_way_of_the_next(tmp_path):
    (tmp_path / keys.PUBLIC).mkdir()
    with pytest.raises(IsADirectoryError):
        keys.create_keys(tmp_path)
    (tmp_path / keys.PUBLIC).rmdir()
    assert keys.create_keys(tmp_path) == keys.read_keys(tmp_path).public
