"""The viewer driven by mouse and keys, as a person would, with a picture of each step to be looked at:
`xvfb-run -s "-screen 0 1280x800x24" python -m tests.bench drive RESULT FOLDER`. It needs xdotool.

The viewer starts late, at a node whose scene is there already; then the scene grows.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame
from splatnode.capture.messaging.messages import Numbering
from splatnode.capture.messaging.network import RECON_SCENE, RECON_STATUS, Network
from splatnode.capture.messaging.pubsub import Publisher, StateServer
from splatnode.recon.result.export.limits import select_gaussians
from splatnode.recon.result.message import encode_snapshot
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.result.verdict import Code, Verdict
from splatnode.viewer.analysis import analyse
from splatnode.viewer.sources import load_result
from splatnode.viewer.state import Moment, overview, project
from tests.support.node import heartbeat
from tests.support.screen import Screen

WINDOW = 1280, 800
PICTURE = 928, 800  # the part of it that is not the panel
SETTLE_S = 0.7  # after an action has begun to show
HEARTBEAT_S = 1.0
PATIENCE_S = 4.0  # with what does not show
SEEN = 5e-4  # part of the screen: more than a button that lights up under the pointer
REASONS = (DroppedFrame("blurred.jpg", "too blurred"), DroppedFrame("elsewhere.jpg", "it overlaps with no other frame"))


@dataclass(frozen=True)
class Step:
    name: str
    actions: tuple[str, ...]  # what xdotool is asked for


def click(x: float, y: float, button: int = 1) -> str:
    return f"mousemove {round(x)} {round(y)} sleep 0.2 mousedown {button} sleep 0.25 mouseup {button}"


def drag(button: int) -> str:
    path = " sleep 0.05 ".join(f"mousemove {400 + 15 * step} {350 + 5 * step}" for step in range(1, 9))
    return f"mousemove 400 350 sleep 0.1 mousedown {button} sleep 0.1 {path} mouseup {button}"


def steps(camera: npt.NDArray[np.floating]) -> list[Step]:
    """What a person would try; `camera` (2,) is where one is seen. Rows of the panel are where its theme puts them."""
    switches = ("gaussians", "as_points", "cameras", "photographs", "path", "tracked")
    places = [(x, y) for y in (69, 96, 123) for x in (947, 1097)]
    toggled = [
        Step(f"switch_{name}_{turn}", (click(*place),))
        for name, place in zip(switches, places, strict=True)
        for turn in ("changed", "back")
    ]
    colours = [Step(f"colour_{name}", ("key c",)) for name in ("depth", "normal", "support", "source", "photograph")]
    return [
        Step("started", ()),
        Step("help", ("key h",)),
        Step("help_closed", ("key h",)),
        Step("show_tab", (click(1010, 46),)),
        Step("ground_hidden", (click(1097, 177),)),
        Step("ground_shown", (click(1097, 177),)),
        Step("whole_at_first", ("key r",)),
        *toggled,
        *colours,
        Step("points", ("key g",)),
        Step("points_larger", ("key bracketright", "key bracketright")),
        Step("points_off", ("key g",)),
        Step("orbit", (drag(1),)),
        Step("pan", (drag(3),)),
        Step("zoom", ("mousemove 460 400 click 4 click 4 click 4",)),
        Step("whole", ("key r",)),
        Step("camera_clicked", (click(*camera),)),
        Step("blend_half", ("key period", "key period")),
        Step("blend_full", ("key period", "key period")),
        Step("blend_none", ("key comma", "key comma", "key comma", "key comma")),
        Step("next_camera", ("key n",)),
        Step("follow", ("key f",)),
        Step("free_again", ("key r",)),
        Step("past", ("key Left", "key Left")),
        Step("present", ("key Right", "key Right")),
        Step("paused", ("key space",)),
        Step("unpaused", ("key space",)),
        *lists_and_sliders(),
        *photographs(),
        *tools(),
        Step("saved", ("key s",)),
        Step("open3d", ("key e",)),
        Step("open3d_points", ("key g",)),
        Step("own_again", ("key e", "key g")),
        Step("resized", ("search --name ^splatnode$ windowsize 900 600",)),
    ]


def lists_and_sliders() -> list[Step]:
    """The drop-down lists and sliders of the tab Show by mouse, and back to how it was."""
    return [
        Step("colour_list", (click(1269, 250), "mousemove 1060 272")),
        Step("colour_chosen", (click(1050, 298),)),
        Step("points_again", ("key g",)),
        Step("points_slider", (click(1230, 358),)),
        Step("time_slider", (click(1000, 412),)),
        Step("time_slider_back", (click(1260, 412),)),
        Step("as_before", ("key g", "key r", "key c", "key c", "key c", "key c")),
    ]


def photographs() -> list[Step]:
    """The tab Photographs: the list, the slider, and back."""
    return [
        Step("photographs_tab", (click(1086, 46),)),
        Step("photograph_chosen", (click(980, 238),)),
        Step("blend_slider", (click(1230, 125),)),
        Step("blend_slider_back", (click(940, 125),)),
        Step("photograph_left", (click(1100, 69),)),
    ]


def tools() -> list[Step]:
    """The tab Tools: measuring, the box, crop, clean-up, undo and a new result."""
    return [
        Step("tools_tab", (click(1165, 46),)),
        Step("measure", (click(1100, 69),)),
        Step("first_point", (click(430, 400),)),
        Step("second_point", (click(620, 300),)),
        Step("measured_no_more", ("key d",)),
        Step("box", (click(947, 151),)),
        Step("box_smaller", (click(1050, 205), click(1050, 313))),
        Step("cropped", (click(1100, 341),)),
        Step("clean", (click(1100, 397),)),
        Step("new_result", (click(1180, 453),)),
        Step("undone", (click(970, 453),)),
        Step("all_undone", ("key z",)),
        Step("box_gone", ("key b",)),
        Step("show_tab_again", (click(1010, 46),)),
    ]


def growing(whole: Snapshot) -> list[Snapshot]:
    """The result as it might have grown: more cameras and Gaussians each time."""
    count = len(whole.cameras)
    parts = []
    for number, cameras in enumerate((3, max(3, count // 2), count)):
        share = cameras / count
        gaussians = select_gaussians(whole.gaussians, np.random.default_rng(0).random(len(whole.gaussians)) < share)
        verdict = whole.verdict
        if cameras < count:
            verdict = Verdict(Code.OK_PARTIAL, f"{cameras} of {count} photographs were placed.", "Go on.", (), True)
        parts.append(
            replace(
                whole,
                sequence=number,
                cameras=whole.cameras[:cameras],
                gaussians=gaussians,
                verdict=verdict,
                dropped=REASONS[:number],
                final=False,
            )
        )
    return parts


def main() -> None:
    parser = argparse.ArgumentParser(prog="python -m tests.bench drive", description=__doc__)
    parser.add_argument("result", type=Path, help="a result's folder with its photographs")
    parser.add_argument("out", type=Path, help="where the pictures go")
    arguments = parser.parse_args()
    arguments.out.mkdir(parents=True, exist_ok=True)
    moment = load_result(arguments.result)
    with tempfile.TemporaryDirectory(prefix="splatnode-") as folder:
        config = Path(folder, "node.yaml")
        config.write_text(f"network: {{directory: {folder}}}\n")
        network = Network(directory=Path(folder))
        with StateServer(RECON_SCENE, network) as server, Publisher(RECON_STATUS, network) as heartbeats:
            server.publish(*encode_snapshot(growing(moment.snapshot)[0], "place", Numbering().next()))
            command = [sys.executable, "-m", "splatnode", "view", str(config), "--size", "x".join(map(str, WINDOW))]
            command += ["--out", str(arguments.out)]
            viewer = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            try:
                drive(moment, server, heartbeats, viewer, arguments.out)
            finally:
                viewer.terminate()
                print("exit status", viewer.wait())


def drive(moment: Moment, server: StateServer, heartbeats: Publisher, viewer: subprocess.Popen, out: Path) -> None:
    """Takes all the steps. Raises SystemExit where the viewer ends before."""
    screen, numbering = Screen(), Numbering()
    tracked, beaten = None, 0.0

    def settle(seconds: float) -> None:
        nonlocal beaten
        until = time.monotonic() + seconds
        while time.monotonic() < until:
            server.serve(0.02)
            if time.monotonic() - beaten > HEARTBEAT_S:
                beaten = time.monotonic()
                heartbeats.send(heartbeat(numbering, tracked))

    while viewer.poll() is None and screen.picture(*PICTURE).std() < 8:
        settle(0.2)
    for snapshot in growing(moment.snapshot):
        server.publish(*encode_snapshot(snapshot, "place", numbering.next()))
        settle(2 * SETTLE_S)
    tracked = moment.snapshot.cameras[-1]
    settle(HEARTBEAT_S + SETTLE_S)
    view = overview(moment, analyse(moment).advice.arrow or ())
    camera = project(moment.snapshot.cameras[1].T_world_camera[None, :3, 3], view, *PICTURE)[0, :2]
    before = screen.picture(*WINDOW)
    for number, step in enumerate(steps(camera)):
        for action in step.actions:
            subprocess.run(["xdotool", *action.split()], check=True)
            settle(0.15)
        acted = time.monotonic()
        while not (shows := changed(before, screen.picture(*WINDOW)) > SEEN) and time.monotonic() < acted + PATIENCE_S:
            settle(0.05)
        seconds = time.monotonic() - acted
        settle(SETTLE_S)
        after = screen.picture(*WINDOW)
        when = f"after {seconds:.1f} s" if shows else "NEVER"
        print(f"{number:02d} {step.name}: {changed(before, after):.2%} of the screen changed, {when}", flush=True)
        cv2.imwrite(str(out / f"{number:02d}_{step.name}.png"), after)
        before = after
        if viewer.poll() is not None:
            raise SystemExit(f"the viewer ended with {viewer.returncode} at {step.name}")


def changed(before: npt.NDArray[np.uint8], after: npt.NDArray[np.uint8]) -> float:
    """The part of the pixels that are others."""
    return float((np.abs(after.astype(int) - before) > 8).any(2).mean())


if __name__ == "__main__":
    main()
