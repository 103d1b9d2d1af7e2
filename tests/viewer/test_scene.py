"""What the viewer knows of a scene: who sees what, colours, where to go next, what it says. No window."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatnode.capture.frame import DroppedFrame
from splatnode.recon.result.export.limits import compute_base_rgb
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.result.verdict import Bounds, Code, Scale, Verdict, make_ball
from splatnode.viewer import session
from splatnode.viewer.analysis import (
    GOOD_ANGLE_DEG,
    UNKNOWN,
    Points,
    colour_gaussians,
    next_view,
    source_colour,
    support,
    surface_points,
)
from splatnode.viewer.state import Colouring, Moment, ViewerState, append_moment, look_at

K = np.array([[100.0, 0, 50], [0, 100.0, 40], [0, 0, 1]])
UP = np.array([0.0, -1.0, 0.0])


def camera(x: float, y: float = 0.0, z: float = 0.0, *, frame_id: int = 0, target=(0.0, 0.0, 1.0)) -> CameraEstimate:
    """A camera of 100 x 80 pixels that looks at `target`."""
    T_world_camera = look_at(np.array([x, y, z]), np.array(target), UP)
    return CameraEstimate(f"{frame_id}.png", frame_id, T_world_camera, K, 100, 80)


def wall(count: int = 41, depth: float = 1.0, half: float = 0.3, source: int = 0) -> GaussianArrays:
    """count^2 small flat Gaussians on a wall that faces the world's origin."""
    x, y = (axis.ravel() for axis in np.meshgrid(*2 * [np.linspace(-half, half, count)]))
    number = count * count
    return GaussianArrays(
        means=np.stack([x, y, np.full(number, depth)], 1).astype(np.float32),
        quats=np.tile(np.array([1, 0, 0, 0], np.float32), (number, 1)),
        scales=np.tile(np.array([half / count, half / count, 1e-4], np.float32), (number, 1)),
        opacities=np.full(number, 0.95, np.float32),
        sh=np.full((number, 1, 3), 0.5, np.float32),
        source_frame=np.full(number, source, np.int32),
    )


def together(*parts: GaussianArrays) -> GaussianArrays:
    names = ("means", "quats", "scales", "opacities", "sh", "source_frame")
    return GaussianArrays(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def moment(gaussians: GaussianArrays, *cameras: CameraEstimate, received_s: float = 0.0, **changes: object) -> Moment:
    verdict = Verdict(Code.OK, "All is well.", "", publishable=True)
    snapshot = Snapshot(1, verdict, cameras, gaussians, {}, (), 10)
    return Moment(replace(snapshot, **changes), received_s)


def test_what_hides_behind_a_wall_is_not_seen():
    front, back = wall(half=0.15), wall(depth=1.5, half=0.1)
    gaussians = together(front, back)
    aside = camera(1.5, frame_id=1, target=(0.0, 0.0, 1.5))
    found = support(gaussians, (camera(0.0), aside))
    number = len(front)
    assert (found.sizes[:number, 0] > 0).all() and (found.sizes[number:, 0] == 0).all()
    assert (found.sizes[number:, 1] > 0).mean() > 0.9
    assert found.sizes[0, 0] == pytest.approx(100.0, rel=1e-3)  # focal length over depth
    assert set(found.views[:number]) <= {1, 2} and set(found.best[number:]) <= {-1, 1}


def test_nothing_is_seen_of_nothing():
    assert support(GaussianArrays.empty(), (camera(0.0),)).sizes.shape == (0, 1)
    assert (support(wall(3), ()).best == -1).all()


def test_colours_say_what_they_mean():
    near, far = wall(5, depth=1.0, half=0.1, source=0), wall(5, depth=4.0, half=1.6, source=1)
    cameras = camera(0.0), camera(0.05, frame_id=1)
    there = moment(together(near, far), *cameras)
    seen = support(there.snapshot.gaussians, cameras)
    rgb = {colouring: compute_base_rgb(colour_gaussians(there, colouring, seen)) / 255.0 for colouring in Colouring}
    red, _, blue = rgb[Colouring.DEPTH][:25].mean(0)
    assert red > 2 * blue  # near is red
    assert np.allclose(rgb[Colouring.NORMAL][:25], [0.5, 0.5, 1.0], atol=0.01)  # it faces the cameras
    assert np.allclose(rgb[Colouring.SOURCE][:25], source_colour(0), atol=0.01)
    assert np.allclose(rgb[Colouring.SOURCE][25:], source_colour(1), atol=0.01)
    assert (rgb[Colouring.SUPPORT][seen.views == 0] == np.round(np.array(UNKNOWN) * 255) / 255).all()
    assert colour_gaussians(there, Colouring.PHOTOGRAPH, seen) is there.snapshot.gaussians


def test_a_file_without_sources_is_coloured_by_the_camera_that_sees_it_largest():
    cameras = camera(0.0), camera(0.0, z=0.5, frame_id=1)
    there = moment(replace(wall(9, half=0.1), source_frame=np.full(81, -1, np.int32)), *cameras)
    rgb = (
        compute_base_rgb(colour_gaussians(there, Colouring.SOURCE, support(there.snapshot.gaussians, cameras))) / 255.0
    )
    assert np.allclose(rgb, source_colour(1), atol=0.01)


def plane_points(cameras: tuple[CameraEstimate, ...], half: float = 0.3) -> Points:
    gaussians = wall(half=half)
    return surface_points(gaussians, cameras, support(gaussians, cameras))


def test_a_short_baseline_asks_for_a_step_aside():
    cameras = camera(-0.01, frame_id=0), camera(0.01, frame_id=1)
    advice = next_view(cameras, plane_points(cameras))
    assert advice.arrow is not None and advice.target is not None
    start, end = advice.arrow
    assert abs((end - start)[2]) < 0.5 * np.linalg.norm(end - start)  # sideways, not forwards
    ray = [(advice.target - centre) / np.linalg.norm(advice.target - centre) for centre in (start, end)]
    assert np.degrees(np.arccos(ray[0] @ ray[1])) > GOOD_ANGLE_DEG
    assert "100% of it is seen under less than 12°" in advice.sentence and advice.gain > 0.3


def test_no_step_is_advised_for_surfaces_that_it_would_not_show():
    """The same wall, turned away: from no place on this side is it seen."""
    cameras = camera(-0.01, frame_id=0), camera(0.01, frame_id=1)
    points = plane_points(cameras)
    advice = next_view(cameras, replace(points, normals=-points.normals))
    assert advice.arrow is None and advice.gain == 0


def test_the_arrow_goes_where_views_are_missing():
    """Both cameras stand to the left of a corner whose right wall only one of them sees, under a flat angle."""
    left = np.array([[x, y, 1.0] for x in np.linspace(-0.4, 0, 15) for y in np.linspace(-0.2, 0.2, 9)])
    right = np.array([[0.0, y, z] for z in np.linspace(1.0, 1.5, 15) for y in np.linspace(-0.2, 0.2, 9)])
    cameras = camera(-0.3, frame_id=0, target=(0, 0, 1)), camera(-0.1, frame_id=1, target=(0, 0, 1))
    away, aside = np.array([0.0, 0, -1.0]), np.array([1.0, 0, 0])
    points = Points(
        positions=np.concatenate([left, right]),
        normals=np.concatenate([np.tile(away, (len(left), 1)), np.tile(aside, (len(right), 1))]),
        seen_by=np.concatenate([np.ones((len(left), 2), bool), np.tile([False, True], (len(right), 1))]),
    )
    advice = next_view(cameras, points)
    assert advice.arrow is not None and "to the right" in advice.sentence
    assert advice.arrow[1][0] > advice.arrow[0][0] + 0.05


def test_what_is_covered_well_needs_nothing():
    cameras = tuple(
        camera(np.sin(a) * 1.0, y, 1.0 - np.cos(a), frame_id=i)
        for i, (a, y) in enumerate([(a, y) for a in np.radians([-24, -12, 0, 12, 24]) for y in (-0.25, 0.25)])
    )
    advice = next_view(cameras, plane_points(cameras, half=0.15))
    assert advice.arrow is None and advice.gain == 0 and "covered well" in advice.sentence


def test_without_cameras_there_is_advice_too():
    advice = next_view((), Points(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 0), bool)))
    assert advice.arrow is None and "overlap" in advice.sentence


def test_the_time_axis_is_thinned_where_it_is_dense_and_never_grows():
    size = moment(wall(5)).num_bytes
    history = ()
    for second in (0, 10, 20, 20.1, 30):
        history = append_moment(history, moment(wall(5), received_s=second), memory_bytes=4 * size)
    assert [one.received_s for one in history] in ([0, 10, 20, 30], [0, 10, 20.1, 30])
    for second in range(31, 60):
        history = append_moment(history, moment(wall(5), received_s=second), memory_bytes=4 * size)
        assert len(history) == 4 and history[0].received_s == 0 and history[-1].received_s == second
    assert len(append_moment((), moment(wall(5)), memory_bytes=1)) == 1


def test_the_camera_that_is_looked_through_is_told_or_else_the_widest_of_all():
    first = replace(camera(0.0), bounds=Bounds(0.3, 0.01, 1.0, 0.8, make_ball(0.01)))
    second = replace(camera(0.5, frame_id=1), bounds=Bounds(0.2, 0.03, 3.0, 0.8, make_ball(0.03)))
    there = moment(wall(3), first, second, camera(1.0, frame_id=2), scale=Scale(True, "a ruler"))
    positions = "of the distance to the scene"
    assert session.bounds_lines(there, first) == [
        f"0.png: direction to 0.3 degrees, position to 1 % {positions} (1 cm), focal length to 0.8 % (95 % bounds)"
    ]
    best = "focal length to 0.8 % (95 % bounds)"
    of_all = f"Cameras: directions to 0.3 degrees, positions to 3 % {positions} (3 cm), {best}"
    assert session.bounds_lines(there) == session.bounds_lines(there, there.snapshot.cameras[2]) == [of_all]
    assert session.bounds_lines(moment(wall(3), camera(0.0))) == []


def test_words_are_plain():
    dropped = tuple(DroppedFrame(f"{i}.png", "blurred") for i in range(8))
    there = moment(wall(3), camera(0.0), dropped=dropped, seconds={"poses": 1.24, "total": 3.0})
    refusal = Verdict(Code.NO_PARALLAX, "The camera only turned.", "Take a step to the side.", ("0.png",))
    assert session.verdict_lines(replace(there, snapshot=replace(there.snapshot, verdict=refusal))) == [
        "NO_PARALLAX: The camera only turned.",
        "What to do: Take a step to the side.",
        "About: 0.png",
    ]
    assert session.count_lines(there) == ["9 Gaussians, 1 camera", "3.0 s (poses 1.2)", "10 iterations"]
    assert session.rejection_lines(there)[0] == "2 photographs were left out before:"
    assert session.rejection_lines(there)[-1] == "left out 7.png: blurred"
    assert session.feed_line(None, True) == "a finished result"
    assert "nothing has come" in session.waiting_line(float("inf")) and "is there" in session.waiting_line(1.0)
    assert "STALE" in session.waiting_line(12.0)
    assert "STALE" in session.feed_line(12.0, False) and session.feed_line(1.0, False) == "live"
    assert session.advice_line(None, moment(wall(3), verdict=refusal)) == "Take a step to the side."
    file = moment(wall(3))
    assert "file" in session.advice_line(None, replace(file, snapshot=replace(file.snapshot, cameras=(), final=True)))
    assert session.time_line(ViewerState(), (there,)) == "snapshot 1 of 1, the newest"


def test_the_panel_tells_how_much_depth_other_views_confirm_of_a_view_and_of_all():
    shares = (0.8, 0.35, 0.5)
    cameras = [replace(camera(0.1 * n, frame_id=n), consistent_depth=share) for n, share in enumerate(shares)]
    there = moment(wall(3), *cameras)
    (of_all,) = session.depth_lines(there)
    assert of_all == "Depth: other views confirm it in 55 % of the pixels, least in 1.png: 35 %"
    assert session.depth_lines(there, cameras[2]) == ["2.png: other views confirm 50 % of its depth"]
    assert session.view_depth_lines(there, 2) == ["1.png: 35 %", "2.png: 50 %", "1 more, with larger shares"]
    unknown = moment(wall(3), camera(0.0))
    assert session.depth_lines(unknown) == session.depth_lines(unknown, unknown.snapshot.cameras[0]) == []
    assert session.view_depth_lines(unknown, 2) == []
