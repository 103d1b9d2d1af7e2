"""Small recordings as folders of photographs: windows of the real scenes, and the built-in capture with seeds."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import cv2
import numpy as np

from splatnode.capture.cameras import synthetic
from splatnode.capture.cameras.folder import image_paths
from splatnode.capture.image_file import encode_png
from tests.bench.node.trial import expect

VIEWS = 3  # of a window, one behind the other
LONGER_SIDE = 224  # pixels
_BUILT_IN_VIEWS = 4


def write_windows(scenes: Path, count: int, out: Path) -> None:
    """A folder for each window in `out`; the scenes give as many as each other, evenly spread over their photographs.

    Raises AssertionError where there are not so many windows.
    """
    by_scene = {each.name: image_paths(each / "images") for each in sorted(scenes.iterdir()) if each.is_dir()}
    starts = _starts({name: len(paths) - VIEWS + 1 for name, paths in by_scene.items()}, count)
    for name, start in starts:
        folder = out / f"{name}_{start:02d}"
        folder.mkdir(parents=True)
        for path in by_scene[name][start : start + VIEWS]:
            image = cv2.imread(str(path))
            assert image is not None
            scale = LONGER_SIDE / max(image.shape)
            small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            cv2.imwrite(str(folder / f"{path.stem}.png"), small)


def _starts(windows: dict[str, int], count: int) -> Sequence[tuple[str, int]]:
    """`count` scenes and first photographs; `windows` says how many each scene has."""
    expect(count <= sum(windows.values()), f"there are {sum(windows.values())} windows, {count} are asked for")
    shares = dict.fromkeys(windows, 0)
    while sum(shares.values()) < count:
        open_ones = [name for name in windows if shares[name] < windows[name]]
        shares[min(open_ones, key=lambda name: shares[name])] += 1
    return [
        (name, int(start))
        for name, share in shares.items()
        for start in np.linspace(0, windows[name] - 1, share).round()
    ]


def write_built_in(count: int, out: Path) -> None:
    """A folder for each seed from 0 on."""
    for seed in range(count):
        folder = out / f"built_in_{seed:03d}"
        folder.mkdir(parents=True)
        place = synthetic.Config(seed=seed, views=_BUILT_IN_VIEWS, width=LONGER_SIDE, height=LONGER_SIDE * 3 // 4)
        for frame in synthetic.stream(place):
            (folder / frame.name).write_bytes(encode_png(frame.image))
