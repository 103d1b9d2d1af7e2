"""Exposures that drift along the way: `python -m tests.bench drift [SCENE:VIEWS ...] --starts DIR --out drift.json`.

All photographs of a set, training and held-out, get gains that change smoothly in their order: by a factor of `drift`
from the first to the last in green, by its power of .9 in red and 1.1 in blue, about a mean of 1 (clipped to 8 bits, as
a camera does). Sets whose own exposure drifts are taken as they are, too. Cameras and depth are found once, of the
photographs as they were taken, and serve all runs. Each method makes a scene with exposure compensation, as is its
default; `balanced-off` is `balanced` without. Renders of held-out views are scored as the scene shows them (raw), with
the gains that the training views imply (interpolated), and with those that fit each photograph best. Of more than six
held-out photographs every second one is scored. A file that is there is continued.
"""

from __future__ import annotations

import json
import math
import pickle
import shlex
import sys
import time
from dataclasses import asdict, dataclass, field, replace
from types import MappingProxyType

import msgspec
import numpy as np
import numpy.typing as npt

from splatnode.capture.process.arguments import names
from splatnode.capture.process.terminal import say
from splatnode.extras.evaluate.dataset import EvaluationScene
from splatnode.extras.evaluate.methods import Start
from splatnode.extras.evaluate.protocol import ExposureScore, Settings
from splatnode.recon.config import ReconstructionConfig, preset
from splatnode.recon.scene.exposure import ExposureConfig
from tests.bench.quality.held_out import Case, Scoring, load_case, parsed, parser_of
from tests.bench.quality.race import REFERENCE, Field
from tests.bench.quality.real_sets import last, timed

SETS = ("llff_fern:3", "llff_flower:3", "fountain_p11:6", "tum_fr3_office:6", "castle_p30:12")
OWN = ("hard_bridge_drone:12", "fox:12")  # whose exposure drifts
DRIFTS, MILD = (1.0, 1.4), (1.02, 1.15)  # of all methods; and of the first alone
TINTS = np.array([0.9, 1.0, 1.1])  # powers of the drift in red, green and blue
OFF = "balanced-off"
METHODS = (REFERENCE, OFF, "mcmc+fill")
SETTINGS = Settings(alignment_steps=30)
MAX_TESTS = 6  # held-out photographs that are scored: every second one of a set that has more


@dataclass(frozen=True)
class Row:
    scene: str
    views: int
    drift: float  # the last photograph's gain over the first's, in green
    method: str
    verdict: str
    psnr: float | None  # raw, as are the next two
    ssim: float | None
    lpips: float | None
    exposures: dict[str, ExposureScore]  # interpolated, best_gain
    gain_range: float  # largest over smallest gain that was taken out of the training photographs; 1: none was
    vignetting: float  # share of the light in the corners that their lens took; 0: none was found
    num_gaussians: int | None
    seconds: float  # of the processor, from depth on


@dataclass(frozen=True, eq=False)
class Drifting(EvaluationScene):
    """A scene whose photographs have gains (3,), by name."""

    gains: MappingProxyType[str, npt.NDArray[np.float64]] = field(default_factory=lambda: MappingProxyType({}))

    def image(self, name: str) -> npt.NDArray[np.uint8]:
        return changed(super().image(name), self.gains[name])


def changed(image: npt.NDArray[np.uint8], gains: npt.NDArray[np.float64]) -> npt.NDArray[np.uint8]:
    return np.clip(np.rint(image * gains), 0, 255).astype(np.uint8)


def drifting(case: Case, drift: float) -> Case:
    """The case with gains by the place of each photograph that it uses."""
    used = {*case.split.train, *case.split.test}
    order = [name for name in case.scene.paths if name in used]
    places = np.linspace(0.0, 1.0, len(order))
    logs = np.log(drift) * TINTS * (-0.5 * np.cos(np.pi * places))[:, None]
    gains = MappingProxyType(dict(zip(order, np.exp(logs), strict=True)))
    scene = case.scene
    return replace(case, scene=Drifting(scene.name, scene.paths, scene.cameras, scene.masks, gains))


def changed_start(start: Start, scene: EvaluationScene) -> Start:
    """The start with the photographs of `scene`, if those drift."""
    if not isinstance(scene, Drifting):
        return start
    graph, shown = start.estimate.graph, []
    for each in start.estimate.graph.keyframes:
        gains = scene.gains[each.name]
        frame = replace(each.frame, image=changed(each.frame.image, gains), encoded=None)
        shown.append(replace(each, frame=frame, image=changed(each.image, gains)))
    return replace(start, estimate=replace(start.estimate, graph=replace(graph, keyframes=tuple(shown))))


def config_of(method: str, chosen: int) -> ReconstructionConfig:
    if method == OFF:
        return msgspec.structs.replace(preset(REFERENCE), exposure_compensation=ExposureConfig(enabled=False))
    return Field(chosen).config(method) or preset(method)


def measure(case: Case, start: bytes, drift: float, method: str, chosen: int, scoring: Scoring) -> Row:
    if len(case.split.test) > MAX_TESTS:
        case = replace(case, split=replace(case.split, test=case.split.test[::2]))
    shown = case if drift == 1.0 else drifting(case, drift)
    begun = changed_start(pickle.loads(start), shown.scene)
    config = config_of(method, chosen)
    snapshot, row, seconds = timed(
        lambda: last(begun, config), shown.scene, shown.split, scoring.networks, scoring.settings
    )
    gains = np.array(list(snapshot.gains.values()) or [[1.0]])
    exposures = dict(row.exposures)
    raw = exposures.pop("raw", None)
    return Row(
        *(case.scene.name, len(case.split.train), drift, method, row.verdict),
        *((raw.psnr, raw.ssim, raw.lpips_alex) if raw else (None, None, None)),
        *(exposures, round(float((gains.max(0) / gains.min(0)).max()), 3)),
        round(1.0 - math.exp(-max(snapshot.falloffs.values(), default=0.0)), 3),
        *(row.num_gaussians, round(seconds, 1)),
    )


def in_words(row: Row) -> str:
    scores = ", ".join(f"{kind} {each.psnr:.2f}" for kind, each in row.exposures.items())
    off = f"{row.exposures['interpolated'].gain_error_pct:.1f} %" if row.exposures else "unknown"
    return (
        f"{row.scene} {row.views}, drift {row.drift}, {row.method}: {row.verdict}, raw {row.psnr:.2f}, {scores} dB, "
        f"gains off by {off}, {row.num_gaussians} Gaussians, {row.seconds} s"
    )


def planned(sets: list[str], methods: tuple[str, ...]) -> list[tuple[str, float, str]]:
    """Set, drift and method of each run; those of mild drifts come last."""
    found = []
    for method, drifts in (*((method, DRIFTS) for method in methods), *((each, MILD) for each in methods[:1])):
        for each in sets:
            own = drifts if each not in OWN else drifts[:1] if drifts is DRIFTS else ()
            found += [(each, drift, method) for drift in own]
    return found


def main() -> None:
    parser = parser_of(__doc__, (*SETS, *OWN))
    parser.add_argument("--methods", type=names, default=METHODS)
    parser.add_argument("--drifts", type=names, default=tuple(map(str, (*DRIFTS, *MILD))), help="of the runs")
    arguments, folders, scoring = parsed(parser)
    scoring = replace(scoring, settings=SETTINGS)
    before = json.loads(arguments.out.read_text()) if arguments.out.exists() else {"command": "", "rows": []}
    known = before["rows"]
    command = shlex.join(["python", "-m", "tests.bench", "drift", *sys.argv[1:]])
    command = "; ".join(dict.fromkeys((*filter(None, before["command"].split("; ")), command)))
    for each, drift, method in planned(arguments.cases or [*SETS, *OWN], tuple(arguments.methods)):
        if str(drift) not in arguments.drifts:
            continue
        name, _, views = each.partition(":")
        same = [row for row in known if (row["scene"], row["views"], row["drift"]) == (name, int(views), drift)]
        if any(row["method"] == method for row in same):
            continue
        begun = time.monotonic()
        case = load_case(each, folders)
        reference = next((row for row in same if row["method"] == REFERENCE), None)
        if method == OFF and reference and reference["gain_range"] == 1.0 and not reference["vignetting"]:
            known.append(reference | {"method": OFF})  # nothing was taken out
        else:
            chosen = reference["num_gaussians"] if reference else 1
            row = measure(case, case.start(folders), drift, method, chosen, scoring)
            say(f"{in_words(row)} ({time.monotonic() - begun:.0f} s in all)")
            known.append(asdict(row))
        arguments.out.write_text(json.dumps({"command": command, "rows": known}, indent=1) + "\n")


if __name__ == "__main__":
    main()
