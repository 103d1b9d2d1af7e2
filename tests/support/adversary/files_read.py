"""The boundaries of files that others wrote: lenses, poses, logs, archives, data sets, weights, masks, EXIF."""

from __future__ import annotations

import itertools
import random
from collections.abc import Callable
from pathlib import Path

import numpy as np

from splatnode.capture import image_header
from splatnode.capture.depth_image import make_depth_image
from splatnode.capture.frame import Clock, Frame, Stamp
from splatnode.capture.image_file import ORIENTATION, check_whole, measure_values, upright_size
from splatnode.capture.image_header import UnusableImage, exif_time
from splatnode.capture.lenses import UnusableLens, read_lens
from splatnode.capture.masks import UnusableMask, apply_mask, read_mask
from splatnode.capture.pose_files import PosesFileError, read_poses
from splatnode.capture.process.text import guard_untrusted
from splatnode.extras import lerobot
from splatnode.extras.cameras import mcap
from splatnode.extras.logged.messages import (
    CALIBRATIONS,
    PICTURES,
    Calibration,
    UnusableMessage,
    decode_depth,
    is_depth_image,
    lens,
    rgb,
)
from splatnode.recon.result.export.limits import SceneFileError
from splatnode.recon.result.stored_snapshot import decode_depths, decode_landmarks
from tests.support.adversary import archives, images, lenses, logs, poses, stored
from tests.support.adversary.boundary import Boundary, Reader

_MAX_PIXELS = 4_000_000
_CAPTURE, _RESULT = "splatnode.capture", "splatnode.recon.result"
_IMAGE = np.zeros((12, 16, 3), np.uint8)
_FRAMES = tuple(
    Frame(index, f"view_{index}.png", index, _IMAGE, None, captured_at=at)
    for index, at in enumerate((None, Stamp(1_700_000_000 * 10**9, Clock.UTC), Stamp(10**9, Clock.RECORDING)))
)
_KINDS = {
    "compressed cdr": PICTURES["sensor_msgs/msg/CompressedImage", "cdr"],
    "raw cdr": PICTURES["sensor_msgs/msg/Image", "cdr"],
    "calibration cdr": CALIBRATIONS["sensor_msgs/msg/CameraInfo", "cdr"],
    "compressed json": PICTURES["foxglove.CompressedImage", "json"],
    "raw json": PICTURES["foxglove.RawImage", "json"],
    "calibration json": CALIBRATIONS["foxglove.CameraCalibration", "json"],
    "compressed protobuf": PICTURES["foxglove.CompressedImage", "protobuf"],
    "raw protobuf": PICTURES["foxglove.RawImage", "protobuf"],
    "calibration protobuf": CALIBRATIONS["foxglove.CameraCalibration", "protobuf"],
    "depth cdr": PICTURES["sensor_msgs/msg/CompressedImage", "cdr"],
}


def written(name: str, read: Callable[[Path], object]) -> Callable[[bytes, Path], object]:
    """Reads a file of this name, which is written anew for each case."""

    def reading(data: bytes, folder: Path) -> object:
        path = folder / name
        path.write_bytes(data)
        return read(path)

    return reading


def _read_poses(files: stored.Files, folder: Path) -> object:
    stored.lay(files, folder)
    trajectory = read_poses(folder / next(iter(files)))
    return trajectory, trajectory.find_poses(_FRAMES)


def _read_exif(tiff: bytes, folder: Path) -> object:
    tags = image_header.read_tags(tiff)
    told = image_header.exif_intrinsics(tags, 4000, 3000), image_header.exif_exposure(tags), exif_time(tiff)
    return told, image_header.first(tags, ORIENTATION), image_header.camera_identity(tiff)


def _read_header(data: bytes, folder: Path) -> object:
    check_whole(data)
    size = upright_size(data)
    if size is None and image_header.is_jpeg2000(data):
        return image_header.read_size(data)
    return size


def _draw_header(rng: random.Random) -> bytes:
    """Images of all kinds, those that are decoded in a process of their own, too: here only their headers are read."""
    if rng.random() < 0.85:
        return images.image(rng)
    if rng.random() < 0.5:
        sides = b"".join(rng.choice((0, 1, 16, 2**31, 2**32 - 1)).to_bytes(4, "big") for _ in range(4))
        boxes = rng.choice((b"\0\0\0\x0cjP  \r\n\x87\n", b"")) + b"\xff\x4f\xff\x51\0\x29\0\0" + sides
        return boxes + rng.randbytes(20) + rng.choice((b"\xff\xd9", b""))
    box = rng.choice((0, 1, 8, 16, 24, 2**32 - 1)).to_bytes(4, "big")
    kind = rng.choice((b"ftypheic", b"ftypavif", b"ftypmif1"))
    inner = rng.choice((0, 1, 8, 30, 2**32 - 1)).to_bytes(4, "big") + rng.choice((b"meta", b"mdat", b"free"))
    return box + kind + bytes(8) + inner + rng.randbytes(rng.choice((0, 8, 40)))


def _measure(data: bytes, folder: Path) -> object:
    return measure_values(data, _MAX_PIXELS)


def _read_logged(case: tuple[bytes, bytes], folder: Path) -> object:
    kind, data = case
    with guard_untrusted(UnusableMessage):
        found = _KINDS[kind.decode() if kind.decode("ascii", "replace") in _KINDS else "raw cdr"](data)
        if isinstance(found, Calibration):
            return lens("/front/image_rect", found), lens("/front/image_raw", found)
        if is_depth_image(found):
            return make_depth_image(decode_depth(found)).metres
        return rgb(found, _MAX_PIXELS)


def _read_mcap(path: Path) -> object:
    return list(itertools.islice(mcap.stream(mcap.Config(path, max_pixels=_MAX_PIXELS)), 20))


def _read_data_set(files: stored.Files, folder: Path) -> object:
    (folder / "meta" / "episodes" / "chunk-000").mkdir(parents=True, exist_ok=True)
    (folder / lerobot.INFO).write_bytes(files["info.json"] or b"")
    (folder / lerobot.EPISODES / "chunk-000" / "file-000.parquet").write_bytes(files["file-000.parquet"] or b"")
    found = [lerobot.film(folder, part) for part in lerobot.list_parts(folder)[:2]]
    if any(folder not in film.video.parents for film in found):
        raise AssertionError(f"leads out of the folder: {[film.video for film in found]}")
    return found


def _read_weights(files: stored.Files, folder: Path) -> object:
    from splatnode.recon.networks import read_weights

    stored.lay(files, folder)
    return [tuple(tensor.shape) for tensor in read_weights(folder / next(iter(files))).values()]


def _read_mask(data: bytes, folder: Path) -> object:
    path = folder / "view_0.png"
    path.write_bytes(data)
    return apply_mask(_FRAMES[0], read_mask(path, _FRAMES[0]))


def _draw_exif(rng: random.Random) -> bytes:
    return images.tiff(rng)


def _modules(*names: str) -> tuple[str, ...]:
    return tuple(f"{_CAPTURE}.{name}" for name in names)


_LENSES = Reader((UnusableLens,), _modules("lenses"))
_POSES = Reader((PosesFileError,), _modules("poses_file", "colmap_images"))
_EXIF = Reader((), _modules("image_header"))
_HEADERS = Reader((UnusableImage,), _modules("image_header", "image_file"))
_LOGGED = Reader(
    (UnusableMessage,), tuple(f"splatnode.extras.logged.{name}" for name in ("messages", "depth_messages"))
)
_MCAP = Reader(
    (ValueError,),
    ("splatnode.extras.cameras.mcap", *(f"splatnode.extras.logged.{name}" for name in ("mcap", "depth_topics"))),
)
_DATA_SETS = Reader((lerobot.UnusableDataSet,), ("splatnode.extras.lerobot",))
_MASKS = Reader((UnusableMask,), _modules("masks"))
_LANDMARKS = Reader((SceneFileError,), (f"{_RESULT}.landmarks_file", f"{_RESULT}.npz_file"))
_DEPTHS = Reader((SceneFileError,), (f"{_RESULT}.depth_file",))
_WEIGHTS = Reader((ValueError,), ("splatnode.recon.networks",))


def _read_landmarks(data: bytes, folder: Path) -> object:
    return decode_landmarks(data)


def _read_depths(data: bytes, folder: Path) -> object:
    return decode_depths(data)


FILES = (
    Boundary(
        "lenses", lenses.lens_file, written("lens.yaml", read_lens), _LENSES, 20, 1, mutants=2, tidy=False, printed=True
    ),
    Boundary("poses", poses.poses_file, _read_poses, _POSES, 20, 1, mutants=3),
    Boundary("exif", _draw_exif, _read_exif, _EXIF, 10, 4, mutants=3, tidy=False),
    Boundary("image headers", _draw_header, _read_header, _HEADERS, 20, 6, mutants=3, tidy=False),
    Boundary("deep images", images.tiff, _measure, _HEADERS, 100, 0.5, mutants=1, tidy=False),
    Boundary("logged messages", logs.logged, _read_logged, _LOGGED, 100, 3, mutants=3, tidy=False),
    Boundary("mcap files", logs.mcap, written("drive.mcap", _read_mcap), _MCAP, 100, 0.1, mutants=1, tidy=False),
    # Each is read in a process of its own, which takes as long as thousands of other cases.
    Boundary("data sets", archives.data_set, _read_data_set, _DATA_SETS, 100, 0.01, tidy=False),
    Boundary("masks", images.image, _read_mask, _MASKS, 100, 0.5, mutants=1, tidy=False),
    Boundary("landmarks", archives.landmarks, _read_landmarks, _LANDMARKS, 100, 0.3, mutants=1, tidy=False),
    Boundary("depths", archives.depths, _read_depths, _DEPTHS, 100, 0.3, mutants=1, tidy=False),
    Boundary("weights", archives.weights, _read_weights, _WEIGHTS, 100, 0.1, mutants=1),
)
