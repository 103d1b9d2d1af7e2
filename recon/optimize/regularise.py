"""The losses beside the photometric one (equation 13), each with its weight and its time.

What is known beside the photographs comes from the point maps: their depth and normals on training views, and what
their points show from the pseudo views. A term of weight 0 costs nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass

import msgspec
import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor

from splatnode.recon.networks.depth_anything import load_relative
from splatnode.recon.optimize.losses.depth import local_depth_loss
from splatnode.recon.optimize.losses.dino import load_dino
from splatnode.recon.optimize.losses.normal import normal_loss
from splatnode.recon.optimize.losses.perceptual import Distance, Perceptual, load_perceptual
from splatnode.recon.optimize.losses.semantic import Encoder, semantic_loss
from splatnode.recon.optimize.point_render import PointRender, render_points
from splatnode.recon.optimize.pseudo_views import PseudoView, pseudo_views
from splatnode.recon.priors.monocular import with_monocular
from splatnode.recon.priors.pointmap import Pointmap
from splatnode.recon.rasterize.render import Render


class Term(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    weight: float = 0.0
    start: float = 0.0  # as shares of all iterations
    end: float = 1.0

    def at(self, progress: float) -> float:
        return self.weight if self.start <= progress < self.end else 0.0


class Config(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Which terms, and what the publication leaves open: number and place of the pseudo views, K, patches.

    On sceaux, in 250 iterations, the depth loss alone cost .38 dB with patches of 32 pixels, in which often noise is
    all that rises and falls, and .11 dB with the 128 of LM-Gaussian, where equation 9 comes from. Pseudo views of half
    the size cost the whole .29 dB, .005 SSIM and .016 LPIPS: Gaussians of a pixel look otherwise there.
    """

    point_render: Term = Term()  # equations 6, 7
    depth: Term = Term()  # 8, 9
    normal: Term = Term()  # 10
    semantic: Term = Term()  # 12
    pseudo_views: int = 12
    off_path: float = 0.1  # of the distance between neighbouring cameras
    nearest_points: int = 8  # K of equation 6
    depth_patch: int = 128  # pixels
    depth_share: float = 0.5  # of the patches, drawn anew at each iteration
    min_confidence: float = 0.3  # of the points that are drawn and of the depths that are known
    compare_unseen: bool = False  # pull pseudo views towards white where no point shows anything, as the paper writes

    @property
    def terms(self) -> tuple[Term, ...]:
        return self.point_render, self.depth, self.normal, self.semantic


PAPER = Config(
    point_render=Term(0.25, 0.1, 0.8),
    depth=Term(0.05, 0.2, 0.7),
    normal=Term(0.01, 0.2, 0.7),
    semantic=Term(0.5, 0.1, 0.8),
    compare_unseen=True,
)


@dataclass(frozen=True, eq=False)
class _Known:
    """What a view is held to."""

    depth: Tensor  # (H, W)
    normal: Tensor  # (H, W, 3) camera frame
    weights: Tensor  # (H, W), 0 where nothing is known


@dataclass(frozen=True, eq=False)
class _Imagined:
    """A pseudo view and what the points show from it."""

    view: PseudoView
    known: _Known
    looks: Distance | None
    seen: Tensor  # (H, W, 1), where the points show anything


class Regularisation:
    """All terms of one refinement."""

    def __init__(
        self, pointmaps: Sequence[Pointmap], images: Sequence[npt.NDArray[np.uint8]], config: Config, *, seed: int
    ) -> None:
        """`pointmaps` and `images` (h, w, 3) of the training views, in the order in which they are asked for."""
        self._rng = np.random.default_rng(seed)
        self._draws = torch.Generator().manual_seed(seed)
        full, depth_from = _depth_everywhere(pointmaps, images if config.depth.weight or config.normal.weight else ())
        self._training = [_known_from(pointmap, config.min_confidence) for pointmap in full]
        self._perceptual = load_perceptual() if config.point_render.weight else None
        self._encode: Encoder | None = load_dino() if config.semantic.weight else None
        self.served_by = _served_by(config, self._perceptual, depth_from, self._encode)
        self._config = config if self._encode is not None else msgspec.structs.replace(config, semantic=Term())
        with torch.no_grad():
            self._embeddings = [] if self._encode is None else [self._encode(_unit(image)) for image in images]
        imagining = len(pointmaps) > 1 and any(term.weight for term in self._config.terms)
        self._pseudo = self._imagine(pointmaps, images) if imagining else []

    def channels(self, progress: float) -> tuple[str, ...]:
        """What has to be rendered at this progress in [0, 1], beside the colours."""
        config = self._config
        depth, normal = config.depth.at(progress) > 0, config.normal.at(progress) > 0
        return ("rgb", *(("depth",) if depth else ()), *(("normal",) if normal else ()))

    def training_loss(self, index: int, render: Render, progress: float) -> Tensor | None:
        """The geometric terms (equation 11) on training view `index`; None while none is active."""
        return self._geometric(render, self._training[index], progress)

    def pseudo_loss(self, draw: Callable[[PseudoView, Collection[str]], Render], progress: float) -> Tensor | None:
        """All terms on a pseudo view drawn at random, as `draw` renders it; None while none is active."""
        config = self._config
        if not self._pseudo or not any(term.at(progress) for term in config.terms):
            return None
        imagined = self._pseudo[int(self._rng.integers(len(self._pseudo)))]
        render = draw(imagined.view, self.channels(progress))
        assert render.rgb is not None  # it was asked for
        parts = [self._geometric(render, imagined.known, progress)]
        if imagined.looks is not None and (weight := config.point_render.at(progress)):
            shown = render.rgb if config.compare_unseen else torch.where(imagined.seen, render.rgb, 1.0)
            parts.append(weight * imagined.looks(shown))
        if self._encode is not None and (weight := config.semantic.at(progress)):
            embedding = self._encode(render.rgb)
            parts.append(weight * semantic_loss(embedding, self._embeddings[imagined.view.nearest]))
        losses = [part for part in parts if part is not None]
        return torch.stack(losses).sum() if losses else None

    def _geometric(self, render: Render, known: _Known, progress: float) -> Tensor | None:
        config = self._config
        parts = []
        if render.depth is not None and (weight := config.depth.at(progress)):
            known_depth, weights = _at_size(known.depth, render.depth), _at_size(known.weights, render.depth)
            patch, share = config.depth_patch, config.depth_share
            parts.append(
                weight
                * local_depth_loss(render.depth, known_depth, weights, patch=patch, share=share, generator=self._draws)
            )
        if render.normal is not None and (weight := config.normal.at(progress)):
            normal, weights = _at_size(known.normal, render.normal), _at_size(known.weights, render.normal)
            parts.append(weight * normal_loss(render.normal, normal, weights))
        return torch.stack(parts).sum() if parts else None

    def _imagine(self, pointmaps: Sequence[Pointmap], images: Sequence[npt.NDArray[np.uint8]]) -> list[_Imagined]:
        config = self._config
        cloud = _cloud(pointmaps, images, config.min_confidence)
        views = pseudo_views(
            [pointmap.T_world_camera for pointmap in pointmaps],
            [pointmap.K for pointmap in pointmaps],
            [(pointmap.depth.shape[1], pointmap.depth.shape[0]) for pointmap in pointmaps],
            config.pseudo_views,
            off_path=config.off_path,
            rng=self._rng,
        )
        imagined = []
        for view in views:
            shown = render_points(
                *cloud, view.T_world_camera, view.K, view.width, view.height, nearest=config.nearest_points
            )
            looks = None if self._perceptual is None else self._perceptual.prepared(torch.from_numpy(shown.rgb))
            seen = torch.from_numpy(shown.seen)[..., None]
            imagined.append(_Imagined(view, _known_from_points(shown), looks, seen))
        return imagined


def _served_by(
    config: Config, perceptual: Perceptual | None, depth_from: str, encode: Encoder | None
) -> dict[str, str]:
    """Which network or measure each active term used, for the report."""
    served = {}
    if perceptual is not None:
        served["point_render"] = perceptual.name
    if config.depth.weight:
        served["depth"] = depth_from
    if config.normal.weight:
        served["normal"] = f"normals of the {depth_from}"
    if config.semantic.weight:
        served["semantic"] = "nothing: no weights" if encode is None else encode.name
    return served


def _depth_everywhere(
    pointmaps: Sequence[Pointmap], images: Sequence[npt.NDArray[np.uint8]]
) -> tuple[Sequence[Pointmap], str]:
    """Point maps with the depth that a network sees in each of `images`, where there is one; and whose depth it is.

    The network never serves without `images`, nor in a view that contradicts it.
    """
    network = load_relative() if images else None
    if network is None:
        return pointmaps, "multi-view depth"
    full = [with_monocular(pointmap, image, network) for pointmap, image in zip(pointmaps, images, strict=True)]
    changed = sum(new is not old for new, old in zip(full, pointmaps, strict=True))
    return full, f"depth of {network.name} (in {changed} of {len(full)} views, scaled by multi-view depth)"


def _cloud(
    pointmaps: Sequence[Pointmap], images: Sequence[npt.NDArray[np.uint8]], min_confidence: float
) -> tuple[npt.NDArray[np.float32], npt.NDArray[np.float32], npt.NDArray[np.float32]]:
    """Points (M, 3), colours (M, 3) and world normals (M, 3) of all confident pixels."""
    points, colours, normals = [], [], []
    for pointmap, image in zip(pointmaps, images, strict=True):
        sure = (pointmap.confidence >= min_confidence) & (pointmap.depth > 0)
        points.append(pointmap.points[sure])
        colours.append(image[sure].astype(np.float32) / 255.0)
        normals.append((pointmap.normal[sure] @ pointmap.T_world_camera[:3, :3].T).astype(np.float32))
    return np.concatenate(points), np.concatenate(colours), np.concatenate(normals)


def _known_from(pointmap: Pointmap, min_confidence: float) -> _Known:
    sure = (pointmap.confidence >= min_confidence) & (pointmap.depth > 0)
    weights = np.where(sure, pointmap.confidence, 0).astype(np.float32)
    return _Known(*(torch.from_numpy(array) for array in (pointmap.depth, pointmap.normal, weights)))


def _known_from_points(shown: PointRender) -> _Known:
    weights = shown.seen.astype(np.float32)
    return _Known(*(torch.from_numpy(array) for array in (shown.depth, shown.normal, weights)))


def _at_size(known: Tensor, render: Tensor) -> Tensor:
    """`known` (h, w, ...) sampled at the pixels of `render` (H, W, ...), which shows the same at another size."""
    if known.shape == render.shape:
        return known
    rows, columns = (
        ((torch.arange(size) + 0.5) * full / size).long()
        for size, full in zip(render.shape[:2], known.shape[:2], strict=True)
    )
    return known[rows][:, columns]


def _unit(image: npt.NDArray[np.uint8]) -> Tensor:
    return torch.from_numpy(image).float() / 255.0
