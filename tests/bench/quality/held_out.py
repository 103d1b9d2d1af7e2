"""What benches that make many scenes of the same photographs share: cameras and points found once, and the scores."""

from __future__ import annotations

import argparse
import pickle
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from splatnode.extras.evaluate.dataset import EvaluationScene, Split, load_scene, load_split
from splatnode.extras.evaluate.methods import find_start
from splatnode.extras.evaluate.protocol import PerceptualNetworks, Run, Settings, evaluate, load_networks
from splatnode.extras.evaluate.protocol import Row as Scored
from splatnode.extras.evaluate.regions import Counts
from splatnode.recon.config import preset
from splatnode.recon.rasterize import rasterize_on_cpu
from splatnode.recon.result.snapshot import Snapshot


@dataclass(frozen=True, eq=False)
class Scoring:
    networks: PerceptualNetworks
    settings: Settings


@dataclass(frozen=True, eq=False)
class Folders:
    scenes: Path
    starts: Path  # cameras and points that were found before


@dataclass(frozen=True, eq=False)
class Case:
    """Photographs of a scene, and the views that score what is made of them."""

    scene: EvaluationScene
    split: Split

    def score(
        self,
        snapshot: Snapshot,
        method: str,
        scoring: Scoring,
        shown: Mapping[str, Counts] | None = None,
    ) -> Scored:
        """`shown` as for `evaluate`."""
        run = Run(method, 0, None, {}, None)
        return evaluate(
            snapshot,
            self.scene,
            self.split,
            run,
            rasterize=rasterize_on_cpu,
            networks=scoring.networks,
            settings=scoring.settings,
            shown=shown,
        )

    def start(self, folders: Folders) -> bytes:
        """Cameras and points of the photographs, pickled: every method gets a copy of its own."""
        path = folders.starts / f"{self.scene.name}_{len(self.split.train)}.start"
        if not path.exists():
            folders.starts.mkdir(parents=True, exist_ok=True)
            path.write_bytes(pickle.dumps(find_start(self.scene.frames(self.split.train), preset("balanced"))))
        return path.read_bytes()


def load_case(case: str, folders: Folders) -> Case:
    """The case called SCENE:VIEWS."""
    name, _, views = case.partition(":")
    scene = load_scene(folders.scenes / name)
    return Case(scene, load_split(folders.scenes / name, list(scene.paths), int(views)))


def parser_of(doc: str | None, cases: Sequence[str]) -> argparse.ArgumentParser:
    """A parser with the arguments that these benches have in common; `cases` are the default."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("cases", nargs="*", help=f"default: {' '.join(cases)}")
    parser.add_argument("--shared", type=Path, default=Path("../shared"), help="folder with scenes/ and weights/")
    parser.add_argument("--starts", type=Path, required=True, help="folder for cameras and points")
    parser.add_argument("--out", type=Path, required=True, help="JSON file to fill")
    return parser


def parsed(parser: argparse.ArgumentParser) -> tuple[argparse.Namespace, Folders, Scoring]:
    """The arguments and what they name. Ends the program where LPIPS's weights are not there."""
    arguments = parser.parse_args()
    networks = load_networks(arguments.shared / "weights").quickest
    if networks.alex is None:
        parser.error(f"{arguments.shared}/weights must hold LPIPS's weights for AlexNet. Run: splatnode weights")
    return arguments, Folders(arguments.shared / "scenes", arguments.starts), Scoring(networks, Settings())
