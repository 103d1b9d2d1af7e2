"""The race against other recipes, case by case: `python -m tests.bench race --out DIR [--seeds N] [--methods A,B]`.

race_cases.json names the sets: scenes that no default or preset was chosen on, and other windows of photographs of
scenes on which some were. Presets run against the recipes of others, as published and in a start with our filled depths
and far shell (`+fill`), from the same cameras and points; `mcmc` has as many Gaussians as `balanced` chose. Every
held-out view is scored whole and by what the training photographs show of it. DIR holds what `splatnode bench` writes;
runs that it holds already are not run again. With `--device cuda` scenes are refined, and held-out cameras searched, on
a GPU, which runs share: their rows have no seconds.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import msgspec

from splatnode.capture.frame import Frame
from splatnode.capture.process.arguments import names, positive
from splatnode.capture.process.terminal import say
from splatnode.extras.evaluate import methods
from splatnode.extras.evaluate.methods import Start, continue_reconstruction, extract_start_config
from splatnode.extras.evaluate.protocol import INTERPOLATED_START, PerceptualNetworks, Settings, load_networks
from splatnode.extras.evaluate.report import Bench, redraw
from splatnode.extras.evaluate.runner import MethodRunner, Plan, Scoring, run_bench
from splatnode.extras.jobs import Engine, engine
from splatnode.recon.config import ReconstructionConfig
from splatnode.recon.rasterize import Device, DeviceUnavailable, choose_device, make_rasterizer
from splatnode.recon.result.export.staged import write_files
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.verbs import add_device
from tests.bench.quality import race_chart
from tests.bench.quality.parsimony import configurations
from tests.bench.quality.parsimony_chart import PIXEL, RIVAL
from tests.bench.quality.race_cases import Case, cases, linked

REFERENCE = "balanced"  # run first: others get as many Gaussians as it chose
METHODS = (
    *(REFERENCE, "fast", "instantsplat-xl+fill", "instantsplat-xl", "pixel+fill", "mcmc+fill"),
    *("instantsplat-s+fill", "instantsplat-s", "paper+fill", "paper", "pixel", "mcmc", "quality"),
)


@dataclass(frozen=True)
class Field:
    """Who runs, where `chosen` is the number of Gaussians for `mcmc`."""

    chosen: int
    device: Device = "cpu"

    def config(self, name: str) -> ReconstructionConfig | None:
        """Of a method that only this bench has."""
        base, _, fill = name.partition("+")
        if base not in ("pixel", "mcmc"):
            return None
        config = configurations(self.chosen)[PIXEL if base == "pixel" else RIVAL]
        return methods.add_surroundings(config, "fill") if fill else config

    def reconstruct(self, frames: Sequence[Frame], name: str, seed: int, start: Start | None) -> Iterator[Snapshot]:
        config = self.config(name)
        if config is None or start is None:
            return methods.run_method(frames, name, seed, start, self.device)
        return continue_reconstruction(start, msgspec.structs.replace(config, seed=seed, device=self.device))

    def start_of(self, name: str) -> ReconstructionConfig | None:
        config = self.config(name)
        return methods.select_start_config(name) if config is None else extract_start_config(config)


@dataclass(frozen=True)
class How:
    """How runs are made and scored, the same for all cases."""

    methods: tuple[str, ...]
    seeds: tuple[int, ...]
    scoring: Scoring
    engine: Engine
    device: Device
    timed: bool  # False: runs share a GPU


def run(case: Case, how: How, scenes: Path, out: Path) -> Bench:
    """Adds the runs of a case to what `out` holds."""
    scene = linked(case, scenes, out / "scenes")
    plan = partial(Plan, (scene,), (len(case.train),), seeds=how.seeds, timed=how.timed)
    go_on = partial(run_bench, out_dir=out, scoring=how.scoring, command=command(), resume=True, engine=how.engine)
    first = Field(1, how.device)  # the number of Gaussians is for others
    bench = go_on(plan((REFERENCE,)), MethodRunner(first.reconstruct, first.start_of))
    mine = [row for row in bench.rows if (row.scene, row.views, row.method) == (case.name, len(case.train), REFERENCE)]
    if mine[0].psnr is None:
        return bench  # refused: the others start from the same cameras, so there is nothing to compare
    entrants = Field(mine[0].num_gaussians or 1, how.device)
    return go_on(plan(how.methods), MethodRunner(entrants.reconstruct, entrants.start_of))


def quick_networks(weights_dir: Path) -> PerceptualNetworks:
    return load_networks(weights_dir).quickest


def command() -> str:
    return shlex.join(["python", "-m", "tests.bench", "race"])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", help="of cases, or NAME:VIEWS (default: all)")
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--seeds", type=positive, default=1, metavar="N", help="seeds 0 to N-1")
    parser.add_argument("--methods", type=names, default=METHODS)
    parser.add_argument("--interpolate-start", action="store_true", help="as `splatnode bench` has it")
    parser.add_argument("--cores", type=positive, metavar="N", help="as `splatnode bench` has it")
    add_device(parser)
    parser.add_argument("--shared", type=Path, default=Path("../shared"), help="folder with scenes/ and weights/")
    args = parser.parse_args()
    settings = INTERPOLATED_START if args.interpolate_start else Settings()
    wanted: Device = args.device or "cpu"
    try:
        on = choose_device(wanted)
    except DeviceUnavailable as error:
        parser.error(str(error))
    networks = partial(quick_networks, (args.shared / "weights").absolute())
    scoring = Scoring(make_rasterizer(on), networks, settings, by_region=True)
    if networks().alex is None:
        parser.error(f"{args.shared}/weights must hold LPIPS's weights for AlexNet. Run: splatnode weights")
    found = [case for case in cases() if not args.names or {case.name, case.label} & set(args.names)]
    if not found:
        sys.exit(f"no such case; there are {', '.join(case.label for case in cases())}")
    with engine(args.cores, None) as where:
        how = How(tuple(args.methods), tuple(range(args.seeds)), scoring, where, wanted, on.type == "cpu")
        for case in found:
            bench = run(case, how, args.shared / "scenes", args.out)
            redraw(bench, args.out)
            ends = [row for row in bench.rows if row.final]
            if race_chart.times(ends):
                write_files(args.out, {"race.png": race_chart.draw(ends)})
            say(f"{case.name}, {len(case.train)} views: done")


if __name__ == "__main__":
    main()
