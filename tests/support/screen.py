"""The X display as a person sees it."""

from __future__ import annotations

import ctypes
import ctypes.util

import numpy as np
import numpy.typing as npt

Image = npt.NDArray[np.uint8]


class Screen:
    """The root window of the X display."""

    def __init__(self) -> None:
        self._x11 = ctypes.CDLL(ctypes.util.find_library("X11") or "libX11.so.6")
        self._x11.XOpenDisplay.restype = self._x11.XGetImage.restype = ctypes.c_void_p
        self._x11.XDefaultRootWindow.restype = self._x11.XGetPixel.restype = ctypes.c_ulong
        display = self._x11.XOpenDisplay(None)
        if not display:
            raise SystemExit("needs a display: run it under xvfb-run")
        self._display = ctypes.c_void_p(display)
        self._root = ctypes.c_ulong(self._x11.XDefaultRootWindow(self._display))

    def pixel(self, x: int, y: int) -> tuple[int, int, int]:
        image = self._grab(x, y, 1, 1)
        value = self._x11.XGetPixel(image, 0, 0)
        self._x11.XDestroyImage(image)
        return (value >> 16) & 255, (value >> 8) & 255, value & 255

    def picture(self, width: int, height: int) -> Image:
        """(height, width, 3) BGR, from the top left."""
        image = self._grab(0, 0, width, height)
        data = ctypes.cast(image.value + 16, ctypes.POINTER(ctypes.c_void_p))[0]  # after four ints in an XImage
        pixels = np.ctypeslib.as_array(ctypes.cast(data, ctypes.POINTER(ctypes.c_uint8)), (height, width, 4))
        copy = np.ascontiguousarray(pixels[..., :3])
        self._x11.XDestroyImage(image)
        return copy

    def _grab(self, x: int, y: int, width: int, height: int) -> ctypes.c_void_p:
        everything, z_pixmap = ctypes.c_ulong(2**32 - 1), 2
        return ctypes.c_void_p(
            self._x11.XGetImage(self._display, self._root, x, y, width, height, everything, z_pixmap)
        )
