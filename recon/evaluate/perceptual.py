"""The networks that tell how alike two images look; without their weights nothing is measured."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from splatnode.recon.networks.lpips import Lpips, load_lpips


@dataclass(frozen=True, eq=False)
class PerceptualNetworks:
    """The perceptual metrics for which there are weights."""

    alex: Lpips | None
    vgg: Lpips | None

    @property
    def quickest(self) -> PerceptualNetworks:
        """Without VGG, which takes twenty times as long as AlexNet, where the other serves."""
        return self if self.alex is None else PerceptualNetworks(self.alex, None)


def load_networks(weights_dir: Path | None = None) -> PerceptualNetworks:
    return PerceptualNetworks(load_lpips("alex", weights_dir), load_lpips("vgg", weights_dir))


def create_empty_networks() -> PerceptualNetworks:
    """For who measures nothing that needs them."""
    return PerceptualNetworks(None, None)
