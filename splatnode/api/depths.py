"""Depth images as a program has them: arrays, files or records, by the photographs' names or in their order."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

from splatnode.api.image_arguments import DepthOf, parse_optional_depth
from splatnode.api.photographs import Images, names_of
from splatnode.capture.cameras.folder import frame_name
from splatnode.capture.depth_files import find_depth_files
from splatnode.capture.depth_image import DepthImage
from splatnode.capture.frame import Frame
from splatnode.capture.process.terminal import notify
from splatnode.capture.process.text import sanitize_text
from splatnode.recon.replay_source import Source, attach_depths

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
