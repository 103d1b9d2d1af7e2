"""Registration of photographs of the built-in place, together with one that shows something else."""

from __future__ import annotations

import numpy as np

from capture.cameras import synthetic
from capture.frame import Frame
from recon.keyframe import Keyframe
from recon.registration import features, register
from recon.view_graph import ViewGraph


def test_the_lens_of_a_frame_that_is_left_out_makes_no_focal_length_uncertain():
    place = synthetic.Config(views=3, width=320, height=240)
    blank = np.full((200, 300, 3), 128, np.uint8)
    config = register.Config()
    graph = ViewGraph(config)
    for frame in [*synthetic.stream(place), Frame(3, "another size", 3, blank, None)]:
        graph.add(Keyframe(frame, frame.image, features.extract(frame.image, config.features)))
    registration = register.register(graph.keyframes, graph.pairs, config)
    assert registration is not None and [camera.index for camera in registration.cameras] == [0, 1, 2]
    assert registration.focal_sigma < 0.5 * config.voted_sigma
