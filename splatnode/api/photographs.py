"""Photographs as a program has them: files or arrays, with their depth; and where a further one was taken."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from os import PathLike, fspath
from pathlib import Path
from typing import Any, TypeAlias, cast

import numpy as np
import numpy.typing as npt

from splatnode.api.arguments import DepthOf, Lens, check_camera_id, make_intrinsics, parse_optional_depth
from splatnode.capture.cameras.folder import SUFFIXES, describe_value_range, frame_name, name_photographs
from splatnode.capture.depth_image import DepthImage, find_depth_files
from splatnode.capture.frame import DroppedFrame, Frame, Intrinsics, Stamp, rigid_problem
from splatnode.capture.image_file import (
    ORIENTATION,
    Extent,
    ValueRange,
    convert_to_eight_bits,
    find_range,
    measure_extent,
    upright,
)
from splatnode.capture.image_header import exif_exposure, exif_intrinsics, exif_time, read_tags
from splatnode.capture.lenses import ALL, Lenses, find_key
from splatnode.capture.masks import Find, Mask, apply_mask, open_masks, parse_mask, read_mask
from splatnode.capture.process.terminal import Tell, ignore_progress, notify
from splatnode.capture.process.text import sanitize_text
from splatnode.capture.rig import TOLERANCE_S
from splatnode.recon.locating import Located, NotLocated
from splatnode.recon.locating.localize import follow, localize_image
from splatnode.recon.replay_source import (
    Request,
    Source,
    apply_lenses,
    attach_depths,
    load_source,
    parse_sources,
    select_frames,
)
from splatnode.recon.result.snapshot import Landmarks

# Photographs as a program has them: paths, arrays or PIL images, as the frames that are reconstructed.

STEP_NS = 100_000_000  # between two photographs that have no time, as in a folder
_EXIF = b"Exif\0\0"  # before the TIFF structure

# Of the pictures, NumPy arrays (H, W, 3) uint8 RGB, or PIL images; other shapes are told at `make_rgb_image`.
Picture: TypeAlias = Any
Images: TypeAlias = "str | PathLike[str] | Picture | Sequence[str | PathLike[str]] | Sequence[Picture]"
LensChoice: TypeAlias = "Lens | Sequence[Lens | None] | Mapping[str, Lens]"


@dataclass(frozen=True)
class SeveralCameras:
    """The words of a program about several cameras: which are used, or which took which image and when."""

    cameras: str | Sequence[str] | None = None  # as `--cameras`
    camera_ids: Sequence[str | None] | None = None  # of each listed image
    captured_at: Sequence[Stamp | None] | None = None  # likewise
    tolerance_s: float = TOLERANCE_S  # between images of a frame set

    def describe_images(self, names: Sequence[str]) -> dict[str, tuple[str, Stamp | None]]:
        """The camera id and the time of each listed image by its name. Raises TypeError, ValueError."""
        for what, values in (("camera_ids", self.camera_ids), ("captured_at", self.captured_at)):
            if values is not None and (isinstance(values, str) or len(values) != len(names)):
                count = "a text" if isinstance(values, str) else len(values)
                raise ValueError(f"{what} must be one for each of the {len(names)} images, got {count}")
        ids, stamps = self.camera_ids or [None] * len(names), self.captured_at or [None] * len(names)
        for camera in ids:
            check_camera_id("" if camera is None else camera, "each of camera_ids")
        return {name: (camera or "", stamp) for name, camera, stamp in zip(names, ids, stamps, strict=True)}

    def apply(
        self, each: Frame | DroppedFrame, descriptions: Mapping[str, tuple[str, Stamp | None]]
    ) -> Frame | DroppedFrame:
        """The frame with its camera id and its time, where they were told."""
        if not isinstance(each, Frame) or each.name not in descriptions:
            return each
        camera_id, stamp = descriptions[each.name]
        return replace(each, camera_id=camera_id or each.camera_id, captured_at=stamp or each.captured_at)


def load_frames(
    images: Images, views: int | None, every_frame: bool, tell: Tell, several: SeveralCameras | None = None
) -> Source:
    """The frames of a folder, of files, of a video, or of pictures. Raises TypeError, ValueError, FileNotFoundError."""
    given, several = list_images(images), several or SeveralCameras()
    paths = [isinstance(each, (str, PathLike)) for each in given]
    listing = several.camera_ids is not None or several.captured_at is not None
    if listing and several.cameras is not None:
        raise TypeError(
            "cameras are those of a folder or a film, camera_ids those of a list of images: give one of them"
        )
    descriptions = several.describe_images(names_of(images)) if listing else {}
    if all(paths):
        wanted = (several.cameras,) if isinstance(several.cameras, str) else several.cameras
        path, listed, cameras = parse_sources([Path(each) for each in given], wanted, several.tolerance_s)
        found = load_source(Request(path, listed, views, every_frame=every_frame, cameras=cameras), tell)
        return replace(found, frames=tuple(several.apply(each, descriptions) for each in found.frames))
    if any(paths):
        raise TypeError("images must be all paths or all pictures, got both. Read the files, or write the pictures")
    used = find_range([extent for extent in map(_extent, given) if extent is not None])
    if used is not None:
        tell(describe_value_range(used))
    frames = [
        make_frame(each, index, picture_name(index), index * STEP_NS, used=used) for index, each in enumerate(given)
    ]
    framed = [each for each in (several.apply(frame, descriptions) for frame in frames) if isinstance(each, Frame)]
    return select_frames(framed, views, every_frame, tell, several.tolerance_s)


def picture_name(index: int) -> str:
    """The name of the picture in this place of a list."""
    return f"{index:04d}.png"


def names_of(images: Images) -> list[str]:
    """The names of listed photographs or pictures, in their order. Raises TypeError, ValueError: of a folder, too."""
    given = list_images(images)
    if len(given) == 1 and isinstance(given[0], (str, PathLike)) and Path(given[0]).suffix.lower() not in SUFFIXES:
        raise TypeError("a list goes with a list of photographs, one for each; of a folder or a video, give names")
    if all(isinstance(each, (str, PathLike)) for each in given):
        return name_photographs([Path(fspath(each)) for each in given])  # pyright: ignore[reportArgumentType]
    return [
        frame_name(Path(fspath(each))) if isinstance(each, (str, PathLike)) else picture_name(index)
        for index, each in enumerate(given)
    ]


def make_frame(
    picture: Picture,
    frame_id: int,
    name: str,
    stamp_ns: int,
    captured_at: Stamp | None = None,
    used: ValueRange | None = None,
) -> Frame:
    """A picture as a frame, with what its EXIF tells of lens, time and exposure, without what its alpha hides.

    `used` as for `make_rgb_image`. Raises TypeError, ValueError.
    """
    try:
        image, tiff = make_rgb_image(picture, used), _exif_bytes(picture)
        height, width = image.shape[:2]
        tags, taken_at = read_tags(tiff), captured_at or exif_time(tiff)
        intrinsics, exposure = exif_intrinsics(tags, width, height), exif_exposure(tags)
        made = Frame(frame_id, name, stamp_ns, image, intrinsics, captured_at=taken_at, exposure=exposure)
        mask = _alpha_mask(picture)
        if mask is None:
            return made
        seen = apply_mask(made, mask)
        if isinstance(seen, DroppedFrame):
            raise ValueError(f"its alpha channel hides {100 * (1 - mask.mean()):.1f} % of it: leave alpha out")
        return seen
    except (TypeError, ValueError) as error:
        raise type(error)(f"image {name}: {error}") from error


def make_rgb_image(picture: Picture, used: ValueRange | None = None) -> npt.NDArray[np.uint8]:
    """A copy of a picture (H, W, 3) RGB, treated as a file's: upright, grey as RGB, no alpha.

    Of 16 bits the range `used` becomes 8; None: what this picture uses of them alone.
    An array must be (H, W), (H, W, 1), (H, W, 3) or (H, W, 4), of uint8 or uint16. Raises TypeError, ValueError.
    """
    array = _convert_pil(picture) if _is_pil(picture) else picture
    if not isinstance(array, np.ndarray):
        raise TypeError(f"must be a NumPy array (H, W, 3) uint8 or a PIL image, got {type(picture).__name__}")
    if array.dtype == np.uint16:
        array = convert_to_eight_bits(array, used or find_range([measure_extent(array)] if array.size else []))
    if array.dtype != np.uint8:
        raise TypeError(f"must be uint8, got {array.dtype}. Of floats in [0, 1]: (255 * image).round().astype('uint8')")
    if array.ndim == 2:
        array = array[..., None]
    if array.ndim != 3 or array.shape[2] not in (1, 3, 4):
        raise ValueError(f"must be (H, W, 3), got {array.shape}. Channels come last: image.transpose(1, 2, 0)")
    colours = np.repeat(array, 3, 2) if array.shape[2] == 1 else array[..., :3]
    return np.array(colours, np.uint8, order="C")


def apply_lens(given: Source, lens: LensChoice | None, images: Images) -> Source:
    """Returns the frames with their lenses in place of what their EXIF tells.

    One lens is of all frames of its aspect ratio; a mapping is of images, cameras or patterns, as `Lenses` has it; a
    list has one of each listed image, or None. A matrix (3, 3) is a pinhole's, for photographs of the size of the first
    that it is of. Raises TypeError, ValueError.
    """
    frames = [each for each in given.frames if isinstance(each, Frame)]
    if lens is None or not frames:
        return given
    known = _key_lenses(lens, images)
    by_key: dict[str, Intrinsics] = {}
    for key, each in known.items():
        of_lens = (frame for frame in frames if find_key(known, frame.name, frame.camera, frame.camera_id) == key)
        first = next(of_lens, frames[0])
        by_key[key] = make_intrinsics(each, first.width, first.height)
    return apply_lenses(given, Lenses(by_key))


def _key_lenses(lens: Any, images: Images) -> Mapping[str, Lens]:
    """Returns lenses as they may be given by their keys."""
    if isinstance(lens, Mapping):
        if not lens or not all(isinstance(key, str) for key in lens):
            raise TypeError("intrinsics by name must have names of photographs, cameras or patterns as its keys")
        return lens
    listed = isinstance(lens, (list, tuple)) or (isinstance(lens, np.ndarray) and lens.ndim != 2)
    if not listed or np.shape(lens) == (3, 3):
        return {ALL: cast(Lens, lens)}
    names = names_of(images)
    if len(lens) != len(names):
        raise ValueError(f"intrinsics must be one lens, or as many as there are images, {len(names)}; got {len(lens)}")
    return {name: each for name, each in zip(names, lens, strict=True) if each is not None}


def lenses(frames: Iterable[Any]) -> dict[str, Intrinsics]:
    """Returns the lenses that were given or calibrated, by name."""
    known = {each.name: each.intrinsics for each in frames if isinstance(each, Frame) and each.intrinsics is not None}
    return {name: lens for name, lens in known.items() if lens.source in ("given", "calibration")}


def list_images(images: Any) -> list[Any]:
    """Lists what `images` names, one or several. Raises TypeError, ValueError."""
    one = isinstance(images, (str, PathLike)) or _is_pil(images)
    if one or (isinstance(images, np.ndarray) and images.ndim < 4):
        return [images]
    if not isinstance(images, Iterable):
        raise TypeError(f"images must be a folder, a video, or a list, got {type(images).__name__}")
    given = list(images)
    if not given:
        raise ValueError("images must have at least one photograph, got none")
    return given


def _extent(picture: Picture) -> Extent | None:
    """Measures the extent of the values of a 16-bit picture; None for another one."""
    array = _convert_pil(picture) if _is_pil(picture) else picture
    deep = isinstance(array, np.ndarray) and array.dtype == np.uint16 and array.size
    return measure_extent(array[..., :3] if array.ndim == 3 else array) if deep else None


def _alpha_mask(picture: Picture) -> npt.NDArray[np.bool_] | None:
    """(H, W) where a picture's alpha is above 0; None where it has none, or one that says nothing, as of a file."""
    if _is_pil(picture):
        if "A" not in picture.getbands() and "transparency" not in picture.info:
            return None
        alpha = upright(np.asarray(picture.convert("RGBA"))[..., 3], picture.getexif().get(ORIENTATION, 1))
    elif picture.ndim == 3 and picture.shape[2] == 4:
        alpha = picture[..., 3]
    else:
        return None
    mask = alpha > 0
    return None if mask.all() or not mask.any() else np.ascontiguousarray(mask)


def _is_pil(picture: Any) -> bool:
    """True if the picture has the interface of PIL's images: PIL itself is not needed."""
    return all(hasattr(picture, name) for name in ("convert", "getbands", "mode", "info"))


def _convert_pil(picture: Any) -> npt.NDArray:
    deep = picture.mode.startswith("I;16")
    return upright(np.asarray(picture if deep else picture.convert("RGB")), picture.getexif().get(ORIENTATION, 1))


def _exif_bytes(picture: Any) -> bytes:
    """The TIFF structure of a PIL image's EXIF; empty where it has none."""
    known = picture.info.get("exif", b"") if _is_pil(picture) else b""
    return known.removeprefix(_EXIF) if isinstance(known, bytes) else b""


# Masks as a program has them: a folder, a file, or one for each photograph of a list.

# In a list one for each photograph, in the order of the photographs; None: that one is used whole.
MaskOf: TypeAlias = "str | PathLike[str] | npt.NDArray[Any] | None"
Masks: TypeAlias = "str | PathLike[str] | npt.NDArray[Any] | Sequence[MaskOf]"


def make_mask_finder(masks: Masks, images: Images) -> Find:
    """Finds the mask of a frame of `images`. Raises TypeError, ValueError, FileNotFoundError."""
    if isinstance(masks, (str, PathLike)):
        return open_masks(Path(masks))
    given, of = list_images(images), list(masks)
    if len(given) == 1 and isinstance(given[0], (str, PathLike)) and Path(given[0]).is_dir():
        raise TypeError("masks must be a folder of masks where images is a folder, got a list")
    names = names_of(images)
    if len(of) != len(names):
        raise ValueError(
            f"masks must be one for each of the {len(names)} photographs (None: all is used), got {len(of)}"
        )
    by_name = dict(zip(names, of, strict=True))
    return lambda frame: _mask(by_name.get(frame.name), frame)


def _mask(given: MaskOf, frame: Frame) -> Mask | None:
    if given is None:
        return None
    return read_mask(Path(given), frame) if isinstance(given, (str, PathLike)) else parse_mask(given)


# Depth images as a program has them: arrays, files or records, by the photographs' names or in their order.

log = logging.getLogger(__name__)

Depths: TypeAlias = "str | PathLike[str] | Mapping[str, DepthOf] | Sequence[DepthOf]"


def add_depths(source: Source, depths: Depths | None, images: Images) -> Source:
    """The frames, each with its depth image. Raises TypeError, ValueError, FileNotFoundError."""
    if depths is None:
        return source
    known = _name_depths(depths, images, source)

    def find(frame: Frame) -> DepthImage | None:
        try:
            return parse_optional_depth(known.get(frame.name))
        except (TypeError, ValueError) as error:
            raise type(error)(f"the depth image of {frame.name}: {error}") from error

    return attach_depths(source, find)


def _name_depths(depths: Any, images: Images, source: Source) -> dict[str, Any]:
    """The depth images by the names of their frames."""
    if isinstance(depths, (str, PathLike)):
        return find_depth_files(Path(depths), [frame.name for frame in source.frames])
    if isinstance(depths, Mapping):
        named = {frame_name(Path(name)): each for name, each in depths.items()}
        names = {frame.name for frame in source.frames}
        if not names & named.keys():
            raise ValueError(f"depths are of none of the photographs, such as {min(names, default='none')}")
        if further := sorted(named.keys() - names):
            some = sanitize_text(", ".join(further[:3]), 200)
            notify(log, f"{len(further)} of {len(named)} depths are of no photograph that is used, such as {some}")
        return named
    names = names_of(images)
    if len(depths) != len(names):
        raise ValueError(f"depths must be one for each of the {len(names)} photographs, got {len(depths)}")
    return dict(zip(names, depths, strict=True))


# Where a further photograph of a scene was taken.

Near: TypeAlias = "Located | NotLocated | npt.ArrayLike | None"


def localize_query(
    landmarks: Landmarks, image: str | PathLike[str] | Picture, lens: Lens | None, near: Near
) -> Located | NotLocated:
    """The camera of one photograph, a file or a picture. Raises TypeError, ValueError, FileNotFoundError."""
    expected = _parse_near(near)
    frame = load_query_frame(image, lens)
    if expected is None:
        return localize_image(landmarks, frame.image, frame.intrinsics)
    return follow(landmarks, frame.image, expected, frame.intrinsics)


def load_query_frame(image: str | PathLike[str] | Picture, lens: Lens | None) -> Frame:
    """The photograph with its lens, if that is known. Raises TypeError, ValueError, FileNotFoundError."""
    if isinstance(image, (str, PathLike)) and not Path(image).is_file():
        raise FileNotFoundError(f"no photograph {str(image)!r}; give a file, or a picture")
    (frame, *_) = apply_lens(load_frames([image], None, False, ignore_progress), lens, [image]).frames
    if not isinstance(frame, Frame):
        raise ValueError(f"image {frame.name} cannot be read: {frame.reason}")
    return frame


def _parse_near(near: Near) -> Located | npt.NDArray[np.float64] | None:
    """Parses the known position of the photograph; None where nothing is known."""
    if near is None or isinstance(near, NotLocated):
        return None
    if isinstance(near, Located):
        return near
    try:
        T_world_camera = np.asarray(near, np.float64)
    except (TypeError, ValueError):
        raise TypeError(_WHAT_NEAR_IS.format(type(near).__name__)) from None
    if T_world_camera.shape != (4, 4):
        raise TypeError(_WHAT_NEAR_IS.format(f"shape {T_world_camera.shape}"))
    if problem := rigid_problem(T_world_camera.ravel().tolist()):
        raise ValueError(f"near must be {problem}")
    return T_world_camera


_WHAT_NEAR_IS = "near must be what localise returned, or T_world_camera (4, 4), got {}"
