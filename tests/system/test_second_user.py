"""What a second user of the machine can read, replace, or keep from starting: nothing, or it is said what to do."""

from __future__ import annotations

import contextlib
import os
import subprocess
import sys
import tempfile

import numpy as np
import pytest

from splatnode.capture.frame import Frame
from splatnode.capture.messaging import network as keys
from splatnode.capture.messaging.keyframe_queue import KeyframeServer, Spool, SpoolConfig
from splatnode.capture.messaging.messages import ReceivedFrame
from splatnode.capture.messaging.network import RECON_SCENE, Network, NetworkError, runtime_directory
from splatnode.capture.messaging.pubsub import StateServer
from splatnode.capture.process.files import NotOwnerOnly
from splatnode.recon.daemon.checkpoint import Store
from tests.conftest import ROOT
from tests.support.second_user import OTHER, as_other, shared_tmp  # noqa: F401  a fixture

LOOKS = """
def tries(what, act):
    try:
        act()
    except OSError:
        return
    print(what)
def looks(path):
    tries(f"lists {path}", lambda: os.listdir(path))
    tries(f"changes {path}", lambda: os.chmod(path, 0o777))
    tries(f"reads {path}", lambda: os.close(os.open(path, os.O_RDONLY)))
    tries(f"writes {path}", lambda: os.close(os.open(path, os.O_WRONLY)))
    tries(f"puts into {path}", lambda: os.close(os.open(os.path.join(path, "x"), os.O_CREAT | os.O_WRONLY)))
    tries(f"connects to {path}", lambda: socket.socket(socket.AF_UNIX).connect(path))
    tries(f"removes {path}", lambda: os.rename(path, path + ".gone"))
for path in sys.argv[1:]:
    looks(path)
"""

PREPARES = {
    "a folder": "os.mkdir(path)",
    "a folder for all": "os.mkdir(path); os.chmod(path, 0o777)",
    "a link to a folder of theirs": "os.mkdir(path + '.theirs'); os.symlink(path + '.theirs', path)",
    "a link to a folder of ours": "os.symlink(path + '.ours', path)",
    "a link to nothing": "os.symlink(path + '.theirs', path)",
    "a file": "open(path, 'w').close()",
    "a pipe": "os.mkfifo(path)",
}


def prepared(path, how: str):
    path.with_name(f"{path.name}.ours").mkdir(mode=0o700)
    done = as_other(f"path = sys.argv[1]; {PREPARES[how]}", path)
    assert done.returncode == 0, done.stderr


@pytest.fixture
def fallback(shared_tmp, monkeypatch):  # noqa: F811
    """The folder of sockets where nothing else is named."""
    for name in ("RUNTIME_DIRECTORY", "XDG_RUNTIME_DIR"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("TMPDIR", str(shared_tmp))
    monkeypatch.setattr(tempfile, "tempdir", None)
    return shared_tmp / f"splatnode-{os.getuid()}"


@pytest.mark.parametrize("how", PREPARES)
def test_a_fallback_folder_that_was_there_before_is_not_used_and_the_remedy_works(fallback, monkeypatch, how):
    prepared(fallback, how)
    with pytest.raises(NetworkError, match=rf"user {OTHER}.*\$XDG_RUNTIME_DIR"):
        runtime_directory(Network())
    assert not any(fallback.with_name(f"{fallback.name}.ours").iterdir())
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(fallback.with_name(f"{fallback.name}.ours")))
    assert runtime_directory(Network()).parent.name == f"{fallback.name}.ours"


def test_the_verb_says_what_to_set(fallback):
    prepared(fallback, "a folder")
    command = [sys.executable, "-m", "splatnode", "status"]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 77 and "network.directory (or $XDG_RUNTIME_DIR)" in done.stderr


@pytest.mark.parametrize("how", PREPARES)
@pytest.mark.parametrize("what", ["spool", "checkpoint", "frames"])
def test_state_is_not_kept_in_what_another_user_prepared(shared_tmp, what, how):  # noqa: F811
    path = {
        "spool": shared_tmp / "spool",
        "checkpoint": shared_tmp / "checkpoint",
        "frames": shared_tmp / "spool",
    }[what]
    prepared(path, how)
    begin = {
        "spool": lambda: Spool(SpoolConfig(shared_tmp)),
        "checkpoint": lambda: Store(shared_tmp / "checkpoint"),
        "frames": lambda: Store(shared_tmp / "spool"),
    }[what]
    with pytest.raises(NotOwnerOnly, match=r"--checkpoint|spool\.directory"):
        begin()
    assert not any(path.with_name(f"{path.name}.ours").iterdir())


def test_nothing_of_the_first_user_can_be_read_or_changed_by_the_second(shared_tmp):  # noqa: F811
    image = np.zeros((6, 8, 3), np.uint8)
    before = os.umask(0)
    try:
        with contextlib.ExitStack() as resources:
            network = Network(directory=shared_tmp / "run")
            spool = Spool(SpoolConfig(shared_tmp / "state"))
            server = resources.enter_context(KeyframeServer(network, spool))
            resources.enter_context(StateServer(RECON_SCENE, network))
            server.offer(Frame(0, "a.png", 0, image, None))
            store = Store(shared_tmp / "recon")
            resources.callback(store.close)
            store.add_frame(ReceivedFrame("0" * 32, 0, Frame(0, "a.png", 0, image, None)))
            store.begin_submap(1)
            keys.allow(shared_tmp / "keys", "laptop", keys.create_keys(shared_tmp / "keys"))
            everything = sorted(shared_tmp.rglob("*"))
            names = {path.name for path in everything}
            assert {"lock", "secret.key", "laptop.key", "ledger", "frames", "spool", RECON_SCENE.name} <= names
            looked = as_other(LOOKS, *everything)
    finally:
        os.umask(before)
    assert (looked.returncode, looked.stdout, looked.stderr) == (0, "", "")


def test_a_file_of_another_user_is_not_taken_for_ours(tmp_path, shared_tmp, caplog):  # noqa: F811
    spool, store = Spool(SpoolConfig(tmp_path)), Store(tmp_path / "recon")
    image = np.zeros((6, 8, 3), np.uint8)
    store.add_frame(ReceivedFrame("0" * 32, 0, Frame(0, "a.png", 0, image, None)))
    spool.close()
    store.close()
    (frame,) = (tmp_path / "recon" / "frames").glob("*.frame")
    theirs = tmp_path / "spool" / f"000000000000-{'0' * 32}-0.frame"
    theirs.write_bytes(frame.read_bytes())
    for path in (frame, theirs):
        os.chown(path, OTHER, OTHER)
    assert len(Spool(SpoolConfig(tmp_path))) == 0 and theirs.exists()
    assert not list(Store(tmp_path / "recon").frames()) and frame.exists()
    assert caplog.text.count("event=left_alone") == 2
