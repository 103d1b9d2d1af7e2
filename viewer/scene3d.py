"""The scene as Open3D draws it: geometry by name, added and removed whole.

Open3D ends the process when a cloud is updated with fewer points than it was added with, and ignores an update with
more: nothing is ever updated here. It takes images and the background for sRGB and shows them as linear light, so they
are encoded once more on the way; colours of points and lines it shows as they are.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import open3d as o3d  # pyright: ignore[reportMissingImports]
from open3d.visualization import gui, rendering  # pyright: ignore[reportMissingImports]

from splatnode.recon.result.export.prepare import compute_base_rgb
from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.viewer.shapes import ImageQuad, Label, Lines, Shapes
from splatnode.viewer.state import ViewerState
from splatnode.viewer.viewpoint import BACKGROUND, Viewpoint

_BOUNDS = o3d.geometry.AxisAlignedBoundingBox(np.full(3, -20.0), np.full(3, 20.0))  # for near and far planes
_CLOUD = "gaussians"


class Scene3D:
    """Keeps the scene of a SceneWidget as the caller wants it. To be used in the thread of the window."""

    def __init__(self, widget: gui.SceneWidget) -> None:
        scene: rendering.Open3DScene = widget.scene
        self._widget, self._scene = widget, scene
        self._shapes: set[str] = set()
        self._labels: list[gui.Label3D] = []
        scene.set_background([*_encode_srgb(np.array(BACKGROUND) / 255.0), 1.0])

    def set_drawing(self, drawing: bool) -> None:
        """Whether the scene is what the person sees.

        Tone mapping would wash the colours out. While it is off, Open3D 0.20 keeps the memory of every image that it
        shows elsewhere in the window, so it is off only where it matters.
        """
        self._scene.view.set_post_processing(not drawing)

    def show_gaussians(self, gaussians: GaussianArrays, state: ViewerState) -> None:
        """The Gaussians, as Gaussians or as points, in place of those that were there."""
        self._remove(_CLOUD)
        if state.gaussians and len(gaussians):
            make = _points if state.as_points else _splats
            self._scene.add_geometry(_CLOUD, *make(gaussians, state))

    def show_shapes(self, shapes: Shapes) -> None:
        """The shapes, in place of those that were there."""
        for name in self._shapes:
            self._remove(name)
        parts = {f"lines {number}": _lines(lines) for number, lines in enumerate(shapes.lines)}
        parts |= {f"photograph {number}": _photograph(one) for number, one in enumerate(shapes.photographs)}
        for name, (geometry, material) in parts.items():
            self._scene.add_geometry(name, geometry, material)
        self._shapes = set(parts)
        for label in self._labels:
            self._widget.remove_3d_label(label)
        self._labels = [self._label(label) for label in shapes.labels]

    def _label(self, label: Label) -> gui.Label3D:
        there = self._widget.add_3d_label(label.at.astype(np.float32), label.text)
        there.color = gui.Color(*label.colour)
        return there

    def _remove(self, name: str) -> None:
        if self._scene.has_geometry(name):
            self._scene.remove_geometry(name)


def look_from(widget, view: Viewpoint, width: int, height: int) -> None:
    """The widget's camera at the viewpoint. `widget` is a SceneWidget of that size."""
    widget.setup_camera(view.K(width, height), np.linalg.inv(view.T_world_camera), width, height, _BOUNDS)


def image3d(image: npt.NDArray[np.uint8]) -> o3d.geometry.Image:
    """The image (H, W, 3) as Open3D takes it."""
    return o3d.geometry.Image(np.ascontiguousarray(image))  # pyright: ignore[reportCallIssue, reportArgumentType]


def _splats(
    gaussians: GaussianArrays, _state: ViewerState
) -> tuple[o3d.t.geometry.PointCloud, rendering.MaterialRecord]:
    """Open3D 0.20 leaves out what covers more than 256 of its tiles, whatever its material says: the far shell."""
    cloud = o3d.t.geometry.PointCloud(_tensor(gaussians.means))
    cloud.point["f_dc"] = _tensor(gaussians.sh[:, 0])
    degree = round(gaussians.sh.shape[1] ** 0.5) - 1
    if degree:
        cloud.point["f_rest"] = _tensor(gaussians.sh[:, 1:])
    cloud.point["scale"] = _tensor(gaussians.scales)
    cloud.point["rot"] = _tensor(gaussians.quats)
    opacities = np.clip(gaussians.opacities.astype(np.float64), 1e-6, 1 - 1e-6)
    cloud.point["opacity"] = _tensor(np.log(opacities / (1.0 - opacities))[:, None])  # Open3D keeps the logit
    material = _material("gaussianSplat")
    material.gaussian_splat_sh_degree = degree
    return cloud, material


def _points(
    gaussians: GaussianArrays, state: ViewerState
) -> tuple[o3d.t.geometry.PointCloud, rendering.MaterialRecord]:
    cloud = o3d.t.geometry.PointCloud(_tensor(gaussians.means))
    cloud.point["colors"] = _tensor(compute_base_rgb(gaussians) / 255.0)
    material = _material("defaultUnlit")
    material.point_size = float(state.point_size)
    return cloud, material


def _lines(lines: Lines) -> tuple[o3d.geometry.LineSet, rendering.MaterialRecord]:
    ends = lines.ends.reshape(-1, 3)
    geometry = o3d.geometry.LineSet(
        o3d.utility.Vector3dVector(ends), o3d.utility.Vector2iVector(np.arange(len(ends)).reshape(-1, 2))
    )
    geometry.paint_uniform_color(np.array(lines.colour))
    material = _material("unlitLine")
    material.line_width = float(lines.width)
    return geometry, material


def _photograph(photograph: ImageQuad) -> tuple[o3d.geometry.TriangleMesh, rendering.MaterialRecord]:
    """A rectangle with the image on it, seen from both sides."""
    triangles = np.array([[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2]])
    mesh = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(photograph.corners), o3d.utility.Vector3iVector(triangles)
    )
    corners = np.array([[0.0, 1.0], [1.0, 1.0], [1.0, 0.0], [0.0, 0.0]])  # v points up
    mesh.vertex_colors = o3d.utility.Vector3dVector(np.ones((4, 3)))  # without them the image is half as bright
    mesh.triangle_uvs = o3d.utility.Vector2dVector(corners[triangles.ravel()])
    levels = np.rint(255 * _encode_srgb(np.arange(256) / 255.0)).astype(np.uint8)
    material = _material("defaultUnlit")
    material.albedo_img = image3d(levels[photograph.levels[0]])
    return mesh, material


def _material(shader: str) -> rendering.MaterialRecord:
    material = rendering.MaterialRecord()
    material.shader = shader
    material.base_color = [1.0, 1.0, 1.0, 1.0]
    return material


def _encode_srgb(linear: npt.NDArray) -> npt.NDArray[np.float64]:
    """sRGB values of linear light in [0, 1] (IEC 61966-2-1)."""
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 1e-9) ** (1 / 2.4) - 0.055)


def _tensor(values: npt.NDArray) -> o3d.core.Tensor:
    return o3d.core.Tensor(np.ascontiguousarray(values, np.float32))  # pyright: ignore[reportCallIssue]
