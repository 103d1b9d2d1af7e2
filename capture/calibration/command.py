"""`splatnode calibrate`: prints the board, or finds the lens of a camera that is shown it."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from splatnode.capture import film
from splatnode.capture.calibration.board import Board, board_page
from splatnode.capture.calibration.coverage import Coverage
from splatnode.capture.calibration.gathering import Gathering
from splatnode.capture.calibration.hold_out import Choice, choose
from splatnode.capture.calibration.lacking import (
    ENOUGH,
    GOOD,
    LEAST_VIEWS,
    TooLittle,
    describe_missing_coverage,
    describe_missing_views,
    describe_uncertainty,
)
from splatnode.capture.calibration.models import MODELS, Model
from splatnode.capture.calibration.other_board import explain_missing_board
from splatnode.capture.calibration.pdf import PAPERS, pdf_of
from splatnode.capture.calibration.report import describe_choice, lens_file
from splatnode.capture.config import Camera, CaptureConfig, camera_opener, is_live
from splatnode.capture.frame import DroppedFrame, Frame
from splatnode.capture.image_file import SUFFIXES
from splatnode.capture.lerobot.data_set import is_data_set
from splatnode.capture.process.config import load_config, merge_config, parse_changes, parse_config
from splatnode.capture.process.durable import write_atomically
from splatnode.capture.process.progress import ProgressStep, Tell, show_progress
from splatnode.capture.process.terminal import say
from splatnode.capture.reader import Reader, ReaderState
from splatnode.capture.recording import is_recording

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
    return parse_config(merge_config({"camera": _camera(source)}, parse_changes(changes)), CaptureConfig)


def _camera(source: Path) -> dict[str, Any]:
    """The camera's configuration. Raises ValueError where it is of no camera."""
    if source.suffix.lower() in SUFFIXES:
        raise ValueError(f"{source} is one photograph; give the folder of all that show the board")
    if not film.is_film(source) and not is_data_set(source):
        return {"kind": "folder", "folder": source}
    kind, told = film.camera(source)
    return {"kind": kind, **told}


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
