"""What other views see through is found; what only stands before them, or has another light, is not."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatnode.recon.priors import Pointmap
from splatnode.recon.scene.transients import find_transient_masks
from tests.support.synthetic import plane_pointmap

WIDTH, HEIGHT, DEPTH = 160, 120, 2.0
THING = np.zeros((HEIGHT, WIDTH), bool)
THING[40:80, 60:100] = True
WHOLE = np.ones((HEIGHT, WIDTH), bool)


def wall(step: float) -> list[Pointmap]:
    """Four cameras beside each other, `step` apart, before one wall."""
    found = []
    for number in range(4):
        T_world_camera = np.eye(4)
        T_world_camera[0, 3] = step * (number - 1.5)
        found.append(plane_pointmap(T_world_camera, width=WIDTH, height=HEIGHT, frame_id=number))
    return found


def photograph(pointmap: Pointmap) -> np.ndarray:
    """(H, W, 3) of the wall, which is painted smoothly."""
    x, y = pointmap.points[..., 0], pointmap.points[..., 1]
    colour = np.stack([np.sin(3 * x), np.sin(4 * y), np.sin(2 * x + 3 * y)], -1)
    return (128 + 60 * colour).astype(np.uint8)


def with_thing(pictures: list[np.ndarray], which: int = 1) -> list[np.ndarray]:
    changed = list(pictures)
    changed[which] = np.where(THING[..., None], np.uint8(250), changed[which])
    return changed


def unknown_there(pointmaps: list[Pointmap], which: int = 1) -> list[Pointmap]:
    """Stereo knows nothing of what one photograph alone shows."""
    changed = list(pointmaps)
    changed[which] = changed[which].apply_mask(~THING)
    return changed


def of(pointmaps: list[Pointmap], pictures: list[np.ndarray], used: np.ndarray = WHOLE) -> list[np.ndarray | None]:
    return find_transient_masks(pointmaps, pictures, [used] * len(pointmaps))


def test_a_thing_that_others_see_through_is_found_and_nothing_else():
    maps = wall(0.03)
    found = of(unknown_there(maps), with_thing([photograph(each) for each in maps]))
    assert [mask is None for mask in found] == [True, False, True, True]
    assert found[1][THING].mean() > 0.9 and found[1][~THING].mean() < 0.06


def test_depth_that_stereo_guessed_behind_the_thing_does_not_keep_it():
    maps = wall(0.03)
    assert of(maps, with_thing([photograph(each) for each in maps]))[1] is not None


def test_nothing_is_found_where_photographs_agree_or_where_there_are_two():
    maps = wall(0.03)
    pictures = [photograph(each) for each in maps]
    assert of(maps, pictures) == [None] * 4
    two = with_thing(pictures[:2])
    assert find_transient_masks(unknown_there(maps[:2]), two, [WHOLE] * 2) == [None, None]


def test_a_thing_that_may_stand_near_the_camera_stays():
    maps = wall(0.5)  # beside what the others see of the line of sight
    assert of(unknown_there(maps), with_thing([photograph(each) for each in maps])) == [None] * 4


def test_a_thing_of_which_two_views_know_the_depth_stays():
    maps = wall(0.03)
    near = [each.apply_mask(~THING) for each in maps]
    box = [plane_pointmap(each.T_world_camera, point=(0.0, 0.0, 1.0), width=WIDTH, height=HEIGHT) for each in maps]
    known = [
        replace(each, depth=np.where(THING, other.depth, each.depth)) for each, other in zip(near, box, strict=True)
    ]
    known = [replace(each, confidence=np.full_like(each.confidence, 0.8)) for each in known]
    pictures = [np.where(THING[..., None], np.uint8(250), photograph(each)) for each in maps]
    assert of(known, pictures) == [None] * 4


def test_what_a_mask_hides_is_not_asked():
    maps = wall(0.03)
    hidden = WHOLE.copy()
    hidden[35:85, 55:105] = False
    assert of(unknown_there(maps), with_thing([photograph(each) for each in maps]), hidden) == [None] * 4
