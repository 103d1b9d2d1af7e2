"""Where two scenes overlap, the better one keeps the place, without holes and without veils."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.recon.merging import (
    NOBODY,
    REGION_PX,
    Submap,
    measure_visibility,
    merge_submaps,
    owners,
    place_submap,
    regions,
    resolve_seams,
    surface_views,
)
from splatnode.recon.result.export.limits import select_gaussians
from splatnode.recon.result.levels_of_detail import concatenate_gaussians
from splatnode.recon.result.rendering import render_arrays
from tests.support.walk import WalkScene, walk, without


def submaps() -> list[Submap]:
    return [place_submap(s.scene_id, "OK", s.gaussians, s.cameras, s.placement) for s in walk()]


def of(scene: WalkScene, gaussians) -> Submap:
    return place_submap(
        scene.scene_id, "OK", scene.placement.inverse().transform_gaussians(gaussians), scene.cameras, scene.placement
    )


def shown(gaussians, camera):
    return render_arrays(
        gaussians, camera.T_world_camera, camera.K, camera.width, camera.height, channels=("rgb", "depth")
    )


def stays_of(parts: list[Submap]):
    """(means, shell or not) of what stays of each."""
    return [
        (each.gaussians.means[mask], each.shell[mask]) for each, mask in zip(parts, resolve_seams(parts), strict=True)
    ]


def test_shells_are_told_from_surfaces():
    for part, scene in zip(submaps(), walk(), strict=True):
        assert (part.shell == (scene.gaussians.source_frame == -1)).all() and part.shell.sum() > 600


def test_what_both_have_stays_with_the_one_that_sees_it_better():
    (first, first_shell), (second, second_shell) = stays_of(submaps())
    first, second = first[~first_shell], second[~second_shell]
    seen_by_both = (1.3, 1.7)  # by all cameras' images well inside

    def between(means):
        return int(((means[:, 0] > seen_by_both[0]) & (means[:, 0] < seen_by_both[1]) & (abs(means[:, 1]) < 0.3)).sum())

    assert between(first) == 0 and between(second) > 70
    assert (first[:, 0] < 0.9).sum() == 18 * 24  # what only the first has is all there


def test_a_shell_does_not_hang_before_what_another_scene_sees():
    (first, first_shell), _ = stays_of(submaps())
    parts = submaps()
    views = surface_views(parts[1].gaussians, parts[1].shell, parts[1].cameras)
    before = parts[0].gaussians.means[parts[0].shell]
    assert (measure_visibility(views, before).before > 0).any()  # it does to begin with
    assert not (measure_visibility(views, first[first_shell]).before > 0).any()


def test_a_scene_without_a_shell_is_merged_too():
    parts = [replace(each, shell=np.zeros(len(each.gaussians), bool)) for each in submaps()]
    assert [mask.shape for mask in resolve_seams(parts)] == [(len(each.gaussians),) for each in parts]
    bare = [replace(each, gaussians=select_gaussians(each.gaussians, ~part.shell), shell=each.shell[~part.shell])
            for each, part in zip(parts, submaps(), strict=True)]  # fmt: skip
    assert all(mask.any() for mask in resolve_seams(bare))


def test_nothing_goes_where_the_better_scene_has_a_hole():
    one, two = submaps()
    holed = of(walk()[1], without(two.gaussians, 1.35, 1.65))
    (first, shell), _ = stays_of([one, holed])
    first = first[~shell]
    in_the_hole = (first[:, 0] > 1.42) & (first[:, 0] < 1.58) & (abs(first[:, 1]) < 0.3)
    assert in_the_hole.sum() >= 2 * 12


def test_no_hole_opens_for_any_camera():
    parts = submaps()
    together = concatenate_gaussians(
        [select_gaussians(each.gaussians, mask) for each, mask in zip(parts, resolve_seams(parts), strict=True)]
    )
    for part in parts:
        for camera in part.cameras:
            alone, now = shown(part.gaussians, camera), shown(together, camera)
            assert now.alpha.min() > alone.alpha.min() - 0.05
            on_the_wall = np.abs(alone.depth - (1.0 - camera.T_world_camera[2, 3])) < 0.02
            assert on_the_wall.mean() > 0.4 and np.abs(now.depth - alone.depth)[on_the_wall].max() < 0.1


def test_a_scene_alone_keeps_everything():
    (part,) = submaps()[:1]
    assert resolve_seams([part])[0].all()
    same = merge_submaps([part])
    assert len(same.gaussians) == len(part.gaussians) and same.shares[0].kept == (~part.shell).sum()


def test_merged_looks_from_every_camera_as_its_own_scene_did():
    parts = submaps()
    one = merge_submaps(parts)
    assert len(one.gaussians) < 0.85 * sum(len(part.gaussians) for part in parts)
    assert [camera.name for camera in one.cameras] == [f"{n}.png" for n in range(6)]  # each photograph once
    assert all(camera.bounds is None for camera in one.cameras)
    for camera in one.cameras:
        own = parts[0] if camera.frame_id < 4 else parts[1]
        before = next(each for each in own.cameras if each.name == camera.name)
        error = np.mean((shown(one.gaussians, camera).rgb - shown(own.gaussians, before).rgb) ** 2)
        assert -10 * np.log10(error) > 30.0


def test_a_limit_is_kept_and_costs_what_is_missed_least():
    parts = submaps()
    few = merge_submaps(parts, most=900)
    assert len(few.gaussians) <= 900 and few.shell <= 90
    middle = few.cameras[2]
    assert (shown(few.gaussians, middle).alpha > 0.5).mean() > 0.95


def test_nothing_cannot_be_merged():
    with pytest.raises(ValueError, match="at least one"):
        merge_submaps([])


def test_regions_follow_the_resolution():
    points = np.array([[0.1, 0.1, 0.1], [0.9, 0.1, 0.1], [0.1, 0.1, 0.1], [0.9, 0.1, 0.1], [5.0, 5.0, 5.0]])
    resolution = np.array([REGION_PX, REGION_PX, 2 * REGION_PX, 2 * REGION_PX, 0.0])
    coarse, also_coarse, fine, other_fine, unseen = regions(points, resolution)
    assert coarse == also_coarse and fine != other_fine  # sides of 1 and of 1/2
    assert len({coarse, fine, other_fine, unseen}) == 4


def test_a_region_belongs_to_whom_sees_it_best_in_the_mean():
    region = np.array([0, 0, 1, 2])
    quality = np.array([[1.0, 5.0], [3.0, 0.0], [1.0, 2.0], [0.0, 0.0]])
    assert owners(region, quality).tolist() == [1, 1, 1, NOBODY]
