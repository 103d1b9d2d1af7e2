"""The dense prediction transformer's decoder: tokens of four layers, fused from coarse to fine into an image.

"Vision Transformers for Dense Prediction" (Ranftl et al. 2021). Attributes carry the checkpoint's names.
"""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor, nn

from splatnode.recon.networks.feature_fusion import Fusion

_WIDTH = 256  # of the fused features
_LAYER_WIDTHS = (96, 192, 384, 768)


class DensePrediction(nn.Module):
    """From tokens of four layers to an image of `channels` at the size of the photograph."""

    def __init__(self, encoder_width: int, decoder_width: int, decoder_depth: int, channels: int) -> None:
        super().__init__()
        self._hooks = (0, decoder_depth // 2, decoder_depth * 3 // 4, decoder_depth)
        w1, w2, w3, w4 = _LAYER_WIDTHS
        self.act_postprocess = nn.ModuleList(
            [
                nn.Sequential(nn.Conv2d(encoder_width, w1, 1), nn.ConvTranspose2d(w1, w1, 4, stride=4)),
                nn.Sequential(nn.Conv2d(decoder_width, w2, 1), nn.ConvTranspose2d(w2, w2, 2, stride=2)),
                nn.Sequential(nn.Conv2d(decoder_width, w3, 1)),
                nn.Sequential(nn.Conv2d(decoder_width, w4, 1), nn.Conv2d(w4, w4, 3, stride=2, padding=1)),
            ]
        )
        self.scratch = _Scratch()
        self.head = nn.Sequential(
            nn.Conv2d(_WIDTH, _WIDTH // 2, 3, padding=1),
            nn.Upsample(scale_factor=2, mode="bilinear", align_corners=True),
            nn.Conv2d(_WIDTH // 2, _WIDTH // 2, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(_WIDTH // 2, channels, 1),
        )

    def forward(self, layers: Sequence[Tensor], rows: int, columns: int) -> Tensor:
        """(channels, 16 rows, 16 columns) from the tokens (rows * columns, C) of every decoder layer.

        `layers` starts with the encoder's tokens.
        """
        images = [layers[hook].T.unflatten(1, (rows, columns))[None] for hook in self._hooks]
        images = [adapt(image) for adapt, image in zip(self.act_postprocess, images, strict=True)]
        images = [reduce(image) for reduce, image in zip(self.scratch.layer_rn, images, strict=True)]
        fused = self.scratch.refinenet4(images[3])[:, :, : images[2].shape[2], : images[2].shape[3]]
        fused = self.scratch.refinenet3(fused, images[2])
        fused = self.scratch.refinenet2(fused, images[1])
        fused = self.scratch.refinenet1(fused, images[0])
        return self.head(fused)[0]


class _Scratch(nn.Module):
    """Layers that fuse four feature maps at one width. The checkpoint names each `layer_rn` twice."""

    def __init__(self) -> None:
        super().__init__()
        reduce = [nn.Conv2d(width, _WIDTH, 3, padding=1, bias=False) for width in _LAYER_WIDTHS]
        self.layer1_rn, self.layer2_rn, self.layer3_rn, self.layer4_rn = reduce
        self.layer_rn = nn.ModuleList(reduce)
        self.refinenet1, self.refinenet2, self.refinenet3, self.refinenet4 = (Fusion(_WIDTH) for _ in range(4))
