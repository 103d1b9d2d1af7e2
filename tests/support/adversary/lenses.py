"""Files that give a lens: our YAML, a camchain of Kalibr, COLMAP's cameras.txt, and OpenCV's own."""

from __future__ import annotations

import random

from tests.support.adversary import edges

_MODELS = {
    "SIMPLE_PINHOLE": 3,
    "PINHOLE": 4,
    "SIMPLE_RADIAL": 4,
    "RADIAL": 5,
    "OPENCV": 8,
    "FULL_OPENCV": 12,
    "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5,
    "OPENCV_FISHEYE": 8,
    "THIN_PRISM_FISHEYE": 12,
}
_KINDS = ("radtan", "equidistant", "none", "fov", "~", "[radtan]")


def lens_file(rng: random.Random) -> bytes:
    """In half of the files everything is sound; in the others some of the numbers and words are not."""
    share = rng.choice((0.0, 0.0, 0.05, 0.3))
    text = rng.choice((_colmap, _colmap, _colmap, _ours, _kalibr))(rng, share)
    if rng.random() < 0.02:
        text = rng.choice(("%YAML:1.0\n", "\ufeff", "[" * 500, "&a [*a]\n", "--- a\n--- b\n", "#\n", "\t")) + text
    return text.encode("utf-8", "surrogatepass")


def _colmap(rng: random.Random, share: float) -> str:
    model = rng.choice(list(_MODELS))
    numbers = [edges.odd(rng, usual, share) for usual in (20.0, 20.0, 8.0, 6.0, *[0.01] * 8)[: _MODELS[model]]]
    words = [edges.odd(rng, usual, share) for usual in (1, model, 16, 12)] + numbers
    if rng.random() < share:
        words.insert(rng.randrange(len(words) + 1), edges.number_text(rng))
    line = " ".join(words)
    return "# cameras\n" + "\n".join([line] * rng.choice((1, 1, 2))) + "\n"


def _ours(rng: random.Random, share: float) -> str:
    fields = {"width": 16, "height": 12, "fx": 20.0, "fy": 20.0, "cx": 8.0, "cy": 6.0}
    lines = [f"{name}: {edges.odd(rng, usual, share)}" for name, usual in fields.items()]
    if rng.random() < 0.5:
        terms = ", ".join(edges.odd(rng, 0.01, share) for _ in range(rng.choice((0, 1, 4, 5, 8, 14, 40))))
        lines.append(f"distortion: [{terms}]")
    if rng.random() < 0.3:
        lines.append(f"kind: {edges.odd(rng, 'fisheye', share)}")
    if rng.random() < share:
        lines.append(f"{edges.odd(rng, 'width', 0.5)}: {edges.number_text(rng)}")
    if rng.random() < 0.2:
        return "intrinsics:\n" + "".join(f"  {line}\n" for line in lines)
    return "\n".join(lines) + "\n"


def _kalibr(rng: random.Random, share: float) -> str:
    lines = ["cam0:"]
    four = ", ".join(edges.odd(rng, usual, share) for usual in (20.0, 20.0, 8.0, 6.0))
    terms = ", ".join(edges.odd(rng, 0.01, share) for _ in range(4 if rng.random() >= share else rng.choice((0, 5))))
    lines += [
        f"  camera_model: {edges.odd(rng, 'pinhole', share)}",
        f"  intrinsics: [{four}]",
        f"  distortion_model: {rng.choice(_KINDS[:2] if rng.random() >= share else _KINDS)}",
        f"  distortion_coeffs: [{terms}]",
        f"  resolution: [{edges.odd(rng, 16, share)}, {edges.odd(rng, 12, share)}]",
    ]
    if rng.random() < share:
        del lines[rng.randrange(1, len(lines))]
    return "\n".join(lines) + "\n"
