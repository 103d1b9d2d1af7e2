"""Where the picture is: by the project's own rasteriser in an image widget, or by Open3D in a scene widget.

The scene widget is there in any case, because without one Open3D 0.20 keeps the memory of every image that it has
shown. Open3D ends the process when a cloud is updated with fewer points than it was added with, and ignores an update
with more: geometry is added and removed whole, by name, and nothing is ever updated here. It takes images and the
background for sRGB and shows them as linear light, so they are encoded once more on the way; colours of points and
lines it shows as they are.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
import numpy.typing as npt
import open3d as o3d  # pyright: ignore[reportMissingImports]
from open3d.visualization import gui, rendering  # pyright: ignore[reportMissingImports]

from splatnode.recon.result.export.limits import compute_base_rgb
from splatnode.recon.result.snapshot import GaussianArrays
from splatnode.viewer.session import Session
from splatnode.viewer.shapes import ImageQuad, Label, Lines, Shapes, choose_first_divisor, choose_next_divisor
from splatnode.viewer.state import BACKGROUND, ViewerState, Viewpoint, open3d_draws

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


Image = npt.NDArray[np.uint8]

# Open3D skips a drawing while the one before is under way, and shows what came into its scene a drawing later: so the
# window is drawn again. Keys and clicks make it draw by themselves, so that what they change is skipped more often. On
# software Vulkan each drawing takes 60 ms of a processor, which a node may want.
_REDRAWN_S = (0.3,)
_ASKED_REDRAWN_S = (0.3, 1.0)
_SCENE_REDRAWN_S = (0.0, 0.0, 0.3, 1.0)


class WindowStage:
    """Two widgets in the same place, of which one is visible. `software`: Vulkan runs on the processor."""

    def __init__(self, window: gui.Window, software: bool) -> None:
        self.picture = gui.ImageWidget(image3d(np.full((8, 8, 3), BACKGROUND, np.uint8)))
        self.scene = gui.SceneWidget()
        self.scene.scene = rendering.Open3DScene(window.renderer)
        self.scene.visible = False  # before it is first drawn: later, the memory is kept all the same
        self.size = (1, 1)  # pixels
        self._software = software
        self._content = Scene3D(self.scene)
        self._in_scene: tuple[object, ...] = ()  # what the scene widget shows
        self._painted_s = 0.0  # how long the last full picture took
        self._part: int | None = None  # how coarse the last picture of a drag was; None: there is no drag
        self._redraw_at: list[float] = []  # times to come

    @property
    def paint_time_s(self) -> float | None:
        """Seconds that a picture takes; None where Open3D draws it."""
        return self._painted_s if self.picture.visible else None

    def lay_out(self, frame: gui.Rect) -> bool:
        """Fills `frame`; returns whether the size changed."""
        if (frame.width, frame.height) == self.size:
            return False
        self.picture.frame = self.scene.frame = frame
        self.size = frame.width, frame.height
        return True

    def draw(self, session: Session, asked: bool, hurried: bool) -> None:
        """Shows the session's picture; `asked`: by the person, not by news; `hurried`: the next one comes at once."""
        view = session.viewpoint()
        if view is None or min(self.size) < 2:
            return
        blends = session.state.blend > 0 and session.camera_image() is not None
        own = blends or not open3d_draws(session.state, self._software)
        if self.picture.visible != own or self.scene.visible == own:
            self.picture.visible, self.scene.visible = own, not own
            self._content.set_drawing(not own)
        again = _SCENE_REDRAWN_S if not own else _ASKED_REDRAWN_S if asked else _REDRAWN_S
        self._redraw_at = [time.monotonic() + after for after in again]
        if own:
            self._paint(session, hurried)
        else:
            self._draw_scene(session, view)

    def redraw_if_due(self) -> bool:
        """Whether the window is to be drawn once more, though nothing has changed."""
        if not self._redraw_at or time.monotonic() < self._redraw_at[0]:
            return False
        del self._redraw_at[0]
        self.scene.force_redraw()
        return True

    def take_image(self, session: Session, taken: Callable[[Image], None]) -> None:
        """Calls `taken` with the picture that is shown, now or a drawing later."""
        if not self.picture.visible:
            self.scene.scene.scene.render_to_image(lambda image: taken(np.asarray(image)))
        elif (image := session.paint(*self.size)) is not None:
            taken(image)

    def _paint(self, session: Session, hurried: bool) -> None:
        width, height = self.size
        self._part = (self._part or choose_first_divisor(self._painted_s)) if hurried else None
        started, paintings = time.perf_counter(), session.paintings
        image = session.paint(width, height, self._part or 1)
        if image is not None:
            self.picture.update_image(image3d(image))
        took = time.perf_counter() - started
        if self._part is not None:
            self._part = choose_next_divisor(self._part, took)
        elif session.paintings > paintings:
            self._painted_s = took

    def _draw_scene(self, session: Session, view: Viewpoint) -> None:
        state = session.state
        wanted = (session.gaussians(), state.gaussians, state.as_points, state.point_size)
        if len(self._in_scene) != len(wanted) or any(a is not b for a, b in zip(self._in_scene, wanted, strict=True)):
            self._content.show_gaussians(session.gaussians(), state)
            self._in_scene = wanted
        self._content.show_shapes(session.shapes_with_legend(*self.size))
        look_from(self.scene, view, *self.size)
        self.scene.force_redraw()
