"""Which views are kept: tilted ones are no repeats, and of too many those that say most."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pytest

from splatnode.capture.cameras import folder, v4l2
from splatnode.capture.config import Camera, CaptureConfig
from splatnode.capture.frame import Frame
from splatnode.capture.reader import Config, Reader
from splatnode.extras.calibration import collect
from splatnode.extras.calibration.board import LEAST_CORNERS, Board, BoardView
from splatnode.extras.calibration.collect import (
    MOST_VIEWS,
    Gathering,
    TooLittle,
    add_view,
    create_coverage,
    describe_missing_coverage,
)
from splatnode.extras.calibration.estimate import MODELS, rotations

BOARD = Board()
WIDTH, HEIGHT, FOCAL = 1000, 750, 900.0
PICTURE = np.full((HEIGHT, WIDTH, 3), 128, np.uint8)
TILTS = ((0.0, 0.0), (20.0, 0.0), (-20.0, 0.0), (0.0, 20.0), (0.0, -20.0))


def shown(
    name: str, tilt: Sequence[float], place: tuple[float, float], share: float, right_end: float = WIDTH
) -> BoardView:
    """The board tilted by degrees, its middle at a place in the picture of whose width it takes a share."""
    distance = BOARD.columns * BOARD.square_mm * FOCAL / (share * WIDTH)
    middle = np.array([*(np.array(place) - (WIDTH / 2, HEIGHT / 2)) * distance / FOCAL, distance])
    turned = rotations(np.radians([[*tilt, 0.0][:3]]))[0]
    points = (BOARD.corners - BOARD.corners.mean(axis=0)) @ turned.T + middle
    pixels = FOCAL * points[:, :2] / points[:, 2:] + (WIDTH / 2, HEIGHT / 2)
    seen = ((pixels > 5) & (pixels < (right_end - 5, HEIGHT - 5))).all(axis=1)
    noise = np.random.default_rng(len(name)).normal(0, 0.05, pixels.shape)
    return BoardView(name, np.flatnonzero(seen), (pixels + noise)[seen])


def by_chance(count: int, left: int, tilted_from: int = 0) -> dict[str, BoardView]:
    """Views at random places; the first ones are in the picture's `left` half, or parallel to it, alone."""
    rng, found = np.random.default_rng(0), {}
    while len(found) < count:
        number = len(found)
        across = rng.uniform(120, 460) if number < left else rng.uniform(540 if left else 120, 880)
        about, degrees = rng.uniform(0, 2 * np.pi), rng.uniform(20, 45) * (number >= tilted_from)
        tilt = degrees * np.cos(about), degrees * np.sin(about), rng.uniform(-20, 20)
        place = across, rng.uniform(80, 670)
        view = shown(f"{number:03d}", tilt, place, 0.35, WIDTH / 2 if number < left else WIDTH)
        if len(view.ids) >= LEAST_CORNERS:
            found[view.name] = view
    return found


def frames(views: dict[str, BoardView], times: int) -> list[Frame]:
    names = [name for name in views for _ in range(times)]
    return [Frame(number, name, number, PICTURE, None) for number, name in enumerate(names)]


@pytest.fixture
def finding(monkeypatch: pytest.MonkeyPatch) -> Callable[[dict[str, BoardView]], None]:
    """Pictures show the views of their names, without being looked at."""

    def find(views: dict[str, BoardView]) -> None:
        monkeypatch.setattr(collect, "corner_finder", lambda board: lambda name, image: views[name])

    return find


def test_a_tilted_board_is_no_repetition_of_one_that_is_parallel_to_the_picture(finding):
    places = [(x, y) for x in (200.0, 500.0, 800.0) for y in (150.0, 375.0, 600.0)]
    views = [shown(f"{place} {tilt}", tilt, place, 0.5) for place in places for tilt in TILTS]
    repeated = [shown(f"again {place}", (1.0, 0.0), place, 0.5) for place in places]
    seen = {view.name: view for view in views + repeated}
    finding(seen)
    of_photographs = Gathering(BOARD, moving=False)
    assert [view for frame in frames(seen, 1) if (view := of_photographs.take(frame))] == views


def test_of_two_views_near_each_other_the_one_that_is_nearer_to_a_third_is_superfluous_unless_only_it_sees_a_cell():
    places = {"a": (500.0, 375.0), "b": (504.0, 375.0), "c": (512.0, 375.0), "low": (504.0, 640.0)}
    a, b, c, low = (shown(name, (0.0, 0.0), place, 0.3) for name, place in places.items())
    apart = np.array([[np.inf, 4.0, 12.0], [4.0, np.inf, 8.0], [12.0, 8.0, np.inf]])
    assert collect.find_redundant_view([a, b, c], apart, WIDTH, HEIGHT) == 1
    assert collect.find_redundant_view([a, low, c], apart, WIDTH, HEIGHT) == 0


def test_of_too_many_views_those_are_kept_that_see_all_that_was_seen(finding):
    views = by_chance(150, left=110)
    finding(views)
    of_photographs = Gathering(BOARD, moving=False)
    for frame in frames(views, 1):
        of_photographs.take(frame)
    assert len(of_photographs.views) == MOST_VIEWS < of_photographs.kept and of_photographs.is_full
    seen = create_coverage(WIDTH, HEIGHT)
    for view in of_photographs.views:
        seen = add_view(seen, view)
    coverage = of_photographs.coverage
    assert (
        coverage is not None
        and np.array_equal(seen.seen, coverage.seen)
        and describe_missing_coverage(coverage) is None
    )


class FromFrames:
    """Stands in for the opening of a camera."""

    def __init__(self, items: list[Frame]) -> None:
        self.items = items
        self.given = 0

    def __call__(self, camera: Camera, body_mask: Path | None) -> Callable[[], Iterator[Frame]]:
        return self._frames

    def _frames(self) -> Iterator[Frame]:
        for item in self.items:
            self.given += 1
            yield item


def focal_by(monkeypatch: pytest.MonkeyPatch, opened: FromFrames, live: bool) -> float:
    monkeypatch.setattr(collect, "camera_opener", opened)
    monkeypatch.setattr(collect, "is_live", lambda camera: live)
    monkeypatch.setattr(collect, "Reader", lambda opener, _live, config: Reader(opener, False, config))
    camera = Camera("v4l2", v4l2.Config()) if live else Camera("folder", folder.Config(Path("photographs")))
    config = CaptureConfig(camera, reader=Config())
    choice, _ = collect._calibrate_stream(config, BOARD, [MODELS["pinhole"]], None, lambda _: None)
    return choice.taken.estimate.lens.fx


LATE = pytest.mark.parametrize(
    "late", [{"left": 110}, {"left": 0, "tilted_from": 110}], ids=["the right side", "tilts"]
)


@LATE
def test_all_of_a_folder_is_looked_at(finding, monkeypatch, late):
    views = by_chance(200, **late)
    finding(views)
    opened = FromFrames(frames(views, 1))
    assert abs(focal_by(monkeypatch, opened, live=False) / FOCAL - 1) < 0.002 and opened.given == 200


@LATE
def test_a_camera_is_watched_until_enough_was_shown_and_no_longer(finding, monkeypatch, late):
    views = by_chance(300, **late)
    finding(views)
    monkeypatch.setattr(collect, "_TRY_EVERY", 50)
    opened = FromFrames(frames(views, 2))
    assert abs(focal_by(monkeypatch, opened, live=True) / FOCAL - 1) < 0.003 and 220 < opened.given < 400


def test_a_camera_that_never_shows_what_is_missing_is_not_watched_for_ever(finding, monkeypatch):
    views = by_chance(200, left=0, tilted_from=200)
    finding(views)
    monkeypatch.setattr(collect, "_GIVEN_UP", MOST_VIEWS + 10)
    monkeypatch.setattr(collect, "_TRY_EVERY", 50)
    opened = FromFrames(frames(views, 2))
    with pytest.raises(TooLittle, match="Tilt"):
        focal_by(monkeypatch, opened, live=True)
    assert opened.given < 350
