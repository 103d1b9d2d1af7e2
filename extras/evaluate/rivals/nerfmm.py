"""NeRF-- (Wang et al. 2021): cameras, their focal length and a radiance field learnt together from nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from copy import deepcopy
from dataclasses import dataclass
from itertools import pairwise

import msgspec
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn
from torch.nn import functional

from splatnode.capture.frame import Frame
from splatnode.extras.evaluate import methods
from splatnode.extras.evaluate.regions import FieldSnapshot
from splatnode.recon.keyframes import resize_image, resize_mask
from splatnode.recon.result.snapshot import CameraEstimate, GaussianArrays, Snapshot
from splatnode.recon.threads import Clock

# A radiance field: density and colour of every point, by a small network (Mildenhall et al. 2020).

POINT_OCTAVES, DIRECTION_OCTAVES = 7, 2
_NEAREST_Z = 0.1  # points beside or behind the first camera are taken for as near as this


class Field(nn.Module):
    """(M, 3) points of the world and unit directions -> (M,) density and (M, 3) colour.

    Points are given to the network as the first camera sees them, x / z, y / z and 1 / z, which are the normalised
    device coordinates of forward-facing scenes but for constants.
    """

    def __init__(self, width: int = 64, layers: int = 3) -> None:
        super().__init__()
        sizes = [3 + 6 * POINT_OCTAVES, *[width] * layers]
        self.hidden = nn.ModuleList(nn.Linear(*size) for size in pairwise(sizes))
        self.density = nn.Linear(width, 1)
        self.colour = nn.Sequential(
            nn.Linear(width + 3 + 6 * DIRECTION_OCTAVES, width // 2), nn.ReLU(), nn.Linear(width // 2, 3), nn.Sigmoid()
        )

    def forward(self, points: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
        z = points[:, 2:].clamp_min(_NEAREST_Z)
        features = encode_frequencies(torch.cat([points[:, :2] / z, 1 / z], 1), POINT_OCTAVES)
        for layer in self.hidden:
            features = functional.relu(layer(features))
        density = functional.softplus(self.density(features)[:, 0])
        return density, self.colour(torch.cat([features, encode_frequencies(directions, DIRECTION_OCTAVES)], 1))


def encode_frequencies(x: Tensor, octaves: int) -> Tensor:
    """(M, D + 2 D octaves) x (M, D) with its sines and cosines at frequencies of pi / 2, pi, 2 pi, ..."""
    scaled = x[:, None] * (2.0 ** torch.arange(-1, octaves - 1, dtype=x.dtype, device=x.device) * math.pi)[:, None]
    return torch.cat([x, scaled.sin().flatten(1), scaled.cos().flatten(1)], 1)


# Volume rendering: the colours and depths that a radiance field gives along rays.

NEAR, FAR = 0.3, 20.0
SAMPLES = 32  # of a ray, evenly spaced in inverse depth
_OPAQUE = 30.0  # optical depth behind which nothing is seen; the numbers that would follow cost five times as much time


@dataclass(frozen=True, eq=False)
class RenderedRays:
    rgb: Tensor  # (M, 3)
    depth: Tensor  # (M,) expected z in the camera frame


def render_rays(
    field: Field,
    T_world_camera: Tensor,  # (4, 4)
    K: Tensor,  # (3, 3)
    pixels: Tensor,  # (M, 2) u, v
    jitter: torch.Generator | None = None,
) -> RenderedRays:
    """Colours and depths of pixels, differentiable in field, pose and K. `jitter` moves the samples at random."""
    rays = torch.cat([(pixels - K[:2, 2]) / torch.diagonal(K)[:2], torch.ones_like(pixels[:, :1])], 1)
    directions = rays @ T_world_camera[:3, :3].T
    steps = torch.arange(SAMPLES, dtype=pixels.dtype)
    shift = torch.rand(len(pixels), SAMPLES, generator=jitter) if jitter is not None else torch.tensor(0.5)
    share = (steps + shift).expand(len(pixels), SAMPLES) / SAMPLES
    z = 1.0 / (1.0 / NEAR + share * (1.0 / FAR - 1.0 / NEAR))  # (M, S), falling from near to far
    points = T_world_camera[:3, 3] + directions[:, None] * z[..., None]
    unit = functional.normalize(directions, dim=1)[:, None].expand_as(points)
    density, rgb = field(points.reshape(-1, 3), unit.reshape(-1, 3))
    weights = _compute_weights(density.view(z.shape), z * directions.norm(dim=1, keepdim=True))
    return RenderedRays((weights[..., None] * rgb.view(*z.shape, 3)).sum(1), (weights * z).sum(1))


def _compute_weights(density: Tensor, distance: Tensor) -> Tensor:
    """(M, S) what each sample adds to its ray, the last of them all that is left: nothing lies behind it."""
    optical = (density[:, :-1] * (distance[:, 1:] - distance[:, :-1])).clamp_max(_OPAQUE)
    opacity = torch.cat([1.0 - torch.exp(-optical), torch.ones_like(density[:, :1])], 1)
    before = torch.cumsum(optical, 1)
    return opacity * torch.cat([torch.ones_like(before[:, :1]), torch.exp(-before.clamp_max(_OPAQUE))], 1)


# Cameras that are learnt: a rotation vector and a translation each, and one focal length (Wang et al. 2021).


class Cameras(nn.Module):
    """C cameras that all start at the world's origin. `T_world_camera` and `K` carry gradients.

    The first camera stays where it is: it is the world.
    """

    def __init__(self, count: int) -> None:
        super().__init__()
        self.turns = nn.Parameter(torch.zeros(count, 3))
        self.centres = nn.Parameter(torch.zeros(count, 3))

    def T_world_camera(self, index: int) -> Tensor:  # (4, 4)
        if index == 0:
            return torch.eye(4)
        x, y, z = self.turns[index]
        zero = torch.zeros(())
        cross = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).view(3, 3)
        upper = torch.cat([torch.linalg.matrix_exp(cross), self.centres[index][:, None]], 1)
        return torch.cat([upper, torch.tensor([[0.0, 0.0, 0.0, 1.0]])])


class Focal(nn.Module):
    """One focal length for all, in parts of the longer side: the square of what is learnt, so that it is positive."""

    def __init__(self, start: float) -> None:
        super().__init__()
        self.root = nn.Parameter(torch.tensor(start**0.5))

    def K(self, width: int, height: int) -> Tensor:  # (3, 3)
        focal = self.root**2 * max(width, height)
        zero, one = torch.zeros(()), torch.ones(())
        middle = torch.tensor([width / 2, height / 2])
        return torch.stack([focal, zero, middle[0], zero, focal, middle[1], zero, zero, one]).view(3, 3)


# The joint optimisation of a radiance field and its cameras.


class FitConfig(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """The joint optimisation of a radiance field and its cameras."""

    iterations: int = 1500
    checkpoints: tuple[int, ...] = (400,)
    rays: int = 384  # of one photograph, in each iteration
    field_rate: float = 5e-3  # Adam's step sizes at the start
    camera_rate: float = 3e-3  # of rotations, centres, focal length and whatever a method learns beside them
    field_final: float = 0.1  # to which part they have fallen at the end, exponentially
    camera_final: float = 0.1


@dataclass(frozen=True, eq=False)
class FieldCheckpoint:
    """A field with its cameras after a number of iterations."""

    field: Field
    Ts_world_camera: tuple[Tensor, ...]  # (4, 4) each
    focal: float  # in parts of the longer side
    iterations: int


@dataclass(frozen=True, eq=False)
class FitStep:
    """The renders of an iteration, for further losses."""

    view: int
    pixels: Tensor  # (M, 2)
    rays: RenderedRays
    cameras: Cameras
    progress: float  # of all iterations, in [0, 1)


def fit_field(
    images: Sequence[Tensor],  # (h, w, 3) in [0, 1]
    used: Sequence[Tensor | None],  # (h, w) where the colours of each count; None: everywhere
    focal: Focal,
    config: FitConfig,
    *,
    seed: int,
    further: Callable[[FitStep], Tensor] | None = None,
    beside: Sequence[nn.Parameter] = (),
) -> Iterator[FieldCheckpoint]:
    """The field at every checkpoint and at the end.

    The loss is the mean squared difference of the colours of random pixels, plus what `further` gives; `beside` are
    parameters of its own, learnt like the cameras.
    """
    draws = torch.Generator().manual_seed(seed)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        field = Field()
    cameras = Cameras(len(images))
    located = [*cameras.parameters(), *(p for p in focal.parameters() if p.requires_grad), *beside]
    groups = [{"params": list(field.parameters())}, {"params": located}]
    starts, finals = (config.field_rate, config.camera_rate), (config.field_final, config.camera_final)
    adam = torch.optim.Adam(groups, lr=config.field_rate)
    order = np.random.default_rng(seed)
    queue: list[int] = []
    for iteration in range(config.iterations):
        progress = iteration / config.iterations
        for group, start, final in zip(adam.param_groups, starts, finals, strict=True):
            group["lr"] = start * final**progress
        queue = queue or order.permutation(len(images)).tolist()
        view = queue.pop()
        height, width = images[view].shape[:2]
        pixels = torch.rand((config.rays, 2), generator=draws) * torch.tensor([width, height])
        pixels = pixels.floor() + 0.5
        rays = render_rays(field, cameras.T_world_camera(view), focal.K(width, height), pixels, draws)
        columns, rows = pixels.long().unbind(1)
        loss = _compute_colour_loss((rays.rgb - images[view][rows, columns]).square(), used[view], rows, columns)
        if further is not None:
            loss = loss + further(FitStep(view, pixels, rays, cameras, progress))
        adam.zero_grad()
        loss.backward()
        adam.step()
        if iteration + 1 in config.checkpoints and iteration + 1 < config.iterations:
            yield _make_checkpoint(field, cameras, focal, iteration + 1)
    yield _make_checkpoint(field, cameras, focal, config.iterations)


def _compute_colour_loss(squares: Tensor, used: Tensor | None, rows: Tensor, columns: Tensor) -> Tensor:
    """The mean of the squared differences (M, 3) of the pixels that are used."""
    if used is None:
        return squares.mean()
    counted = used[rows, columns]
    return (squares.mean(1) * counted).sum() / counted.sum().clamp_min(1)


def _make_checkpoint(field: Field, cameras: Cameras, focal: Focal, iterations: int) -> FieldCheckpoint:
    Ts = tuple(cameras.T_world_camera(index).detach() for index in range(len(cameras.turns)))
    return FieldCheckpoint(deepcopy(field), Ts, float(focal.root.detach() ** 2), iterations)


# How a radiance field looks, and what is published of it.

Array = npt.NDArray[np.float64]
COMPARED_PIXELS = 128  # pixels on which an image is compared
_CHUNK = 1024  # rays that are rendered at a time


class FieldAppearance:
    """`extras.evaluate.appearance.Appearance` of a field, whose parameters are constants here."""

    num_gaussians = None

    def __init__(self, field: Field) -> None:
        self._field = field.requires_grad_(False)

    @property
    def num_bytes(self) -> int:
        return sum(parameter.nbytes for parameter in self._field.parameters())

    def depth(self, T_world_camera: Array) -> float:
        """The median depth of an image with an angle of view of 53 degrees."""
        K = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
        with torch.no_grad():
            return float(
                render_rays(
                    self._field, torch.from_numpy(T_world_camera).float(), K, sample_pixels(100, 100)
                ).depth.median()
            )

    def difference(self, image: Tensor, T_world_camera: Tensor, K: Tensor, used: Tensor | None = None) -> Tensor:
        """On the same pixels whenever it is asked, evenly spread over the image, or over what is `used` of it."""
        pixels = sample_pixels(image.shape[1], image.shape[0]) if used is None else _sample_used_pixels(used)
        columns, rows = pixels.long().unbind(1)
        return (render_rays(self._field, T_world_camera, K, pixels).rgb - image[rows, columns]).abs().mean()

    def render(self, T_world_camera: Array, K: Array, width: int, height: int) -> Tensor:
        v, u = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
        T, intrinsics = torch.from_numpy(T_world_camera).float(), torch.from_numpy(K).float()
        with torch.no_grad():
            parts = torch.stack([u, v], -1).view(-1, 2).split(_CHUNK)
            rgb = torch.cat([render_rays(self._field, T, intrinsics, part).rgb for part in parts])
        return rgb.view(height, width, 3)


def sample_pixels(width: int, height: int, count: int = COMPARED_PIXELS) -> Tensor:
    """(M, 2) centres of pixels that cover an image evenly: the additive sequence of the plastic number."""
    plastic = 1.32471795724474602596
    shares = torch.arange(1, count + 1)[:, None] * torch.tensor([1 / plastic, 1 / plastic**2]) % 1.0
    return (shares * torch.tensor([width, height])).floor() + 0.5


def _sample_used_pixels(used: Tensor) -> Tensor:
    """(M, 2) centres of pixels among those of `used` (H, W): the additive sequence of the golden ratio."""
    rows, columns = torch.nonzero(used, as_tuple=True)
    shares = torch.arange(1, COMPARED_PIXELS + 1) * 0.61803398874989484820 % 1.0
    chosen = (shares * len(rows)).long()
    return torch.stack([columns[chosen], rows[chosen]], 1) + 0.5


def make_field_snapshot(frames: Sequence[Frame], registered: Sequence[Frame], learnt: FieldCheckpoint) -> FieldSnapshot:
    """A field and the cameras that were learnt with it, those of the frames `registered`."""
    return FieldSnapshot(
        sequence=0,
        verdict=methods.make_verdict(frames, {frame.name for frame in registered}),
        cameras=tuple(
            _make_camera_estimate(frame, T, learnt.focal)
            for frame, T in zip(registered, learnt.Ts_world_camera, strict=True)
        ),
        gaussians=GaussianArrays.empty(),
        images={},
        dropped=(),
        iterations=learnt.iterations,
        appearance=FieldAppearance(learnt.field),
    )


def _make_camera_estimate(frame: Frame, T_world_camera: Tensor, focal: float) -> CameraEstimate:
    width, height = frame.width, frame.height
    pixels = focal * max(width, height)
    K = np.array([[pixels, 0, width / 2], [0, pixels, height / 2], [0, 0, 1.0]])
    T = T_world_camera.double().numpy()
    return CameraEstimate(frame.name, frame.frame_id, T, K, width, height)


# NeRF-- (Wang et al. 2021): cameras, their focal length and a radiance field learnt together from nothing else.
#
# As published: all cameras start at the origin and look ahead, the focal length starts as the image's size, samples
# are spaced as in normalised device coordinates, without a hierarchy. Compact: 1500 iterations of 384 rays, where 10
# 000 epochs take 1024 rays of every photograph, and step sizes of 5e-3 and 3e-3 for 1e-3 in their stead; 32 samples a
# ray for 128; three layers of 64 for eight of 128; photographs of 256 pixels. Our first camera stays at the origin.
# Twice as many iterations change nothing: on llff_fern the cameras stand after 600, where their focal length and turns
# are wrong.

SIZE = 256  # longer side of the photographs, pixels
OPTIMIZE = FitConfig()


def reconstruct(frames: Sequence[Frame], seed: int, config: FitConfig = OPTIMIZE) -> Iterator[Snapshot]:
    """Snapshots of the field while it is learnt."""
    clock = Clock()
    if len(frames) < methods.MIN_CAMERAS:
        yield methods.make_refusal(frames, clock)
        return
    images = [torch.from_numpy(resize_image(frame.image, SIZE)).float() / 255.0 for frame in frames]
    used = [
        None if frame.mask is None else torch.from_numpy(resize_mask(frame.mask, *image.shape[:2]))
        for frame, image in zip(frames, images, strict=True)
    ]
    learnt = fit_field(images, used, Focal(1.0), config, seed=seed)
    yield from methods.number_snapshots((make_field_snapshot(frames, frames, each) for each in learnt), clock)
