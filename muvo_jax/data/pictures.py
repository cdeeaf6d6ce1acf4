"""Pictures of a recording, PNG and JPEG: colours, grey, classes and depth, as pixels and as the bytes they were."""

from __future__ import annotations

import contextlib
import contextvars
import io
import pathlib
import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageOps

from muvo_jax.data import files, schema

DEPTH_UNIT_M, DEPTH_SKY = 0.01, 65535  # of pictures of depth
_USUAL = ("PNG", "JPEG")  # as Pillow names them
# Read under such a name, too. Of all that Pillow knows, some start other programs (Ghostscript).
_FORMATS = (*_USUAL, "BMP", "TIFF")
MODES = ("RGB", "RGBA", "L", "classes", "depth_m")
_PNG_BITS = 24  # where a PNG says how many bits a sample has
_PNG_CHUNKS = 8  # where its first chunk begins
_GREY_SPREADS = {2: 85, 4: 17}
# Pillow raises any of these for broken chunks and for sizes that would fill the memory.
_IMAGE_ERRORS = (OSError, SyntaxError, ValueError, TypeError, IndexError, OverflowError, MemoryError, zlib.error,
                 struct.error, Image.DecompressionBombError)


class Picture(NamedTuple):
    """What `decode` made of the bytes of a PNG or JPEG, and how."""

    pixels: np.ndarray
    mode: str
    content: bytes


_keeping: contextvars.ContextVar[list[Picture] | None] = contextvars.ContextVar("keeping", default=None)


@contextlib.contextmanager
def keeping() -> Iterator[list[Picture]]:
    """Within, the pictures that this thread reads are appended to the list that this gives, bytes and all."""
    kept: list[Picture] = []
    token = _keeping.set(kept)
    try:
        yield kept
    finally:
        _keeping.reset(token)


def read(path: pathlib.Path, mode: str | None) -> np.ndarray:
    """Returns a PNG or JPEG in one of these ways:

      "RGB": uint8 [H, W, 3], "RGBA": uint8 [H, W, 4], turned as the camera says it was held (EXIF);
      "L": uint8 [H, W], of a grey image;
      "classes": [H, W], the whole number that is stored for each pixel, of a grey image or one with a palette;
      "depth_m": float32 [H, W], of a grey image of 16 bits, centimetres; infinite where they are 65535;
      None: as it is stored.

    Raises:
      DataError: where the file is missing, truncated, no image, or of other pixels than the mode asks for.
    """
    return decode(files.read_bytes(path, "an image"), mode, str(path))


def decode(content: bytes, mode: str | None, where: str, shape: tuple[int, ...] | None = None) -> np.ndarray:
    """The same of the bytes of such a file.

    Args:
      where: they come from, for messages.
      shape: of the array, known before; PNG and JPEG of so many pixels alone are then decoded.

    Raises:
      DataError: where they are damaged, no image, or of other pixels than the mode asks for.
    """
    try:
        with Image.open(io.BytesIO(content), formats=_FORMATS if shape is None else _USUAL) as image:
            if shape is not None and sorted((image.height, image.width)) != sorted(shape[:2]):
                raise schema.DataError(f"{where}: a picture of {image.width}x{image.height} pixels, expected "
                                       f"{list(shape)}")
            if image.format == "PNG":
                _check_chunks(content)
            pixels = _pixels(image, mode, where, content)
            kept = _keeping.get()
            if kept is not None and mode is not None and image.format in _USUAL:
                pixels.flags.writeable = False  # they stay what the bytes say
                kept.append(Picture(pixels, mode, content))
            return pixels
    except schema.DataError:
        raise
    except _IMAGE_ERRORS as error:
        raise schema.DataError(f"{where}: not a readable image ({error}). The file is truncated or damaged, or no PNG "
                               f"or JPEG: copy it again, or delete it so that the sequence is split there.") from error


def decode_depth(pixels: np.ndarray) -> np.ndarray:
    """Centimetres (16 bit) to float32 metres, infinite in the sky; the inverse of plain.writer.encode_depth."""
    return np.where(pixels == DEPTH_SKY, np.float32(np.inf), pixels.astype(np.float32) * np.float32(DEPTH_UNIT_M))


def _check_chunks(content: bytes) -> None:
    """Raises ValueError where a PNG is not as it was written; Pillow does not look at the checksum of pixels."""
    view, start = memoryview(content), _PNG_CHUNKS
    while start + 12 <= len(content):
        length, name = struct.unpack_from(">I4s", content, start)
        stop = start + 8 + length
        if stop + 4 > len(content):
            break
        if zlib.crc32(view[start + 4:stop]) != struct.unpack_from(">I", content, stop)[0]:
            raise ValueError(f"the checksum of its part {name.decode('latin-1')} at byte {start} is wrong")
        if name == b"IEND":
            return
        start = stop + 4
    raise ValueError(f"it ends after {len(content)} bytes, before its part IEND")


def _pixels(image: Image.Image, mode: str | None, where: str, content: bytes) -> np.ndarray:
    if mode is None:
        return np.asarray(image)
    is_wide = image.mode.startswith(("I", "F"))  # more than 8 bits
    if mode == "depth_m":
        pixels = np.asarray(image)
        if not image.mode.startswith("I") or (pixels.size and not 0 <= pixels.min() <= pixels.max() < 2**16):
            raise _other_pixels(where, image, "16 bits of grey, the depth in centimetres")
        return decode_depth(pixels)
    if mode == "classes" and image.mode in ("L", "P", "1"):
        # Pillow spreads 2 and 4 bits of grey over 0 to 255.
        spread = _GREY_SPREADS.get(content[_PNG_BITS], 1) if image.format == "PNG" and image.mode == "L" else 1
        return np.asarray(image).astype(np.uint8, copy=False) // np.uint8(spread)
    if is_wide:
        raise _other_pixels(where, image, "8 bits of each colour")
    if mode in ("RGB", "RGBA"):
        ImageOps.exif_transpose(image, in_place=True)
        return np.asarray(image if image.mode == mode else image.convert(mode))
    if image.mode in ("L", "1", "LA"):
        return np.asarray(image.convert("L"))
    pixels = np.asarray(image.convert("RGB"))
    if (pixels[..., 0] != pixels[..., 1]).any() or (pixels[..., 0] != pixels[..., 2]).any():
        raise _other_pixels(where, image, "grey" if mode == "L" else "grey, the number of a class in each pixel")
    return np.ascontiguousarray(pixels[..., 0])


def _other_pixels(where: str, image: Image.Image, expected: str) -> schema.DataError:
    return schema.DataError(f"{where}: an image of {image.width}x{image.height} pixels of Pillow's mode "
                            f"{image.mode!r}, expected {expected}. Write it that way.")
