"""How much of what one sees from elsewhere is needles and floaters: `python -m tests.bench needles [SCENE:VIEWS ...]`.

A finished scene of `balanced` is looked at from 30 viewpoints between the cameras and beside them (viewpoints.py). A
point of it is empty where the place is known (known_surfaces.py: true cameras, and stereo of ALL photographs of the
scene where three agree, those held out included, or the built-in place's true depth), no known surface is within a
tenth of its depth from it, and a line of sight that crosses it goes on by more than that to a known surface: that of a
photograph, or that of the viewpoint itself, from which it then hides that surface.

needle   a Gaussian with a footprint, of four standard deviations, of at least a sixteenth of the picture's longer side,
         at least five times as long as wide, whose centre, or an end of whose longest axis at 1.5 standard deviations,
         is in empty space
floater  another Gaussian, whose centre is

A pixel is covered where they give at least a quarter of its light, and its colour would change by at least a tenth of
the range without them. What nobody knows is not judged: the sky, plain ground, and what two photographs alone see. A
near object that no three photographs confirm counts as a floater where it hides what is known, though it may be real.

Neither the reference nor the viewpoints are known to a reconstruction, which has six photographs and finds its own
cameras. `--pictures` writes what is seen, and what is marked: red needles, green floaters, yellow both together.
Rows are by scene, views and label; those that the file holds already are measured again only under another label.
"""

from __future__ import annotations

import json
import pickle
import time
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt

from splatnode.capture.cameras import synthetic
from splatnode.capture.image_file import encode_png
from splatnode.extras.evaluate.methods import Start, continue_reconstruction, find_start
from splatnode.extras.evaluate.protocol import Settings
from splatnode.recon.config import ReconstructionConfig, preset
from splatnode.recon.geometry import Similarity, align_cameras
from splatnode.recon.result.export import sanitize_gaussians
from splatnode.recon.result.levels_of_detail import remove_unconfirmed
from splatnode.recon.result.snapshot import Snapshot
from tests.bench.quality import known_surfaces
from tests.bench.quality.held_out import Case, Folders, Scoring, load_case, parsed, parser_of
from tests.bench.quality.known_surfaces import KnownSurfaces
from tests.bench.quality.unfounded import Covered, covered, footing
from tests.bench.quality.viewpoints import viewpoints

BUILT_IN = "built-in"
CASES = (
    "built-in:6",
    "fountain_p11:6",
    "llff_fern:6",
    "llff_flower:6",
    "sceaux:6",
    "fox:6",
    "tum_fr3_office:6",
    "castle_p30:6",
)
STEPS = 30  # of the search for a held-out view's pose: a quarter of the benchmark's, the same for all rows
SHOWN = 5  # one picture in so many viewpoints
NEEDLE, FLOATER, BOTH = (255, 0, 0), (0, 255, 0), (255, 255, 0)


@dataclass(frozen=True)
class Row:
    label: str
    scene: str
    views: int
    covered_pct: float  # of the pixels of all viewpoints
    needles_pct: float
    floaters_pct: float
    num_gaussians: int
    refinement_s: float  # of the processor
    psnr: float | None = None  # on held-out views
    ssim: float | None = None
    lpips: float | None = None


@dataclass(frozen=True, eq=False)
class Place:
    """What a scene is made of, and what is known of the place besides."""

    name: str
    views: int
    start: Start
    known: KnownSurfaces  # in the true world
    case: Case | None  # None: no held-out views


def recorded(name: str, folders: Folders) -> Place:
    case = load_case(name, folders)
    start = pickle.loads(case.start(folders))
    path = folders.starts / f"{case.scene.name}.surfaces"
    if not path.exists():
        registration, names = start.estimate.registration, start.estimate.graph.names
        assert registration is not None  # these photographs are published
        found = {names[camera.index]: camera.T_world_camera for camera in registration.cameras}
        to_true = aligned(found, {name: case.scene.cameras[name].T_world_camera for name in found})
        path.write_bytes(pickle.dumps(known_surfaces.of_photographs(case.scene, registration.points, to_true)))
    return Place(case.scene.name, len(case.split.train), start, pickle.loads(path.read_bytes()), case)


def built_in(views: int) -> Place:
    taken = synthetic.Config(views=views)
    start = find_start(list(synthetic.stream(taken)), preset("balanced"))
    return Place(BUILT_IN, views, start, known_surfaces.of_built_in(taken), None)


def aligned(cameras: Mapping[str, npt.NDArray[np.float64]], onto: Mapping[str, npt.NDArray[np.float64]]) -> Similarity:
    """The similarity that carries `cameras` onto those of the same names."""
    return align_cameras(np.stack(list(cameras.values())), np.stack([onto[name] for name in cameras]))


def finished(place: Place, config: ReconstructionConfig) -> tuple[Snapshot, float]:
    """The scene, and the processor seconds from its depth maps on."""
    began = time.process_time()
    *_, snapshot = continue_reconstruction(place.start, config)
    return snapshot, time.process_time() - began


def measured(label: str, place: Place, snapshot: Snapshot, seconds: float, pictures: Path | None) -> Row:
    """How much of the viewpoints' pixels is covered."""
    estimated = {camera.name: camera.T_world_camera for camera in snapshot.cameras}
    true = {name: place.known.views[name].T_world_camera for name in estimated}
    known = place.known.moved(aligned(true, estimated))
    gaussians = sanitize_gaussians(snapshot.gaussians)
    stands = footing(gaussians, known)
    shares = []
    for index, viewpoint in enumerate(viewpoints([known.views[name] for name in estimated])):
        found = covered(gaussians, stands, known, viewpoint)
        shares.append([float(mask.mean()) for mask in (found.either, found.needles, found.floaters)])
        if pictures is not None and index % SHOWN == 1:
            pictures.mkdir(parents=True, exist_ok=True)
            (pictures / f"{place.name}_{place.views}_{index:02d}_{label}.png").write_bytes(encode_png(marked(found)))
    of_pixels = (100 * np.mean(shares, axis=0)).round(3).tolist()
    return Row(label, place.name, place.views, *of_pixels, len(gaussians), round(seconds, 1))


def marked(found: Covered) -> npt.NDArray[np.uint8]:
    """(H, 2 W, 3) what is seen beside the same with the covered pixels painted."""
    seen = np.rint(np.clip(found.rgb, 0, 1) * 255).astype(np.uint8)
    painted = seen.copy()
    for mask, colour in ((found.either, BOTH), (found.needles, NEEDLE), (found.floaters, FLOATER)):
        painted[mask] = colour
    return np.ascontiguousarray(cv2.hconcat([seen, painted]), np.uint8)


def scored(row: Row, place: Place, snapshot: Snapshot, scoring: Scoring) -> Row:
    """With held-out figures, where there are held-out views."""
    if place.case is None:
        return row
    held_out = place.case.score(snapshot, "balanced", scoring)
    figures = {"psnr": held_out.psnr, "ssim": held_out.ssim, "lpips": held_out.lpips_alex}
    return Row(**asdict(row) | figures)


def main() -> None:
    parser = parser_of(__doc__, CASES)
    parser.add_argument("--label", required=True, help="of the rows, such as before and after a change")
    parser.add_argument("--only-seen", action="store_true", help="without what no two photographs confirm; not scored")
    parser.add_argument("--pictures", type=Path, help="folder for pictures of some viewpoints")
    arguments, folders, scoring = parsed(parser)
    scoring = Scoring(scoring.networks, Settings(alignment_steps=STEPS))
    config = preset("balanced")
    rows = [Row(**row) for row in json.loads(arguments.out.read_text())["rows"]] if arguments.out.exists() else []
    for name in arguments.cases or CASES:
        scene, _, views = name.partition(":")
        if (arguments.label, scene, int(views)) in {(row.label, row.scene, row.views) for row in rows}:
            continue
        place = built_in(int(views)) if scene == BUILT_IN else recorded(name, folders)
        snapshot, seconds = finished(place, config)
        if arguments.only_seen:
            rows.append(measured(arguments.label, place, remove_unconfirmed(snapshot), seconds, arguments.pictures))
        else:
            row = measured(arguments.label, place, snapshot, seconds, arguments.pictures)
            rows.append(scored(row, place, snapshot, scoring))
        print(json.dumps(asdict(rows[-1])), flush=True)
        content = {"command": "python -m tests.bench needles", "rows": [asdict(each) for each in rows]}
        arguments.out.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
