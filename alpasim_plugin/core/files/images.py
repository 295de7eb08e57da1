"""Images: PNG and JPEG, by their header before they are decoded, since a few bytes can claim
billions of pixels.
"""

import struct
from pathlib import Path
from typing import Any

import numpy as np

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files.limits import SOURCE_BYTES, STORED_PIXELS, STORED_SIDE_PX
from alpasim_plugin.core.files.reading import parsing, read_bytes

GIVE = "give a whole PNG or JPEG image"
PNG = b"\x89PNG\r\n\x1a\n"
JPEG = b"\xff\xd8"
CMYK_CHANNELS = 4
# cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION: in colour, and turned by no EXIF tag, because poses
# and lenses of photographs are those of their pixels as they lie in the file
AS_STORED = 1 | 128
# JPEG markers that carry the size, and those that have no length
FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
BARE = {0x01, *range(0xD0, 0xD9)}


def image_size(data: bytes) -> tuple[int, int] | None:
    """Return width and height from the header of a PNG or JPEG; None where there is none.

    Source: PNG (ISO/IEC 15948) 11.2.2; JPEG (ITU-T T.81) B.2.2.
    """
    if data.startswith(PNG) and data[12:16] == b"IHDR" and len(data) >= 24:
        return struct.unpack(">II", data[16:24])
    frame = _jpeg_frame(data)
    return None if frame is None else (frame[1], frame[0])


def _jpeg_frame(data: bytes) -> tuple[int, int, int] | None:
    """Return height, width and number of channels of a JPEG; None where there are none."""
    start = 2
    while data.startswith(JPEG) and start + 10 <= len(data) and data[start] == 0xFF:
        marker = data[start + 1]
        if marker in FRAMES:
            return struct.unpack(">HHB", data[start + 5 : start + 10])
        if marker == 0xFF:
            start += 1
        elif marker in BARE:
            start += 2
        else:
            start += 2 + int.from_bytes(data[start + 2 : start + 4], "big")
    return None


def image_fault(data: bytes) -> str | None:
    """Return what makes an image of a good header useless as a photograph: cut off before its end,
    or printed colours; None if nothing.

    Decoders fill the missing rest of a JPEG with grey, and turn CMYK into RGB by guess, without a
    word.
    """
    # some cameras write a few bytes after the end
    ends = b"IEND" in data[-16:] if data.startswith(PNG) else b"\xff\xd9" in data[-4096:]
    if not ends:
        return "it ends without an end marker: the file is cut off"
    frame = _jpeg_frame(data)
    if frame is not None and frame[2] == CMYK_CHANNELS:
        return "four colour channels (CMYK)"
    return None


def check_image(data: bytes, location: Path | str, do_this: str = GIVE) -> tuple[int, int]:
    """Return width and height of an encoded image.

    Raises:
        InputError: No PNG or JPEG header, or an image larger than the bounds.
    """
    size = image_size(data)
    if size is None:
        raise InputError(
            f"{location}: {len(data)} bytes beginning {data[:4]!r}, no PNG or JPEG", do_this
        )
    for side in size:
        STORED_SIDE_PX.check(side, location)
    STORED_PIXELS.check(size[0] * size[1], location)
    return size


def decode_image(data: bytes, location: Path | str, do_this: str = GIVE, flag: int = 1) -> Any:
    """Decode a PNG or JPEG as OpenCV does.

    Args:
        data: The encoded image.
        location: Its file, for messages.
        do_this: Hint of the errors.
        flag: ``cv2.IMREAD_...``; by default colour, ``(H, W, 3)`` uint8 BGR.

    Raises:
        InputError: See `check_image`; or data that do not decode.
    """
    import cv2

    check_image(data, location, do_this)
    with parsing(location, do_this, "no readable image"):
        image = cv2.imdecode(np.frombuffer(data, dtype=np.uint8), flag)
    if image is None:
        raise InputError(f"{location}: {len(data)} bytes that do not decode", do_this)
    return image


def read_image(path: Path | str, flag: int = 1) -> Any:
    """Read and decode an image file; see `decode_image`."""
    return decode_image(read_bytes(path, SOURCE_BYTES), path, flag=flag)
