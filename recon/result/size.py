"""How much a result takes on the disk, before it is made."""

from __future__ import annotations

from collections.abc import Iterable

BYTES_A_GAUSSIAN = 124  # 68 in scene.ply, 46 to 50 in colmap/points3D.txt, 4 in sources.bin
OTHER_BYTES = 2_000_000  # preview.png (1.2 MB measured at most), report and cameras
DEPTH_BYTES = 130_000  # a photograph of 512 x 384 pixels, of depth.npz, before it is packed
LANDMARK_BYTES = 310_000  # a photograph, of landmarks.npz: 2000 descriptors and their points, before they are packed
# Photographs of real scenes led to a Gaussian for 28 to 60 pixels; four times as many are allowed for.
PIXELS_A_GAUSSIAN = 8


def bound_result_bytes(sizes: Iterable[tuple[int, int]], longer_side: int, most_gaussians: int | None) -> int:
    """Bytes that the result of photographs of these `sizes` (width, height) stays below.

    `longer_side` of the modelled images is in pixels; `most_gaussians` is the limit that was set, if any.
    """
    known = list(sizes)
    pixels = sum(longer_side**2 * min(size) / max(size) for size in known)
    expected = round(pixels / PIXELS_A_GAUSSIAN)
    num_gaussians = expected if most_gaussians is None else min(expected, most_gaussians)
    return estimate_result_bytes(num_gaussians, len(known))


def estimate_result_bytes(num_gaussians: int, num_photographs: int = 0) -> int:
    """Bytes of a result folder with so many Gaussians, and with what is kept of so many photographs, rounded up."""
    return BYTES_A_GAUSSIAN * num_gaussians + (LANDMARK_BYTES + DEPTH_BYTES) * num_photographs + OTHER_BYTES
