"""What a message says, whatever it was encoded in."""

from __future__ import annotations

from dataclasses import dataclass


class UnusableMessage(ValueError):
    """A message that cannot be read, or that shows no photograph; the text says why."""


@dataclass(frozen=True)
class Layout:
    """How the bytes of a raw image lie."""

    width: int  # pixels
    height: int  # pixels
    encoding: str  # as Foxglove and ROS name it: rgb8, bgr8, mono8, ...
    step: int  # bytes from row to row


@dataclass(frozen=True)
class Picture:
    """An image, of one camera at one time."""

    sensor: str  # the name of the camera's coordinate frame, by which its calibration is found; may be empty
    captured_ns: int  # of the clock of who sent it, mostly since 1970
    data: bytes  # a JPEG, PNG or WebP file, or raw rows
    layout: Layout | None  # None: `data` is a file


@dataclass(frozen=True)
class Calibration:
    """A camera's calibration as it is sent: the centre of the top-left pixel is at (0, 0)."""

    sensor: str  # as of a Picture
    width: int  # of the whole images, pixels
    height: int  # likewise
    model: str  # of the distortion: plumb_bob, rational_polynomial, equidistant, kannala_brandt, fisheye, or empty
    D: tuple[float, ...]  # its coefficients
    K: tuple[float, ...]  # (9,) of the images as they are taken; K[0] = 0: not calibrated
    P: tuple[float, ...]  # (12,) of the images without distortion
    window: tuple[int, int, int, int] = (0, 0, 0, 0)  # x, y, width, height of what is sent; 0 wide: all
