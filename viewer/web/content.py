"""What the page draws, as bytes: Gaussians, cameras and lines, photographs."""

from __future__ import annotations

import json
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import cv2
import numpy as np

from splatnode.capture.process.printable import sanitize_text
from splatnode.recon.result.export.formats.splat import encode_splat
from splatnode.recon.result.snapshot import CameraEstimate
from splatnode.viewer.advice import Advice
from splatnode.viewer.colours import source_colour
from splatnode.viewer.ground import ground, ground_lines
from splatnode.viewer.moment import Moment
from splatnode.viewer.shapes import Lines, frustum_depth, image_corners, shapes
from splatnode.viewer.state import ViewerState
from splatnode.viewer.viewpoint import Viewpoint, overview, scene_pivot

THUMBNAIL_SIDE = 256  # pixels, at least where the photograph has as many
_QUALITY = 85  # of JPEG
_NOTHING = ViewerState(
    cameras=False, photographs=False, path=False, tracked=False, advice=False, uncertainty=False, graph=False
)
# Groups of lines that the page shows or hides; the names are fields of State. "ground" is one more.
_GROUPS = ("cameras", "path", "advice", "uncertainty", "graph")


@dataclass(frozen=True, eq=False)
class Content:
    """A moment with what is known beside it. Bytes are made when somebody first asks for them."""

    moment: Moment
    advice: Advice | None

    @cached_property
    def gaussians(self) -> bytes:
        """The Gaussians as a .splat file: 32 bytes each."""
        return encode_splat(self.moment.snapshot.gaussians)

    @cached_property
    def shapes(self) -> bytes:
        """Four bytes with the length of a JSON text, the text, and the lines' ends as float32, little-endian.

        The text has the cameras, the viewpoints to start from, and where in the numbers each group of lines is.
        """
        named = [(name, _lines_of_group(self, name)) for name in _GROUPS] + [
            ("ground", ground_lines(ground(self.moment)))
        ]
        parts, told, at = [], [], 0
        for name, group in named:
            for lines in group:
                ends = lines.ends.astype("<f4")
                parts.append(ends.tobytes())
                told.append({"group": name, "at": at, "count": len(ends), "colour": lines.colour, "width": lines.width})
                at += ends.size
        text = json.dumps(_describe_scene(self) | {"lines": told}, allow_nan=False).encode()
        text += b" " * (-len(text) % 4)
        return b"".join([len(text).to_bytes(4, "little"), text, *parts])

    def encode_image(self, index: int, *, small: bool) -> bytes | None:
        """The JPEG of the camera at `index`, at its size or as a thumbnail; None where there is none."""
        cameras = self.moment.snapshot.cameras
        image = self.moment.snapshot.images.get(cameras[index].name) if 0 <= index < len(cameras) else None
        if image is None:
            return None
        scale = min(1.0, THUMBNAIL_SIDE / max(image.shape[:2])) if small else 1.0
        size = max(1, round(scale * image.shape[1])), max(1, round(scale * image.shape[0]))
        resized = cv2.resize(image, size, interpolation=cv2.INTER_AREA)
        done, data = cv2.imencode(
            ".jpg", cv2.cvtColor(resized, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
        )
        return data.tobytes() if done else None


def _lines_of_group(content: Content, name: str) -> tuple[Lines, ...]:
    """The lines of one group; those of the cameras are one for each, in their order."""
    state = replace(_NOTHING, **{name: True})
    return shapes(content.moment, state, content.advice).lines


def live_camera_ends(moment: Moment, tracked: CameraEstimate | None) -> list[float]:
    """The ends of the live camera's lines, six numbers each; none where it is not known."""
    lines = shapes(moment, replace(_NOTHING, tracked=True), None, tracked).lines
    return [round(number, 6) for each in lines for number in each.ends.ravel().tolist()]


def _describe_scene(content: Content) -> dict[str, Any]:
    moment = content.moment
    snapshot = moment.snapshot
    start = overview(moment, (content.advice.arrow if content.advice else None) or ())
    depth = frustum_depth(moment)
    return {
        "scene": moment.scene_id,
        "num_gaussians": len(snapshot.gaussians),
        "up": start.up.tolist(),
        "pivot": scene_pivot(moment).tolist(),
        "overview": _viewpoint(start),
        "frustum_depth": depth,
        "cameras": [
            {
                "name": sanitize_text(camera.name),
                "colour": source_colour(index),
                "T_world_camera": camera.T_world_camera.ravel().tolist(),
                "K": camera.K.ravel().tolist(),
                "size": [camera.width, camera.height],
                "corners": image_corners(camera, camera.T_world_camera, depth).tolist(),
                "photograph": camera.name in snapshot.images,
            }
            for index, camera in enumerate(snapshot.cameras)
        ],
    }


def _viewpoint(view: Viewpoint) -> dict[str, Any]:
    K, width, height = view.lens
    return {
        "T_world_camera": np.ravel(view.T_world_camera).tolist(),
        "K": np.ravel(K).tolist(),
        "size": [width, height],
        "distance": view.distance,
    }
