"""NeRF-- (Wang et al. 2021): cameras, their focal length and a radiance field learnt together from nothing else.

As published: all cameras start at the origin and look ahead, the focal length starts as the image's size, samples are
spaced as in normalised device coordinates, without a hierarchy. Compact: 1500 iterations of 384 rays, where 10 000
epochs take 1024 rays of every photograph, and step sizes of 5e-3 and 3e-3 for 1e-3 in their stead; 32 samples a ray for
128; three layers of 64 for eight of 128; photographs of 256 pixels. Our first camera stays at the origin. Twice as many
iterations change nothing: on llff_fern the cameras stand after 600, where their focal length and turns are wrong.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import torch

from splatnode.capture.frame import Frame
from splatnode.extras.evaluate.rivals import outcome, radiance_field
from splatnode.extras.evaluate.rivals.radiance_field import Focal, make_field_snapshot
from splatnode.recon.keyframes import resize_image, resize_mask
from splatnode.recon.result.snapshot import Snapshot
from splatnode.recon.threads import Clock

SIZE = 256  # longer side of the photographs, pixels
OPTIMIZE = radiance_field.FitConfig()


def reconstruct(frames: Sequence[Frame], seed: int, config: radiance_field.FitConfig = OPTIMIZE) -> Iterator[Snapshot]:
    """Snapshots of the field while it is learnt."""
    clock = Clock()
    if len(frames) < outcome.MIN_CAMERAS:
        yield outcome.make_refusal(frames, clock)
        return
    images = [torch.from_numpy(resize_image(frame.image, SIZE)).float() / 255.0 for frame in frames]
    used = [
        None if frame.mask is None else torch.from_numpy(resize_mask(frame.mask, *image.shape[:2]))
        for frame, image in zip(frames, images, strict=True)
    ]
    learnt = radiance_field.fit_field(images, used, Focal(1.0), config, seed=seed)
    yield from outcome.number_snapshots((make_field_snapshot(frames, frames, each) for each in learnt), clock)
