"""HEIC and AVIF decoded with the packages pi_heif and Pillow, in a process of its own; image_file.py is for all others.

Nothing else is imported here: the process shall start soon, for each photograph anew.
"""

from __future__ import annotations

import io
import resource
import struct
import sys

from splatnode.capture.process.python import limit_memory

HEADER = struct.Struct("<III")  # width, height, bytes of EXIF; then EXIF and pixels, none where these are too many
BASE_BYTES = 300_000_000  # of memory for the decoder, whatever the size of an image
BYTES_A_PIXEL = 40  # further ones: planes of 16 bits, colours, and the image that is turned
_DECODING_S = 120  # of processor time at most, all threads together


def main() -> None:
    """The decoder's process: MAX_PIXELS; the file on standard input, on standard output what HEADER says."""
    data, max_pixels = sys.stdin.buffer.read(), int(sys.argv[1])
    import pi_heif
    from PIL import Image, ImageOps

    resource.setrlimit(resource.RLIMIT_CPU, (_DECODING_S, _DECODING_S))
    limit_memory(BASE_BYTES)
    Image.MAX_IMAGE_PIXELS = None  # the bound is ours
    pi_heif.register_heif_opener(thumbnails=False, depth_images=False, aux_images=False)
    with Image.open(io.BytesIO(data), formats=("HEIF", "AVIF")) as image:
        if image.width * image.height > max_pixels:
            sys.stdout.buffer.write(HEADER.pack(image.width, image.height, 0))
            return
        limit_memory(BASE_BYTES + BYTES_A_PIXEL * image.width * image.height)
        # pi_heif has turned a HEIC and says so in its EXIF. Pillow has not turned an AVIF, and says by how much to.
        upright = ImageOps.exif_transpose(image).convert("RGB")
        exif = image.info.get("exif") or b""
    sys.stdout.buffer.write(HEADER.pack(upright.width, upright.height, len(exif)) + exif)
    sys.stdout.buffer.write(upright.tobytes())


if __name__ == "__main__":
    main()
