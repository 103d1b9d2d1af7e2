"""Held-out photographs as they are scored: which pixels of them count."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from splatnode.capture.frame import Intrinsics
from splatnode.recon.evaluate.same_lens import undistort_view
from splatnode.recon.evaluate.splits import Split
from splatnode.recon.evaluate.truth import EvaluationScene
from splatnode.recon.frames import border
from splatnode.recon.frames.keyframe import resize_image, resize_mask


@dataclass(frozen=True, eq=False)
class HeldOutView:
    name: str
    photograph: Tensor  # (H, W, 3) in [0, 1]
    used: Tensor  # (H, W) False where a mask hides it
    shown: tuple[slice, slice]  # rows and columns without a black rim

    @property
    def comparison_mask(self) -> Tensor | None:
        """(h, w) which pixels count of what is shown; None: all."""
        used = self.used[self.shown]
        return None if used.all() else used


def load_held_out_views(
    scene: EvaluationScene, split: Split, lens: Intrinsics | None, longer_side: int
) -> Iterator[HeldOutView]:
    """The test views with a true camera, without the distortion of `lens`; none of which a mask hides all."""
    names = [name for name in split.test if name in scene.cameras]
    given = [undistort_view(lens, *scene.load_masked_image(name)) for name in names]
    photographs = [resize_image(image, longer_side) for image, _ in given]
    rims = border.valid_masks(photographs)
    for name, photograph, valid, (_, mask) in zip(names, photographs, rims, given, strict=True):
        used = torch.from_numpy(resize_mask(mask, *photograph.shape[:2]))
        shown = border.valid_rectangle(valid)
        if used[shown].any():
            yield HeldOutView(name, torch.from_numpy(photograph).float() / 255.0, used, shown)
