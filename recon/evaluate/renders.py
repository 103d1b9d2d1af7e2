"""Renders of test views beside their photographs, as files that report.html shows."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from torch import Tensor

from splatnode.capture.image_file import encode_jpeg
from splatnode.recon.evaluate.protocol import Row

FOLDER = "renders"
PHOTOGRAPH = "photograph.jpg"
_QUALITY = 90


@dataclass(frozen=True)
class Renders:
    """The renders of one run. The test views in `shown` are files, by path in the benchmark's folder."""

    scene: str
    views: int
    method: str
    seed: int
    shown: tuple[str, ...]
    files: dict[str, bytes] = field(default_factory=dict)

    def keep(self, name: str, truth: Tensor, image: Tensor) -> None:
        """A `recon.evaluate.protocol.Show`."""
        if name in self.shown:
            folder = f"{FOLDER}/{self.scene}-{self.views}/{Path(name).stem}"
            self.files[f"{folder}/{PHOTOGRAPH}"] = _encode_jpeg(truth)
            self.files[f"{folder}/{self.method}-{self.seed}.jpg"] = _encode_jpeg(image)


def find_renders(out_dir: Path, row: Row) -> dict[str, Path]:
    """The render of each kept test view, by the view's name, for the run that `row` ends; none if nothing was kept.

    Nor are there any of a run that was not scored: what lies there is of an earlier run.
    """
    if row.psnr is None:
        return {}
    found = (out_dir / FOLDER / f"{row.scene}-{row.views}").glob(f"*/{row.method}-{row.seed}.jpg")
    return {path.parent.name: path for path in sorted(found)}


def _encode_jpeg(image: Tensor) -> bytes:
    pixels = np.rint(image.numpy() * 255).astype(np.uint8)
    return encode_jpeg(pixels, _QUALITY)
