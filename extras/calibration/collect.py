"""`splatnode calibrate`: prints the board, or finds the lens of a camera that is shown it."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
import yaml

from splatnode.capture import film
from splatnode.capture.config import Camera, CaptureConfig, camera_opener, is_live
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.image_file import SUFFIXES
from splatnode.capture.process.config import load_config, parse_changes, parse_layers
from splatnode.capture.process.files import write_atomically
from splatnode.capture.process.terminal import ProgressStep, Tell, say, show_progress
from splatnode.capture.reader import Reader, ReaderState
from splatnode.capture.recording import is_recording
from splatnode.extras.calibration.board import (
    LEAST_CORNERS,
    PAPERS,
    Board,
    BoardView,
    board_page,
    corner_finder,
    explain_missing_board,
    pdf_of,
)
from splatnode.extras.calibration.estimate import MODELS, Choice, Estimate, Model, choose, pixel_sigmas
from splatnode.extras.lerobot import is_data_set

# Where in the picture the board was seen, on a grid of cells that are nearly square.

_COLUMNS = 10  # of the grid along the picture's longer side
_DARK = 12.0  # grey levels, of a cell's mean: what is never lighter is no picture, as beyond a fisheye's circle
_AT_CORNER = 2  # cells to each side, in which the board is to be seen near a corner of the picture
CORNERS = {"upper left": (0, 0), "upper right": (1, 0), "lower left": (0, 1), "lower right": (1, 1)}


@dataclass(frozen=True, eq=False)
class Coverage:
    width: int  # of the pictures, pixels
    height: int  # likewise, pixels
    seen: npt.NDArray[np.bool_]  # (R, C) whether a corner of the board was seen in the cell
    lightest: npt.NDArray[np.float64]  # (R, C) mean grey level of the cell in the picture where it was lightest

    @property
    def picture_mask(self) -> npt.NDArray[np.bool_]:  # (R, C)
        """Returns the mask of cells with a picture. Where the board was seen, there is one."""
        return (self.lightest > _DARK) | self.seen

    @property
    def share(self) -> float:
        """Returns the share of the cells with a picture in which the board was seen."""
        return float(self.seen.sum() / max(1, self.picture_mask.sum()))

    @property
    def open_corners(self) -> tuple[str, ...]:
        """The picture's corners near which the board was not seen, though there is a picture."""
        near = {name: (_end(y, _AT_CORNER), _end(x, _AT_CORNER)) for name, (x, y) in CORNERS.items()}
        return tuple(
            name for name, cells in near.items() if self.picture_mask[cells].any() and not self.seen[cells].any()
        )

    @property
    def outermost(self) -> npt.NDArray[np.float64]:  # (4, 2)
        """The pixels nearest to the picture's corners where there is a picture, in the order of CORNERS."""
        middle = np.array([self.width, self.height]) / 2
        steps = np.linspace(1.0, 0.0, 4 * _COLUMNS + 1)[:, None]
        found = []
        for x, y in CORNERS.values():
            way = middle + steps * ((x * self.width, y * self.height) - middle)
            rows, columns = _cells(way, self.width, self.height, self.seen.shape)
            found.append(way[int(np.argmax(self.picture_mask[rows, columns]))])
        return np.array(found)

    @property
    def text_rows(self) -> list[str]:
        """A line a row of cells: # where the board was seen, . where not yet, a blank where there is no picture."""
        signs = np.where(self.seen, "#", np.where(self.picture_mask, ".", " "))
        return ["".join(row) for row in signs]


def create_coverage(width: int, height: int) -> Coverage:
    """Creates the coverage of pictures of this size, before the first."""
    cell = max(width, height) / _COLUMNS
    shape = max(1, round(height / cell)), max(1, round(width / cell))
    return Coverage(width, height, np.zeros(shape, bool), np.zeros(shape))


def add_picture(coverage: Coverage, image: npt.NDArray[np.uint8]) -> Coverage:
    """And the light of a picture (H, W, 3), whether or not it shows the board."""
    rows, columns = coverage.seen.shape
    mean = cv2.resize(image, (columns, rows), interpolation=cv2.INTER_AREA).astype(np.float64).mean(axis=-1)
    return replace(coverage, lightest=np.maximum(coverage.lightest, mean))


def add_view(coverage: Coverage, view: BoardView) -> Coverage:
    """And the corners of a view."""
    seen = coverage.seen.copy()
    seen[_cells(view.pixels, coverage.width, coverage.height, seen.shape)] = True
    return replace(coverage, seen=seen)


def _cells(pixels: npt.NDArray, width: int, height: int, shape: tuple[int, ...]) -> tuple[npt.NDArray, npt.NDArray]:
    rows = np.clip((pixels[:, 1] * shape[0] / height).astype(int), 0, shape[0] - 1)
    return rows, np.clip((pixels[:, 0] * shape[1] / width).astype(int), 0, shape[1] - 1)


def _end(far: int, cells: int) -> slice:
    return slice(-cells, None) if far else slice(0, cells)


# What views of the board do not suffice for, each as a sentence that says what to do.

LEAST_VIEWS = 10
_LEAST_SHARE = 0.75  # of the picture's cells
_TILTED_DEG = 15.0  # the board must be tilted by more in a third of the views, else they say little of the focal length
_LARGEST_RMS = 0.0012  # of the longer side: corners that are farther from where a lens has them are not of this board


@dataclass(frozen=True)
class Limits:
    """The limits of what is good enough; standard deviations."""

    focal: float  # relative
    corner: float  # of where the picture's corners are seen, as a share of its longer side


ENOUGH = Limits(focal=0.003, corner=0.0008)  # .8 pixels of a picture of 1000: a lens is written
GOOD = Limits(focal=0.0005, corner=0.00015)  # more views are not waited for


class TooLittle(ValueError):
    """Views that give no lens: the text says what is missing."""

    exit_code = 65


def describe_missing_views(views: int, pictures: int, moving: bool) -> str | None:
    if views >= LEAST_VIEWS:
        return None
    show, own = ("shows", "its own") if views == 1 else ("show", "their own")
    still = ", held still for a moment" if moving else ""
    return (
        f"{LEAST_VIEWS} pictures that show the board are needed; {views} of {pictures} {show} it, from a place and "
        f"at a tilt of {own}{still}"
    )


def describe_missing_coverage(coverage: Coverage) -> str | None:
    if coverage.open_corners:
        return (
            f"the board was never seen near the picture's corner {' and '.join(coverage.open_corners)}: the lens bends "
            "most there. Hold it so that it reaches beyond the picture's border"
        )
    if coverage.share < _LEAST_SHARE:
        return (
            f"the board was seen in {coverage.share:.0%} of the picture, and {_LEAST_SHARE:.0%} is needed: show it "
            "where the grid has dots"
        )
    return None


def describe_uncertainty(estimate: Estimate, coverage: Coverage, limits: Limits) -> list[str]:
    """Lists what the estimate does not know well enough."""
    longer, tilts = max(estimate.lens.width, estimate.lens.height), estimate.tilts_deg
    if not estimate.rms_px <= _LARGEST_RMS * longer:
        return [
            f"the corners are {estimate.rms_px:.2f} pixels from where any lens would show them, and "
            f"{_LARGEST_RMS * longer:.2f} is the most: another board than was given, one that is not flat, or blurred "
            "pictures"
        ]
    found = []
    flat = float(np.quantile(tilts, 2 / 3)) < _TILTED_DEG
    if not estimate.focal_sigma <= limits.focal or flat:
        how = "parallel to the picture, or nearly so, in most views" if flat else "tilted too little or too seldom"
        found.append(
            f"the focal length is known to {100 * min(estimate.focal_sigma, 9.99):.2f} %: the board was {how}. Tilt "
            "it by 20 to 45 degrees, to the left, to the right, forwards and backwards"
        )
    sigmas = pixel_sigmas(estimate, coverage.outermost)
    worst = int(np.argmax(np.where(np.isfinite(sigmas), sigmas, np.inf)))
    if not sigmas[worst] <= limits.corner * longer:
        known = f"to {sigmas[worst]:.2f} pixels" if np.isfinite(sigmas[worst]) else "not at all"
        found.append(
            f"at the picture's corner {list(CORNERS)[worst]} the lens is known {known}, and "
            f"{limits.corner * longer:.2f} is needed: show the board there, tilted, in more views"
        )
    return found


# Which of too many views says least that others do not say, too.


def find_redundant_view(views: Sequence[BoardView], apart: npt.NDArray[np.float64], width: int, height: int) -> int:
    """The number of the view to do without: all of its cells of the picture are seen in others, too.

    Of such views it is the one that lies nearest to another, and of these two the one that has the nearer second
    neighbour. `apart` (V, V) says how far views lie from one another, and is infinite on the diagonal. There must be
    more views than the grid of `coverage` has cells: then not each can have a cell of its own.
    """
    cells = np.array([add_view(create_coverage(width, height), view).seen for view in views])
    own = (cells & (cells.sum(axis=0) == 1)).any(axis=(1, 2))
    spare = np.flatnonzero(~own)
    nearest, second = np.sort(apart[spare], axis=1)[:, :2].T
    return int(spare[np.lexsort((second, nearest))[0]])


# The views of the board that are kept of what a camera sees.

MOST_VIEWS = 100  # no fewer than the grid of `coverage` has cells
_STILL = 0.003  # of the longer side: a board that moved by more since the last picture may be smeared
_REPEATED = 0.01  # of the longer side: a view with nearly all corners nearer to those of another says nothing new
_HALF, _NEARLY_ALL = 0.5, 0.9  # of the corners: a tilt moves those at the board's ends, hardly those about its middle
_UNSEEN = 4  # pictures without the board that are kept, to find out why


class Gathering:
    """Takes pictures one at a time. Of a `moving` board only views are kept in which it was held still.

    Of more than MOST_VIEWS those are kept that see all that was seen, and lie farthest apart.
    """

    def __init__(self, board: Board, moving: bool) -> None:
        self.board, self.moving = board, moving
        self.pictures = 0
        self.views: list[BoardView] = []
        self.kept = 0  # views so far, with those that gave way to others
        self.coverage: Coverage | None = None  # before the first picture there is none
        self.unseen: list[npt.NDArray[np.uint8]] = []
        self._find = corner_finder(board)
        self._first = ""
        self._last: BoardView | None = None
        self._apart = np.empty((0, 0))  # (V, V) of the views, pixels; infinite on the diagonal

    @property
    def is_full(self) -> bool:
        """Whether a further view is only kept in place of another."""
        return len(self.views) == MOST_VIEWS

    def take(self, frame: Frame) -> BoardView | None:
        """The view, where it is kept. Raises TooLittle where the picture is not as large as those before."""
        self.coverage = self._same_size(frame)
        self.pictures += 1
        self.coverage = add_picture(self.coverage, frame.image)
        view, before = self._find(frame.name, frame.image), self._last
        self._last = view
        if view is None:
            if len(self.unseen) < _UNSEEN:
                self.unseen.append(frame.image)
            return None
        longer = max(frame.width, frame.height)
        if self.moving and (before is None or _compute_displacements(view, [before], _HALF)[0] > _STILL * longer):
            return None
        apart = _compute_displacements(view, self.views, _NEARLY_ALL)
        if (apart < _REPEATED * longer).any():
            return None
        return self._keep(view, apart, self.coverage)

    def _keep(self, view: BoardView, apart: npt.NDArray[np.float64], coverage: Coverage) -> BoardView | None:
        """The view, unless of all of them it is the one that says least."""
        self.views.append(view)
        self._apart = np.block([[self._apart, apart[:, None]], [apart[None], np.full((1, 1), np.inf)]])
        if len(self.views) > MOST_VIEWS:
            out = find_redundant_view(self.views, self._apart, coverage.width, coverage.height)
            self._apart = np.delete(np.delete(self._apart, out, axis=0), out, axis=1)
            if self.views.pop(out) is view:
                return None
        self.kept += 1
        self.coverage = add_view(coverage, view)  # what gave way was seen in others, too
        return view

    def _same_size(self, frame: Frame) -> Coverage:
        if self.coverage is None:
            self._first = frame.name
            return create_coverage(frame.width, frame.height)
        size = self.coverage.width, self.coverage.height
        if size != (frame.width, frame.height):
            raise TooLittle(
                f"pictures must be of one size: {self._first} has {size[0]} x {size[1]} pixels, {frame.name} has "
                f"{frame.width} x {frame.height}. Use one camera with one setting, and do not turn it upright"
            )
        return self.coverage


def _compute_displacements(
    view: BoardView, others: Sequence[BoardView], share: float
) -> npt.NDArray[np.float64]:  # (V,)
    """How far this share of corners is from those of each other at most, pixels; infinite where too few are in both."""
    numbers = 1 + max(int(each.ids.max()) for each in (view, *others))
    places = np.full((len(others), numbers, 2), np.nan)
    for place, other in zip(places, others, strict=True):
        place[other.ids] = other.pixels
    off = np.sort(np.linalg.norm(places[:, view.ids] - view.pixels, axis=-1), axis=1)  # what is not in both is last
    common = np.isfinite(off).sum(axis=1)
    last = np.maximum(np.ceil(share * common).astype(int) - 1, 0)
    return np.where(common < LEAST_CORNERS, np.inf, off[np.arange(len(others)), last])


# What was found: lines for whoever calibrates, and the file that the other verbs read.

_HEAD = """\
# A lens, as splatnode calibrate found it. The verbs read `intrinsics`: splatnode replay photos --intrinsics FILE, and
# splatnode capture camera.yaml --intrinsics FILE. `calibration` is for people: how well it is known.
"""
_SQUARE = 0.002  # fx and fy of nearly all cameras differ by less
_SURE = 3.0  # standard deviations


def lens_file(choice: Choice, coverage: Coverage, board: Board) -> str:
    """The YAML, which `capture.lenses` reads."""
    estimate = choice.taken.estimate
    lens, sigmas = estimate.lens, np.sqrt(np.diag(estimate.covariance))
    corners = pixel_sigmas(estimate, coverage.outermost)
    intrinsics = {
        "width": lens.width,
        "height": lens.height,
        **{name: round(getattr(lens, name), 4) for name in ("fx", "fy", "cx", "cy")},
        "model": lens.model,
        "distortion": [float(f"{term:.8g}") for term in lens.distortion],
        "source": lens.source,
    }
    calibration: dict[str, Any] = {
        "model": estimate.model.name,
        "board": {
            "columns": board.columns,
            "rows": board.rows,
            "square_mm": board.square_mm,
            "marker_mm": board.marker_mm,
            "dictionary": board.dictionary,
        },
        "views": len(estimate.names),
        "corners": len(estimate.corners.view),
        "corners_left_out": estimate.left_out,
        "residual_px": round(estimate.rms_px, 4),
        "held_out_px": {trial.estimate.model.name: _round_digits(trial.validation_rms_px) for trial in choice.trials},
        "sigma": {
            **{name: _round_digits(sigma) for name, sigma in zip(("fx", "fy", "cx", "cy"), sigmas[:4], strict=True)},
            "distortion": [_round_digits(sigma) for sigma in sigmas[4:]],
        },
        "corner_sigma_px": {name: _round_digits(sigma) for name, sigma in zip(CORNERS, corners, strict=True)},
        "tilt_deg": [round(float(end), 1) for end in (estimate.tilts_deg.min(), estimate.tilts_deg.max())],
        "distance_mm": [round(float(end)) for end in (estimate.distances_mm.min(), estimate.distances_mm.max())],
        "covered_percent": round(100 * coverage.share),
    }
    content = {"intrinsics": intrinsics, "calibration": calibration}
    grid = [f'  - "{line}"' for line in coverage.text_rows]
    return "\n".join(
        [
            _HEAD + yaml.safe_dump(content, sort_keys=False, default_flow_style=None, width=110).rstrip(),
            "  covered: # the picture: # where the board was seen, . where not, blank where there is no picture",
            *grid,
            "",
        ]
    )


def describe_choice(choice: Choice, coverage: Coverage) -> list[str]:
    """The lines for whoever calibrates."""
    estimate = choice.taken.estimate
    lens, sigmas = estimate.lens, np.sqrt(np.diag(estimate.covariance))
    numbers = ", ".join(
        f"{name} {value:.2f} ± {sigma:.2f}"
        for name, value, sigma in zip(
            ("fx", "fy", "cx", "cy"), (lens.fx, lens.fy, lens.cx, lens.cy), sigmas, strict=False
        )
    )
    tilts, distances = estimate.tilts_deg, estimate.distances_mm
    worst = float(np.max(pixel_sigmas(estimate, coverage.outermost)))
    trials = ", ".join(f"{trial.estimate.model.name} {trial.validation_rms_px:.3f}" for trial in choice.trials)
    lines = [
        f"{estimate.model.name} ({estimate.model.description}) from {len(estimate.names)} views: {numbers} pixels",
        f"corners are {estimate.rms_px:.3f} pixels (rms) from where this lens shows them; in views that were held out: "
        f"{trials}",
        f"the picture's corners are known to {worst:.2f} pixels (standard deviation), the focal length to "
        f"{100 * estimate.focal_sigma:.3f} %",
        f"the board was seen in {coverage.share:.0%} of the picture, tilted by {tilts.min():.0f} to {tilts.max():.0f} "
        f"degrees, {distances.min():.0f} to {distances.max():.0f} mm away",
    ]
    return [*lines, *_warnings(estimate)]


def _warnings(estimate: Estimate) -> list[str]:
    lens = estimate.lens
    by_focal = np.array([1 / lens.fx, -1 / lens.fy])
    sigma = float(np.sqrt(by_focal @ estimate.covariance[:2, :2] @ by_focal))  # of fx / fy, relative
    apart = abs(lens.fx / lens.fy - 1)
    if apart > max(_SQUARE, _SURE * sigma):
        return [
            f"fx and fy differ by {100 * apart:.1f} %, and in nearly all cameras they do not: was the board printed as "
            "wide as high? Measure ten squares across and down"
        ]
    return []


def _round_digits(value: float) -> float:
    """Three digits are enough of what says how well something is known."""
    return float(f"{value:.3g}")


_FILMS = ("video", "mcap", "lerobot")  # cameras before which the board was moved
_OF_AN_END = ("folder", *_FILMS)  # cameras of which all is looked at; others are left once the lens is known
_TRY_EVERY, _TRY_FULL = 4, 20  # views: a lens is looked for so often while more come, and once they replace others
_GIVEN_UP = 300  # views: where a camera showed so many, everywhere, and the lens is not known, more would not help
_POLL_S = 0.1


def calibrate(args: argparse.Namespace) -> int:
    """Writes the board or the lens. Raises TooLittle, with what is missing; ValueError, OSError, CameraUnavailable."""
    board = Board(args.columns, args.rows, args.square_mm, args.marker_mm or 19 / 26 * args.square_mm, args.dictionary)
    if args.board is not None:
        return _print_board(args, board)
    if args.source is None or args.out is None:
        raise ValueError(
            "give a camera's configuration, a folder of photographs, a recording or a video, and --out lens.yaml; or "
            "--board board.pdf, to print the board first"
        )
    _check_free(args.out)
    config = _config(args.source, args.set)
    models = list(MODELS.values()) if args.model == "auto" else [MODELS[args.model]]
    with show_progress() as tell:
        choice, coverage = _calibrate_stream(config, board, models, args.seconds, tell)
    write_atomically(args.out, [lens_file(choice, coverage, board).encode()])
    for line in describe_choice(choice, coverage):
        say(line)
    say(f"written to {args.out}; use it by: splatnode replay photographs --intrinsics {args.out} --out out")
    return 0


def _print_board(args: argparse.Namespace, board: Board) -> int:
    if args.source is not None:
        raise ValueError("give --board to print the board, or a source to calibrate by it, not both")
    _check_free(args.board)
    write_atomically(args.board, [pdf_of([board_page(board, PAPERS[args.paper])], f"ChArUco board, {board}")])
    say(
        f"written to {args.board}: print it at 100 % on {args.paper}, glue it to something flat, and measure a square; "
        f"where it is not {board.square_mm:g} mm wide, calibrate with --square-mm"
    )
    return 0


def _check_free(path: Path) -> None:
    if path.exists():
        raise ValueError(f"{path} is there already; give another name, or remove it")
    if not path.parent.is_dir():
        raise ValueError(f"there is no folder {path.parent}; make it first")


def _config(source: Path, changes: list[str]) -> CaptureConfig:
    """Loads the configuration: a folder, a recording and a film need none."""
    if source.suffix.lower() in (".yaml", ".yml"):
        return load_config(source, CaptureConfig, changes)
    return parse_layers([{"camera": _camera(source)}, parse_changes(changes)], CaptureConfig)


def _camera(source: Path) -> dict[str, Any]:
    """The camera's configuration. Raises ValueError where it is of no camera."""
    if source.suffix.lower() in SUFFIXES:
        raise ValueError(f"{source} is one photograph; give the folder of all that show the board")
    if not film.is_film(source) and not is_data_set(source):
        return {"kind": "folder", "folder": source}
    kind, camera_config = film.camera(source)
    return {"kind": kind, **camera_config}


def _is_moving(camera: Camera) -> bool:
    """Whether the board is waved before the camera, or was; else each picture was taken with care."""
    recorded = camera.kind == "folder" and is_recording(camera.config.folder)
    return is_live(camera) or camera.kind in _FILMS or recorded


def _calibrate_stream(
    config: CaptureConfig, board: Board, models: list[Model], seconds: float | None, tell: Tell
) -> tuple[Choice, Coverage]:
    """The lens, once it is known well, or well enough where further views only replace others; or from all there is."""
    camera = config.camera
    gathering = Gathering(board, _is_moving(camera))
    tried, drawn = 0, []
    with Reader(camera_opener(camera, config.body_mask), is_live(camera), config.reader) as reader:
        for frame in _frames(reader, seconds, tell):
            taken = gathering.take(frame)
            tell(ProgressStep("looking for the board", len(gathering.views), 0, "view"))
            views, coverage = gathering.views, gathering.coverage
            if taken is None or coverage is None:
                continue
            if gathering.moving and coverage.text_rows != drawn:
                drawn = coverage.text_rows
                _draw(coverage, tell)
            pause = _TRY_FULL if gathering.is_full else _TRY_EVERY
            ready = gathering.kept >= max(LEAST_VIEWS, tried + pause) and describe_missing_coverage(coverage) is None
            if ready and camera.kind not in _OF_AN_END:
                tried = gathering.kept
                tell(ProgressStep("looking for the lens", 0, 0, ""))
                choice = choose(views, board, coverage.width, coverage.height, models)
                limits = ENOUGH if gathering.is_full else GOOD
                wanted = [] if choice is None else describe_uncertainty(choice.taken.estimate, coverage, limits)
                if choice is not None and not wanted:
                    return choice, coverage
                if gathering.is_full and (choice is None or gathering.kept >= _GIVEN_UP):
                    break
                for sentence in wanted:
                    tell(f"{len(views)} views: {sentence}")
    return _calibrate_views(gathering, models, tell)


def _frames(reader: Reader, seconds: float | None, tell: Tell) -> Iterator[Frame]:
    """Until the camera ends, or for so long; what cannot be read is said."""
    ends_s = None if seconds is None else time.monotonic() + seconds
    while reader.state is not ReaderState.FINISHED and (ends_s is None or time.monotonic() < ends_s):
        item = reader.next(_POLL_S)
        if isinstance(item, DroppedFrame):
            tell(f"{item.name} is left out: {item.reason}")
        elif item is not None:
            yield item


def _calibrate_views(gathering: Gathering, models: list[Model], tell: Tell) -> tuple[Choice, Coverage]:
    """The lens of what there is. Raises TooLittle, with all that is missing."""
    views, coverage = gathering.views, gathering.coverage
    if coverage is None:
        raise TooLittle("no picture came; is the camera there, and the folder the right one?")
    if not views and gathering.unseen:
        raise TooLittle(
            f"none of {gathering.pictures} pictures shows the board ({gathering.board}): "
            f"{explain_missing_board(gathering.unseen, gathering.board)}"
        )
    few = describe_missing_views(len(views), gathering.pictures, gathering.moving)
    missing = [sentence for sentence in (few, describe_missing_coverage(coverage)) if sentence]
    choice = None
    if len(views) >= LEAST_VIEWS:
        tell(ProgressStep("looking for the lens", 0, 0, ""))
        choice = choose(views, gathering.board, coverage.width, coverage.height, models)
        if choice is None:
            missing.append("no lens explains the views: another board than was given, or one that is not flat")
        else:
            missing += describe_uncertainty(choice.taken.estimate, coverage, ENOUGH)
    _draw(coverage, tell)
    if missing or choice is None:
        raise TooLittle("no lens yet:\n" + "\n".join(f"- {sentence}" for sentence in missing))
    return choice, coverage


def _draw(coverage: Coverage, tell: Tell) -> None:
    tell("the picture: # where the board was seen, . where not yet")
    for line in coverage.text_rows:
        tell(f"  |{line}|")
