"""`splatnode view` from end to end, without a display: results, refusals, pictures, a running node."""

from __future__ import annotations

import contextlib
import json
import re
import resource
import subprocess
import sys
import threading
import time
import urllib.error
import urllib.request
from dataclasses import replace
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest

from splatnode import command_line
from splatnode.capture.messaging.messages import Numbering
from splatnode.capture.messaging.network import RECON_DEPTH, RECON_SCENE, RECON_STATUS, Network
from splatnode.capture.messaging.pubsub import Publisher, StateServer
from splatnode.recon.result.export import SceneFileError, write_result
from splatnode.recon.result.message import encode_snapshot, make_depth_header
from splatnode.recon.result.report import build_report
from splatnode.recon.result.snapshot import GaussianArrays, Snapshot, find_camera_problem
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.viewer import cli
from splatnode.viewer.probe import Probe, probe_window
from splatnode.viewer.sources import LiveSource, load_result
from tests.conftest import ROOT
from tests.support.node import heartbeat
from tests.viewer.test_scene import camera, moment, wall

PICTURE = np.full((80, 100, 3), 90, np.uint8)
REFUSAL = Verdict(Code.NO_PARALLAX, "The camera only turned.", "Take a step to the side.")


def snapshot(verdict: Verdict | None = None) -> Snapshot:
    cameras = camera(-0.2), camera(0.2, frame_id=1)
    images = {one.name: PICTURE for one in cameras}
    if verdict is not None:
        return moment(GaussianArrays.empty(), verdict=verdict).snapshot
    return moment(wall(15), *cameras, images=images, seconds={"poses": 1.0, "total": 2.0}, final=True).snapshot


@pytest.fixture
def result(tmp_path) -> Path:
    folder = tmp_path / "out"
    write_result(snapshot(), folder, build_report(snapshot(), seed=0, preset="fast", peak_rss_mb=None))
    (folder / "images").mkdir()
    cv2.imwrite(str(folder / "images" / "0.png"), PICTURE)
    (folder / "images" / "1.png").write_bytes(b"no image")
    return folder


def test_a_result_is_shown_with_what_is_known_of_it(result, caplog):
    there = load_result(result).snapshot
    assert len(there.gaussians) == 225 and there.verdict == snapshot().verdict and there.final
    assert [one.name for one in there.cameras] == ["0.png", "1.png"] and there.seconds["total"] == 2.0
    assert list(there.images) == ["0.png"] and "1.png is shown without its photograph" in caplog.text
    alone = load_result(result / "scene.ply", photographs=result / "nowhere").snapshot
    assert len(alone.gaussians) == 225 and not alone.images and "without a report" in alone.verdict.message


@pytest.mark.parametrize(
    ("options", "why"),
    [
        (["--port", "80"], "--port needs --web"),
        (["--listen", "0.0.0.0"], "--listen needs --web"),
        (["--key", "web.key"], "--key needs --web"),
        (["--web", "--headless"], "one of them at a time"),
        (["--web", "--export", "a.mp4"], "one of them at a time"),
    ],
)
def test_options_of_the_browser_go_with_it_alone(result, capsys, options, why):
    assert command_line.main(["view", str(result), *options]) == 2
    assert why in capsys.readouterr().err


@pytest.mark.parametrize("options", [["--port", "70000"], ["--listen", "robot.local"]])
def test_a_port_is_a_port_and_an_address_is_numeric(result, capsys, options):
    with pytest.raises(SystemExit):
        command_line.main(["view", str(result), "--web", *options])
    assert f"argument {options[0]}: must be" in capsys.readouterr().err


def test_a_browser_is_invited_and_a_signal_ends_it_well(result, tmp_path):
    """As a process, over a network's address: with the key that it keeps, and not without."""
    key = tmp_path / "web.key"
    command = [sys.executable, "-m", "splatnode", "view", str(result), "--web", "--listen", "0.0.0.0"]
    command += ["--port", "0", "--key", str(key)]
    viewer = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=ROOT)
    try:
        said = viewer.stdout.readline()
        port = re.search(r"http://[^ ]*:([0-9]+)/\?key=KEY ", said)[1]
        asked = urllib.request.Request(f"http://127.0.0.1:{port}/gaussians/1")
        with pytest.raises(urllib.error.HTTPError, match="401"):
            urllib.request.urlopen(asked, timeout=20)
        asked.add_header("Authorization", f"Bearer {key.read_text().strip()}")
        for _ in range(100):
            with contextlib.suppress(urllib.error.HTTPError):  # 404: it is not yet there
                assert len(urllib.request.urlopen(asked, timeout=20).read()) == 225 * 32
                break
            time.sleep(0.1)
        else:
            raise AssertionError("the scene never came")
    finally:
        viewer.terminate()
        _, errors = viewer.communicate(timeout=30)
    assert viewer.returncode == 0 and errors.count("\n") == 1 and "without its photograph" in errors


def test_photographs_are_found_where_the_report_says_that_they_were(result, tmp_path):
    (result / "images").rename(tmp_path / "holiday")
    assert not load_result(result).snapshot.images
    report = json.loads((result / "report.json").read_text())
    (result / "report.json").write_text(json.dumps(report | {"photographs": str(tmp_path / "holiday")}))
    assert list(load_result(result).snapshot.images) == ["0.png"]


def test_a_folder_that_cannot_be_costs_the_photographs_and_not_the_scene(result):
    (result / "images").rename(result / "elsewhere")
    report = json.loads((result / "report.json").read_text())
    (result / "report.json").write_text(json.dumps(report | {"photographs": "y" * 300}))
    there = load_result(result).snapshot
    assert len(there.cameras) == 2 and not there.images


def test_a_refused_result_says_why(tmp_path):
    refused = replace(snapshot(REFUSAL), final=True)
    write_result(refused, tmp_path, build_report(refused, seed=0, preset="fast", peak_rss_mb=None))
    there = load_result(tmp_path).snapshot
    assert there.verdict == REFUSAL and not len(there.gaussians) and not there.cameras


def test_what_is_no_result_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"scene\.ply is not there"):
        load_result(tmp_path)
    told = '{"verdict": {"code": "OK", "message": "Good.", "advice": ""}, "seconds": []}'
    for text in ('{"verdict": {"code": "SUNNY"}}', told, "[]", "{}", "{"):
        (tmp_path / "report.json").write_text(text)
        with pytest.raises(ValueError, match="not a report of splatnode"):
            load_result(tmp_path)
    (tmp_path / "x.ply").write_bytes(b"ply\n")
    with pytest.raises(SceneFileError):
        load_result(tmp_path / "x.ply")


def test_pictures_without_a_display(result, tmp_path, capsys):
    out = tmp_path / "pictures"
    arguments = ["view", str(result), "--headless", "--size", "160x120", "--num-frames", "2", "--out", str(out)]
    assert command_line.main(arguments) == 0
    assert sorted(path.name for path in out.iterdir()) == [
        "camera_000.png", "camera_001.png", "exports.json", "overview.png", "turntable_000.png", "turntable_001.png",
    ]  # fmt: skip
    pair, alone = (cv2.imread(str(out / f"camera_00{number}.png")) for number in (0, 1))
    assert pair is not None and alone is not None
    assert pair.shape == (120, 320, 3) and alone.shape == (120, 160, 3)  # the second photograph is damaged
    assert (pair[60, 80] == 90).all()
    assert capsys.readouterr().out.strip() == str(out)


def test_a_movie_without_a_display(result, tmp_path):
    path = tmp_path / "turntable.mp4"
    assert (
        command_line.main(["view", str(result), "--export", str(path), "--size", "161x121", "--num-frames", "5"]) == 0
    )
    movie = cv2.VideoCapture(str(path))
    frames = [movie.read()[1] for _ in range(int(movie.get(cv2.CAP_PROP_FRAME_COUNT)))]
    assert len(frames) == 5 and frames[0].shape == (120, 160, 3)
    assert not np.array_equal(frames[0], frames[2])


def test_a_movie_that_does_not_fit_is_not_kept(result, tmp_path):
    path = tmp_path / "movie.mp4"
    command = [sys.executable, "-B", "-m", "splatnode", "view", str(result), "--export", str(path), "--num-frames", "5"]
    limit = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (1000, 1000))  # bytes a file, as on a full disk
    done = subprocess.run(command, cwd=ROOT, preexec_fn=limit, capture_output=True, text=True, timeout=120)
    assert done.returncode == 74 and "the movie does not fit into" in done.stderr
    assert not path.exists()


def test_no_window_is_no_failure(result, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cli, "open3d_installed", lambda: True)
    monkeypatch.setattr(cli, "probe_window", lambda: Probe(False, False, "there is no display"))
    out = tmp_path / "pictures"
    arguments = ["view", str(result), "--size", "64x48", "--num-frames", "1", "--out", str(out)]
    assert command_line.main(arguments) == 0
    assert (out / "overview.png").is_file() and "no window: there is no display" in capsys.readouterr().err


def test_a_missing_open3d_is_told_with_its_remedy_and_a_missing_file_before_it(result, monkeypatch, capsys):
    monkeypatch.setattr(cli, "open3d_installed", lambda: False)
    assert command_line.main(["view", str(result)]) == 69
    assert "pip install 'splatnode[viewer]'" in capsys.readouterr().err
    assert command_line.main(["view", "missing.yaml"]) == 2
    assert "missing.yaml: No such file" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["nowhere"], "is not there"),
        (["node.yaml", "--images", "nowhere"], "--images must be the folder"),
        (["--export", "x.mp4"], "needs a finished result"),
        (["node.yaml", "--headless"], "network"),
    ],
)
def test_usage_errors(arguments, said, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    Path("node.yaml").write_text("network: {harbour: 1}\n")
    assert command_line.main(["view", *arguments]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("import os; os.abort()", "could not open a window"),
        ("print('vulkan: no driver'); import os; os.abort()", "apt-get install mesa-vulkan-drivers"),
        ("raise ImportError('libX.so.1: cannot open shared object file')", "libX.so.1"),
        ("print('Falling back to headless mode.'); print('splatnode-window-opened')", "no display"),
        ("pass", "it said nothing"),
    ],
)
def test_a_child_that_dies_is_an_answer(script, said):
    probe = probe_window((sys.executable, "-c", script))
    assert not probe.window and said in probe.detail


def test_a_child_that_opens_a_window_names_its_device():
    lines = "Selected physical device 'llvmpipe (LLVM)' from 1\\nsplatnode-window-opened"
    assert probe_window((sys.executable, "-c", f"print({lines!r})".replace("\\\\", "\\"))) == Probe(
        True, True, "llvmpipe (LLVM)"
    )
    slow = probe_window((sys.executable, "-c", "import time; time.sleep(9)"), timeout_s=0.2)
    assert not slow.window and "took more than" in slow.detail


def test_a_window_is_opened_smaller_where_the_processor_draws_it():
    played, card = Probe(True, True, "llvmpipe").size, Probe(True, False, "a card").size
    assert played[0] * played[1] < 0.8 * card[0] * card[1]


def test_cameras_that_nobody_can_look_through_are_told():
    one = camera(0.3)
    assert not find_camera_problem(one.T_world_camera, one.K, one.width, one.height)
    one.T_world_camera[0, 0] += 0.5
    assert "rigid motion" in find_camera_problem(one.T_world_camera, one.K, one.width, one.height)


@pytest.fixture
def node(tmp_path):
    """A node that publishes what is put into its hands, and answers those who come late."""
    network = Network(directory=tmp_path / "node")
    with StateServer(RECON_SCENE, network) as server:
        stopping = threading.Event()

        def serve() -> None:
            while not stopping.is_set():
                server.serve(0.02)

        thread = threading.Thread(target=serve)
        thread.start()
        yield server, network
        stopping.set()
        thread.join()


def wait_for(source: LiveSource):
    deadline = time.monotonic() + 60
    while (found := source.take()) is None and time.monotonic() < deadline:
        time.sleep(0.01)
    assert found is not None
    return found


def test_a_viewer_that_comes_late_sees_the_newest_scene(node):
    server, network = node
    numbering = Numbering()
    for _ in range(3):
        server.publish(*encode_snapshot(snapshot(), "place", numbering.next()))
    source = LiveSource(network)
    there = wait_for(source)
    assert there.snapshot.sequence == 2 and there.scene_id == "place"
    assert len(there.snapshot.gaussians) == 225 and list(there.snapshot.images) == ["0.png", "1.png"]
    assert source.take() is None and source.age_s is not None and source.age_s < 60
    source.close()


@pytest.mark.parametrize("first", ["depth", "scene"])
def test_a_viewer_joins_the_share_of_confirmed_depth_to_its_scene(node, first):
    server, network = node
    scenes, depths = Numbering(), Numbering()
    made = snapshot()
    cameras = tuple(replace(each, consistent_depth=0.5 + 0.1 * n) for n, each in enumerate(made.cameras))
    made = replace(made, cameras=cameras)
    with StateServer(RECON_DEPTH, network) as of_depth:
        source = LiveSource(network)
        publish = [
            lambda numbers: of_depth.publish(
                make_depth_header(made, "place", numbers["sequence"], depths.next() | {"session": numbers["session"]})
            ),
            lambda numbers: server.publish(*encode_snapshot(made, "place", numbers)),
        ]
        deadline = time.monotonic() + 60
        shares = None
        while shares != [0.5, 0.6] and time.monotonic() < deadline:
            numbers = scenes.next()
            for each in publish if first == "depth" else reversed(publish):
                each(numbers)
            of_depth.serve(0.02)
            if (there := source.take()) is not None:
                shares = [each.consistent_depth for each in there.snapshot.cameras]
        assert shares == [0.5, 0.6]
        source.close()


def test_a_viewer_is_told_between_scenes_where_the_live_camera_is(node):
    _, network = node
    numbering = Numbering()
    with Publisher(RECON_STATUS, network) as publisher:
        source = LiveSource(network)
        for tracked, seen in (
            (camera(0.5, frame_id=7), "7.png"),
            (camera(0.2), "0.png"),
            (None, None),
        ):
            deadline = time.monotonic() + 60
            while (source.live_camera.name if source.live_camera else None) != seen and time.monotonic() < deadline:
                publisher.send(heartbeat(numbering, tracked))
                time.sleep(0.02)
            assert (source.live_camera.name if source.live_camera else None) == seen
            there = source.live_camera
            publisher.send(heartbeat(numbering, tracked))
            time.sleep(0.3)
            assert source.live_camera is there  # the same again is no news, for which a window would be drawn
            assert source.age_s is not None and source.age_s < 60  # no scene yet, but the node lives
        source.close()


def test_a_node_is_watched_without_a_display(node, tmp_path, monkeypatch, capsys):
    given_up = []
    monkeypatch.setattr("os.nice", given_up.append)
    monkeypatch.setattr(cli, "use_threads", given_up.append)
    monkeypatch.setattr(cli.cv2, "setNumThreads", given_up.append)
    server, network = node
    server.publish(*encode_snapshot(snapshot(), "place", Numbering().next()))
    config = tmp_path / "node.yaml"
    config.write_text(f"network: {{directory: {network.directory}}}\n")
    out = tmp_path / "pictures"
    assert (
        command_line.main(
            ["view", str(config), "--headless", "--exit-when-final", "--size", "160x120", "--out", str(out)]
        )
        == 0
    )
    assert (out / "live.png").is_file() and "live.png: OK: All is well." in capsys.readouterr().out
    assert given_up == [1, 1, 5]  # one thread, and only what the node leaves


def test_a_viewer_that_waits_says_for_what(node, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(cli, "_lower_priority", lambda: None)
    server, network = node
    config = tmp_path / "node.yaml"
    config.write_text(f"network: {{directory: {network.directory}}}\n")
    said = []

    def say(line):
        said.append(line)
        if len(said) == 1:  # only now there is a scene
            server.publish(*encode_snapshot(snapshot(), "place", Numbering().next()))

    monkeypatch.setattr(cli, "say", say)
    arguments = [
        "view",
        str(config),
        "--headless",
        "--exit-when-final",
        "--size",
        "160x120",
        "--out",
        str(tmp_path / "out"),
    ]
    assert command_line.main(arguments) == 0
    assert said[0] == "waiting for splatnode recon: nothing has come yet" and "live.png: OK" in said[-1]


def test_the_viewer_starts_without_torch_and_without_open3d(result, tmp_path):
    code = (
        "import sys; sys.modules['torch'] = sys.modules['open3d'] = None; from splatnode import command_line; "
        f"sys.exit(command_line.main(['view', {str(result)!r}, '--headless', '--size', '32x24', '--num-frames', '1']))"
    )
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert (result / "view" / "overview.png").is_file()
    assert json.loads((result / "manifest.json").read_text())["verdict"] == "OK"
