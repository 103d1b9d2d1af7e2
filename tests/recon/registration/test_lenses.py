"""Frames of one camera in several sizes, and frames that only look as if they were."""

from __future__ import annotations

from types import SimpleNamespace

import cv2
import numpy as np
import numpy.typing as npt
import pytest

from splatnode.capture.frame import Frame
from splatnode.recon.registration import registration as registration_registration
from splatnode.recon.registration import self_calibration
from splatnode.recon.registration.registration import Registration
from tests.support.synthetic import photographs, renumbered, view_graph


def registered(images: list[npt.NDArray[np.uint8]]) -> Registration:
    graph = view_graph(renumbered(images))
    registration = registration_registration.register(
        graph.keyframes, graph.pairs, registration_registration.RegistrationConfig()
    )
    assert registration is not None and len(registration.cameras) == len(images)
    return registration


def test_frames_of_one_camera_in_two_sizes_share_its_lens():
    images = [frame.image for frame in photographs()[:4]]
    plain = registered(images)
    for i in (1, 3):
        images[i] = cv2.resize(images[i], None, fx=0.75, fy=0.75, interpolation=cv2.INTER_AREA).astype(np.uint8)
    mixed = registered(images)
    assert {camera.lens for camera in mixed.cameras} == {0}
    first, second, *_ = mixed.cameras
    assert second.focal == pytest.approx(0.75 * first.focal)
    assert second.principal == pytest.approx(0.75 * first.principal)
    assert first.focal == pytest.approx(plain.cameras[0].focal, rel=0.03)
    for one, other in zip(plain.cameras, mixed.cameras, strict=True):
        assert np.linalg.norm(one.T_world_camera[:3, :3] - other.T_world_camera[:3, :3]) < 0.01


def test_frames_that_were_cropped_have_a_lens_of_their_own():
    images = [frame.image for frame in photographs()[:5]]
    height, width = images[0].shape[:2]
    for i in (1, 3):
        images[i] = np.ascontiguousarray(images[i][height // 8 : -height // 8, width // 8 : -width // 8])
    cameras = registered(images).cameras
    assert [camera.lens for camera in cameras] == [cameras[0].lens, cameras[1].lens] * 2 + [cameras[0].lens]
    assert cameras[1].lens != cameras[0].lens
    assert cameras[1].focal == pytest.approx(cameras[0].focal, rel=0.05)


def test_an_error_of_so_many_pixels_means_the_same_through_every_lens():
    sizes = [(3000, 4000), (720, 1280), (2250, 3000)]
    frames = [Frame(0, "a.png", 0, np.empty((*size, 3), np.uint8), None) for size in sizes]
    grouping = self_calibration.group([SimpleNamespace(frame=frame) for frame in frames], across_sizes=True)
    assert grouping.lens_of == (0, 1, 0) and grouping.longer_side == 4000
    assert grouping.scales == pytest.approx((1.0, 4000 / 1280, 4000 / 3000))
