"""Weights are found, fetched and checked; what is wrong never gets a file's name."""

from __future__ import annotations

import hashlib
import http.server
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from splatnode.recon.networks.weight_catalogue import CATALOGUE, Weights
from splatnode.recon.networks.weight_download import complaint, fetch
from splatnode.recon.networks.weight_folder import WeightsError, find, folder

CONTENT = bytes(range(256)) * 4000
GOOD = Weights("net/tiny.pth", "a test", "CC0", "", hashlib.sha256(CONTENT).hexdigest(), len(CONTENT))


class _Server(http.server.BaseHTTPRequestHandler):
    """Serves CONTENT, with ranges; /cut ends the connection half way."""

    ranges: list[str] = []  # noqa: RUF012  the class is the server's only place for state

    def do_GET(self) -> None:
        start = 0
        if wanted := self.headers.get("Range"):
            self.ranges.append(wanted)
            start = int(wanted.removeprefix("bytes=").removesuffix("-"))
        self.send_response(206 if start else 200)
        self.send_header("Content-Length", str(len(CONTENT) - start))
        self.end_headers()
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
    assert complaint(GOOD, file) == f"it has {len(CONTENT) - 1} bytes instead of {len(CONTENT)}"
    file.write_bytes(CONTENT[::-1])
    assert "sha256" in complaint(GOOD, file)
    file.write_bytes(CONTENT)
    assert complaint(GOOD, file) == ""


def test_missing_weights_name_the_remedy(tmp_path, monkeypatch):
    monkeypatch.setenv("SPLATNODE_WEIGHTS", str(tmp_path))
    with pytest.raises(WeightsError, match="splatnode weights fetch aliked-t16"):
        find("aliked/aliked-t16.pth")


def test_the_catalogue_describes_the_files_that_are_here(shared):
    for entry in CATALOGUE:
        file = Path(shared / "weights" / entry.path)
        if file.is_file():
            assert complaint(entry, file) == "", entry.name
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
