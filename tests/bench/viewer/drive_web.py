"""The viewer in a browser, driven as a person would, with a picture of each step to be looked at, and how fast it is:
`python -m tests.bench drive_web RESULT FOLDER`. It needs Chromium, which draws with software here.

The browser is there before the first scene; then the scene grows, another begins, and the viewer is started anew.
Pictures a second are told beside the processor time of each, which other programs disturb less.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.recon.result.export.limits import select_gaussians
from splatnode.recon.result.snapshot import Snapshot
from splatnode.viewer.analysis import analyse
from splatnode.viewer.sources import load_result
from splatnode.viewer.state import Moment, overview, project
from tests.bench.speed.rasterize import processor_name
from tests.bench.viewer.drive import growing
from tests.support.chromium import Browser, browser
from tests.support.pretend_node import PretendNode

WINDOW = 1280, 800
GAUSSIANS = 40_000
MOVED_S = 20.0  # of an orbit that is timed
PATIENCE_S = 30.0  # with a step: software that draws on a busy machine
_STARTS_S = 60.0
_SETTLED = "document.body.dataset.pictures"


@dataclass(frozen=True)
class Step:
    name: str
    act: Callable[[], object]
    shows: str  # JavaScript that is true once it has worked


@dataclass(frozen=True)
class Done:
    name: str
    seconds: float | None  # until it showed; None: it never did
    picture: npt.NDArray[np.uint8]  # (H, W, 3) BGR


class Viewer:
    """`splatnode view --web` as a process, which can be started anew at the same address."""

    def __init__(self, config: Path, *options: str) -> None:
        self._command = [sys.executable, "-m", "splatnode", "view", "--web", str(config), *options]
        self.port, self.url = 0, ""
        self.start()

    def start(self) -> None:
        command = [*self._command, "--port", str(self.port)]
        self._process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
        assert self._process.stdout is not None
        self.said = self._process.stdout.readline()
        self.url = next(word for word in self.said.split() if word.startswith("http://"))
        self.port = int(self.url.split(":")[2].split("/")[0])

    def stop(self) -> int:
        """The exit code."""
        self._process.terminate()
        return self._process.wait(_STARTS_S)


def drive(page: Browser, node: PretendNode, viewer: Viewer, whole: Snapshot) -> Iterator[Done]:
    """Takes all the steps, one after the other."""
    for step in steps(page, node, viewer, whole):
        step.act()
        seconds = page.wait(step.shows, PATIENCE_S)
        settle(page)
        yield Done(step.name, seconds, page.picture())


def settle(page: Browser) -> None:
    """Waits until no picture has come for a while: it is drawn in full, with every photograph."""
    before, since = None, time.monotonic()
    deadline = since + PATIENCE_S
    while time.monotonic() < min(since + 0.7, deadline):
        now = page.value(_SETTLED)
        if now != before:
            before, since = now, time.monotonic()
        time.sleep(0.1)


def steps(page: Browser, node: PretendNode, viewer: Viewer, whole: Snapshot) -> Iterator[Step]:
    """What a person would try. Each is made when those before it are done."""
    few, more, every = growing(whole)
    yield Step("waiting", lambda: page.open(viewer.url), said("notice", "waiting"))
    yield Step("first_scene", lambda: node.publish(few), f"{fact('gaussians')} == {len(few.gaussians)}")
    yield Step("at_a_camera", lambda: None, f"{fact('camera')} == '{few.cameras[1].name}'")
    yield Step(
        "verdict", lambda: None, f"{said('verdict', 'photographs were placed')} && {said('state', 'provisional')}"
    )
    yield Step("advice", lambda: None, f"{said('sections', 'Next view')} && !{said('sections', 'looking for')}")
    yield Step("overview", lambda: page.press("r"), f"{fact('camera')} == ''")
    yield Step("cameras_hidden", lambda: page.press("2"), f"!{switch('cameras')}")
    yield Step("cameras_shown", lambda: page.press("2"), switch("cameras"))
    yield moves(page, "orbit", lambda: page.drag((400, 400), (520, 420)))
    yield moves(page, "pan", lambda: page.drag((400, 400), (440, 430), "right"))
    yield moves(page, "zoom", lambda: [page.wheel(480, 400, -100) for _ in range(3)])
    yield Step("as_points", lambda: page.press("g"), switch("as points"))
    yield Step("gaussians_hidden", lambda: page.press("1"), f"!{switch('Gaussians')}")
    yield Step(
        "gaussians_back", lambda: [page.press("1"), page.press("g")], f"{switch('Gaussians')} && !{switch('as points')}"
    )
    yield Step("whole_again", lambda: page.press("r"), f"{fact('camera')} == ''")
    yield Step("camera_clicked", lambda: click_camera(page, few), f"{fact('camera')} == '{few.cameras[2].name}'")
    yield Step("photograph_over", lambda: page.value(SLIDE), "!document.getElementById('over').hidden")
    yield Step("next_camera", lambda: page.press("n"), f"{fact('camera')} == '{few.cameras[0].name}'")
    yield moves(page, "left_the_camera", lambda: page.drag((400, 400), (330, 380)))
    kept = page.value(fact("view"))
    held = f"{fact('view')} == '{kept}'"
    yield Step("grown", lambda: node.publish(more), f"{fact('gaussians')} == {len(more.gaussians)} && {held}")
    yield Step("grown_again", lambda: node.publish(every), f"{fact('gaussians')} == {len(every.gaussians)} && {held}")
    yield Step("left_out", lambda: None, said("sections", "elsewhere.jpg: it overlaps with no other frame"))
    node.tracked = whole.cameras[-1]
    yield Step("live_camera", lambda: None, f"!{label('tracked camera')}.hidden")
    yield Step("viewer_gone", viewer.stop, said("notice", "no connection"))
    yield Step("viewer_back", viewer.start, f"document.getElementById('notice').textContent == '' && {held}")
    last = replace(every, final=True)
    yield Step("final", lambda: node.publish(last), f"{said('state', 'final')} && {held}")
    yield Step("another_place", lambda: node.publish(few, "elsewhere"), f"{fact('camera')} == '{few.cameras[1].name}'")
    yield Step("narrow", lambda: page.resize(420, 800), "document.getElementById('picture').clientWidth == 420")
    yield Step("wide_again", lambda: page.resize(*WINDOW), "document.getElementById('picture').clientWidth > 900")


SLIDE = (
    "(() => { const slider = document.querySelector('#blend input'); slider.value = 0.7; "
    "slider.dispatchEvent(new Event('input')); })()"
)


def moves(page: Browser, name: str, act: Callable[[], object]) -> Step:
    """A step after which the viewpoint is another one."""
    return Step(name, act, f"{fact('view')} != '{page.value(fact('view'))}'")


def fact(name: str) -> str:
    return f"document.body.dataset.{name}"


def said(place: str, text: str) -> str:
    return f"document.getElementById('{place}').textContent.includes({json.dumps(text)})"


def label(text: str) -> str:
    """The label of the switch with that text."""
    return f"[...document.querySelectorAll('#switches label')].find((one) => one.textContent == '{text}')"


def switch(text: str) -> str:
    """Whether the switch is on."""
    return f"{label(text)}.firstChild.checked"


def click_camera(page: Browser, scene: Snapshot) -> None:
    """Clicks on the third camera, as the whole scene is seen."""
    moment = Moment(scene, 0.0, "place")
    view = overview(moment, analyse(moment).advice.arrow or ())
    width, height = page.value("[document.getElementById('picture').clientWidth, innerHeight]")
    ((x, y, _),) = project(scene.cameras[2].T_world_camera[None, :3, 3], view, width, height)
    page.click(x, y)


def rate(page: Browser, seconds: float) -> dict[str, float]:
    """Pictures a second while the scene is turned, and what each takes of the processors."""
    page.press("r")
    settle(page)
    page.mouse("mouseMoved", 400, 400)
    page.mouse("mousePressed", 400, 400, "left", clickCount=1)
    turn(page, 0.2 * seconds)  # by then it knows how many pixels can be drawn
    count = f"Number({_SETTLED})"
    pictures, processor, began = page.value(count), page.processor_s(), time.monotonic()
    turn(page, 0.8 * seconds)
    drawn, took, elapsed = page.value(count) - pictures, page.processor_s() - processor, time.monotonic() - began
    width = page.value("document.getElementById('picture').width")
    page.mouse("mouseReleased", 400, 400, "left", clickCount=1)
    return {
        "per_second": round(drawn / elapsed, 2),
        "processor_ms_each": round(1000 * took / max(drawn, 1)),
        "width_drawn_px": width,
        "width_shown_px": page.value("document.getElementById('picture').clientWidth"),
    }


def turn(page: Browser, seconds: float) -> None:
    """Drags to and fro."""
    until, number = time.monotonic() + seconds, 0
    while time.monotonic() < until:
        number += 1
        page.mouse("mouseMoved", 400 + 3 * abs(number % 100 - 50), 400, "left")


def exactly(snapshot: Snapshot, number: int) -> Snapshot:
    """The scene with `number` Gaussians, chosen by chance; of a smaller scene some are there more than once."""
    have, rng = len(snapshot.gaussians), np.random.default_rng(0)
    chosen = np.concatenate([np.arange(have)] * (number // have) + [rng.permutation(have)[: number % have]])
    return replace(snapshot, gaussians=select_gaussians(snapshot.gaussians, chosen))


@contextlib.contextmanager
def watched(*options: str) -> Iterator[tuple[Browser, PretendNode, Viewer]]:
    """A browser, a node that a viewer listens to, and the viewer; all end with the block."""
    with tempfile.TemporaryDirectory(prefix="splatnode-") as folder, browser(*WINDOW) as page:
        node = PretendNode(Path(folder))
        viewer = Viewer(node.config, *options)
        try:
            yield page, node, viewer
        finally:
            viewer.stop()
            node.close()


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench drive_web", description=__doc__)
    parser.add_argument("result", type=Path, help="a result's folder with its photographs")
    parser.add_argument("folder", type=Path, help="where the pictures go")
    parser.add_argument("--out", type=Path, help="where the figures go, as JSON")
    arguments = parser.parse_args()
    arguments.folder.mkdir(parents=True, exist_ok=True)
    whole = load_result(arguments.result).snapshot
    report = {
        "command": "python -m tests.bench drive_web RESULT FOLDER",
        "machine": {"processor": processor_name(), "processors": os.cpu_count(), "load_average": os.getloadavg()[0]},
        "graphics": "SwiftShader, software on the processors",
        "window": WINDOW,
        "steps": {},
    }
    with watched() as (page, node, viewer):
        for number, done in enumerate(drive(page, node, viewer, whole)):
            when = "NEVER" if done.seconds is None else f"after {done.seconds:.1f} s"
            print(f"{number:02d} {done.name}: {when}", flush=True)
            cv2.imwrite(str(arguments.folder / f"{number:02d}_{done.name}.png"), done.picture)
            report["steps"][done.name] = None if done.seconds is None else round(done.seconds, 2)
        large = exactly(whole, GAUSSIANS)
        node.publish(large)
        report["seen_after_s"] = page.wait(f"{fact('gaussians')} == {GAUSSIANS}")
        report["pictures"] = {"gaussians": GAUSSIANS} | rate(page, MOVED_S)
        report["complaints"] = page.complaints
    report["machine"]["load_average_after"] = os.getloadavg()[0]
    print(json.dumps({key: report[key] for key in ("pictures", "complaints", "machine")}, indent=1))
    if arguments.out:
        arguments.out.write_text(json.dumps(report, indent=1) + "\n")


if __name__ == "__main__":
    main()
