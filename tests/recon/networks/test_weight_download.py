"""Weights are found, fetched and checked; what is wrong never gets a file's name."""

from __future__ import annotations

import contextlib
import hashlib
import http.server
import os
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from splatnode.recon import networks
from splatnode.recon.networks import CATALOGUE, Weights, WeightsError, fetch, find, find_mismatch, folder

CONTENT = bytes(range(256)) * 4000
GOOD = Weights("net/tiny.pth", "a test", "CC0", "", hashlib.sha256(CONTENT).hexdigest(), len(CONTENT))


class _Server(http.server.BaseHTTPRequestHandler):
    """Serves CONTENT, with ranges; /cut ends the connection half way, /more and /endless send more than that."""

    ranges: list[str] = []  # noqa: RUF012  the class is the server's only place for state
    sent: list[int] = []  # noqa: RUF012

    def do_GET(self) -> None:
        start = 0
        if wanted := self.headers.get("Range"):
            self.ranges.append(wanted)
            start = int(wanted.removeprefix("bytes=").removesuffix("-"))
        self.send_response(206 if start else 200)
        more = 100 * len(CONTENT) if self.path in ("/more", "/endless") else 0
        if self.path != "/endless":
            self.send_header("Content-Length", str(len(CONTENT) - start + more))
        self.end_headers()
        if more:
            with contextlib.suppress(ConnectionError):  # the reader has had enough
                for _ in range(101):
                    self.wfile.write(CONTENT)
                    self.sent.append(len(CONTENT))
            return
        end = len(CONTENT) // 2 if self.path == "/cut" else len(CONTENT)
        self.wfile.write(CONTENT[start:end])

    def log_message(self, format: str, *args: object) -> None:
        pass


@pytest.fixture
def server() -> Iterator[str]:
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), _Server) as running:
        thread = threading.Thread(target=running.serve_forever, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{running.server_port}"
        running.shutdown()
        thread.join()


def test_a_download_goes_on_where_it_stopped(server, tmp_path):
    with pytest.raises(WeightsError, match="ended early"):
        fetch(replace(GOOD, url=f"{server}/cut"), tmp_path)
    assert not (tmp_path / GOOD.path).exists()
    _Server.ranges.clear()
    path = fetch(replace(GOOD, url=f"{server}/whole"), tmp_path)
    assert _Server.ranges == [f"bytes={len(CONTENT) // 2}-"]
    assert path.read_bytes() == CONTENT and not path.with_name("tiny.pth.part").exists()
    _Server.ranges.clear()
    assert fetch(replace(GOOD, url=f"{server}/whole"), tmp_path) == path  # it is there: nothing is asked for


@pytest.mark.parametrize("begun", [0, 1000, len(CONTENT) - 1])
@pytest.mark.parametrize("path", ["more", "endless"])
def test_a_download_takes_no_more_than_the_size_that_is_known(server, tmp_path, begun, path):
    part = tmp_path / "net" / "tiny.pth.part"
    part.parent.mkdir()
    part.write_bytes(CONTENT[:begun])
    _Server.sent.clear()
    with pytest.raises(WeightsError, match=f"more than the {len(CONTENT)} bytes of tiny; nothing was kept"):
        fetch(replace(GOOD, url=f"{server}/{path}"), tmp_path)
    assert list(part.parent.iterdir()) == [] and len(_Server.sent) < 20


@pytest.mark.parametrize("begun", [CONTENT + b"x", CONTENT[::-1] * 3])
def test_a_beginning_that_is_longer_than_the_file_is_thrown_away(server, tmp_path, begun):
    (tmp_path / "net").mkdir()
    (tmp_path / "net" / "tiny.pth.part").write_bytes(begun)
    assert fetch(replace(GOOD, url=f"{server}/whole"), tmp_path).read_bytes() == CONTENT


def test_what_lies_where_the_download_begins_is_not_followed(server, tmp_path):
    (tmp_path / "net").mkdir()
    (tmp_path / "mine").write_bytes(b"mine")
    (tmp_path / "net" / "tiny.pth.part").symlink_to(tmp_path / "mine")
    assert fetch(replace(GOOD, url=f"{server}/whole"), tmp_path).read_bytes() == CONTENT
    assert (tmp_path / "mine").read_bytes() == b"mine"


@pytest.mark.parametrize("unknown", [{"sha256": None}, {"num_bytes": None}])
def test_what_has_no_digest_is_not_downloaded(server, tmp_path, unknown):
    _Server.ranges.clear()
    with pytest.raises(WeightsError, match="no digest.*--from FOLDER"):
        fetch(replace(GOOD, url=f"{server}/whole", **unknown), tmp_path)
    (tmp_path / "stick").mkdir()
    (tmp_path / "stick" / "tiny.pth").write_bytes(CONTENT)
    assert fetch(replace(GOOD, **unknown), tmp_path, tmp_path / "stick").read_bytes() == CONTENT


def test_every_download_of_the_catalogue_is_bounded_and_has_a_digest_or_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr("urllib.request.urlopen", lambda *_, **__: pytest.fail("nothing may be asked for"))
    for entry in CATALOGUE:
        if entry.url and (entry.sha256 is None or entry.num_bytes is None):
            with pytest.raises(WeightsError, match="no digest"):
                fetch(entry, tmp_path)


def test_weights_are_not_put_where_others_could_change_them(server, tmp_path):
    (tmp_path / "net").mkdir()
    (tmp_path / "net").chmod(0o777)
    with pytest.raises(WeightsError, match=r"chmod go-w.*\$SPLATNODE_WEIGHTS"):
        fetch(replace(GOOD, url=f"{server}/whole"), tmp_path)


@pytest.mark.parametrize("what", [".", "weights", "weights/net", "weights/net/tiny.pth"])
@pytest.mark.parametrize("change", [lambda path: path.chmod(0o777), lambda path: os.chown(path, 64321, 64321)])
def test_a_checkout_beside_a_folder_that_others_can_change_does_not_look_there(tmp_path, monkeypatch, what, change):
    module = tmp_path / "checkout" / "recon" / "networks" / "weight_folder.py"
    module.parent.mkdir(parents=True)
    module.write_text("")
    file = tmp_path / "shared" / "weights" / "net" / "tiny.pth"
    file.parent.mkdir(parents=True)
    file.write_bytes(CONTENT)
    monkeypatch.setattr(networks, "__file__", str(module))
    monkeypatch.delenv("SPLATNODE_WEIGHTS", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    assert networks.locate_weights("net/tiny.pth") == file
    try:
        change(tmp_path / "shared" / what)
    except PermissionError:
        pytest.skip("needs root, which can be two users")
    assert networks.locate_weights("net/tiny.pth") is None
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path / "shared" / "weights"))
    assert networks.locate_weights("net/tiny.pth") == file  # whoever names it means it


def test_a_file_with_another_digest_is_not_kept(server, tmp_path):
    with pytest.raises(WeightsError, match="sha256"):
        fetch(replace(GOOD, url=server, sha256="0" * 64), tmp_path)
    assert list((tmp_path / "net").iterdir()) == []


def test_without_network_the_message_says_what_to_do(tmp_path):
    with pytest.raises(WeightsError, match="could not be reached.*fetch tiny --from FOLDER"):
        fetch(replace(GOOD, url="http://127.0.0.1:9"), tmp_path)


def test_a_folder_serves_offline(tmp_path):
    (tmp_path / "stick").mkdir()
    (tmp_path / "stick" / "tiny.pth").write_bytes(CONTENT)
    assert fetch(GOOD, tmp_path / "to", tmp_path / "stick").read_bytes() == CONTENT
    with pytest.raises(WeightsError, match=r"holds no tiny\.pth"):
        fetch(GOOD, tmp_path / "other", tmp_path)
    with pytest.raises(WeightsError, match="cannot be downloaded as it is"):
        fetch(GOOD, tmp_path / "other")


def test_the_complaint_names_the_difference(tmp_path):
    file = tmp_path / "tiny.pth"
    file.write_bytes(CONTENT[:-1])
    assert find_mismatch(GOOD, file) == f"it has {len(CONTENT) - 1} bytes instead of {len(CONTENT)}"
    file.write_bytes(CONTENT[::-1])
    assert "sha256" in find_mismatch(GOOD, file)
    file.write_bytes(CONTENT)
    assert find_mismatch(GOOD, file) == ""


def test_missing_weights_name_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    with pytest.raises(WeightsError, match="splatnode weights fetch aliked-t16"):
        find("aliked/aliked-t16.pth")


def test_the_catalogue_describes_the_files_that_are_here(shared):
    for entry in CATALOGUE:
        file = Path(shared / "weights" / entry.path)
        if file.is_file():
            assert find_mismatch(entry, file) == "", entry.name
    assert len({entry.name for entry in CATALOGUE}) == len(CATALOGUE)
    assert all(entry.licence and entry.what and (entry.url or entry.sha256) for entry in CATALOGUE)


def test_the_verb(tmp_path, monkeypatch, capsys):
    from splatnode import command_line

    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    assert command_line.main(["weights", "list"]) == 0
    assert "non-commercial" in capsys.readouterr().out
    assert command_line.main(["weights", "verify", "aliked-t16"]) == 75
    assert command_line.main(["weights", "fetch", "nonsense"]) == 2
    assert command_line.main(["weights", "fetch"]) == 2
    assert folder() == tmp_path
