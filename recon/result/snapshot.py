"""What the reconstruction tells the world: plain NumPy, so that viewers and exporters need no torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from splatnode.capture.frame import DroppedFrame, Intrinsics
from splatnode.capture.stamp import Stamp
from splatnode.recon.result.bounds import Bounds
from splatnode.recon.result.landmarks import Landmarks
from splatnode.recon.result.scale import RELATIVE, Scale
from splatnode.recon.result.up import Up
from splatnode.recon.result.verdict import Verdict

Array = npt.NDArray[np.float32]
Array64 = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class CameraEstimate:
    """An estimated camera, for its image at modelled size (`width` x `height`)."""

    name: str
    frame_id: int
    T_world_camera: npt.NDArray[np.float64]  # (4, 4)
    K: npt.NDArray[np.float64]  # (3, 3), centre of the top-left pixel at (0.5, 0.5)
    width: int
    height: int
    bounds: Bounds | None = None  # of its errors; None: not estimated
    captured_at: Stamp | None = None  # of its photograph; None: nobody knows
    # Estimated, of the photograph in full size: its distortion was taken out of the image, whose pinhole is K. None: K
    # is estimated of the photograph as it came, or without the distortion that was given
    lens: Intrinsics | None = None
    # Share of its pixels, 0 to 1, whose depth is multi-view consistent: a point of another view has it, too. None: not
    # known, as of a coarse preview
    consistent_depth: float | None = None

    @property
    def K_photographed(self) -> npt.NDArray[np.float64]:
        """(3, 3) of the photograph at `width` x `height` before an estimated distortion was taken out of it."""
        return self.K if self.lens is None else self.lens.resized(self.width, self.height).K


@dataclass(frozen=True, eq=False)
class GaussianArrays:
    """N Gaussians, activated: scales are lengths, opacities are in (0, 1), quats (wxyz) have unit length."""

    means: Array  # (N, 3)
    quats: Array  # (N, 4)
    scales: Array  # (N, 3)
    opacities: Array  # (N,)
    sh: Array  # (N, B, 3)
    source_frame: npt.NDArray[np.int32]  # (N,)

    def __len__(self) -> int:
        return self.means.shape[0]

    @classmethod
    def empty(cls) -> GaussianArrays:
        """No Gaussians."""

        def zeros(*shape: int) -> Array:
            return np.zeros(shape, np.float32)

        return cls(zeros(0, 3), zeros(0, 4), zeros(0, 3), zeros(0), zeros(0, 1, 3), np.zeros(0, np.int32))


@dataclass(frozen=True, eq=False)
class InGivenWorld:
    """How a scene lies in the world of the given poses that held its cameras: scale * rotation @ p + translation."""

    scale: float  # metres per unit
    rotation: Array64  # (3, 3)
    translation: Array64  # (3,) metres
    scale_sigma: float  # standard deviation of the logarithm of the scale
    num_poses: int  # that hold it


@dataclass(frozen=True, eq=False)
class Snapshot:
    """The scene after a step of the reconstruction. The world is the first camera's frame, or that of given poses."""

    sequence: int
    verdict: Verdict
    cameras: tuple[CameraEstimate, ...]
    gaussians: GaussianArrays
    images: dict[str, npt.NDArray[np.uint8]]  # (H, W, 3) RGB by camera name, as modelled
    dropped: tuple[DroppedFrame, ...]
    iterations: int
    seconds: dict[str, float] = field(default_factory=dict)  # by stage
    budget: tuple[Mapping[str, object], ...] = ()  # recon.budget.Hit.record of each limit that bound the final scene
    final: bool = False
    served_by: Mapping[str, str] = field(default_factory=dict)  # network or measure, by regularisation that was used
    evidence: Mapping[str, object] | None = None  # recon.verification.likelihood.record; None: nothing to verify
    scale: Scale = RELATIVE  # the unit of all lengths
    given: InGivenWorld | None = None  # how it lies in the world of given poses; None: that is not known, or it does
    up: Up | None = None  # in the world; None: no IMU tells it
    landmarks: Landmarks | None = None  # by which further photographs are placed; None: they were not gathered
    # By camera (h, w), one value for 2 x 2 pixels: z where a second photograph confirms it, else 0. Empty: not gathered
    depths: Mapping[str, npt.NDArray[np.float16]] = field(default_factory=dict)
    masked: Mapping[str, float] = field(default_factory=dict)  # share that a mask hides, by photograph that has one
    moving: Mapping[str, float] = field(default_factory=dict)  # share left out because it moved, by photograph
    gains: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # taken out of photographs: red, green, blue
    falloffs: Mapping[str, float] = field(default_factory=dict)  # of lenses that dim their corners, by photograph
    scenes: tuple[str, ...] = ()  # that it was merged of, by scene_id, where it was read from a result

    @property
    def consistent_depth(self) -> float | None:
        """The share of all cameras' pixels whose depth is multi-view consistent, 0 to 1: the mean over the cameras.

        None where it is not known of every camera.
        """
        shares = [camera.consistent_depth for camera in self.cameras]
        known = [share for share in shares if share is not None]
        return sum(known) / len(known) if known and len(known) == len(shares) else None
