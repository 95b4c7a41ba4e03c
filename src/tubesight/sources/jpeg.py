"""JPEG pictures of cameras: decoded whole or refused."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec

import numpy as np

from tubesight.core import Image, InputError
from tubesight.files.headers import BrokenPicture, picture_size
from tubesight.files.images import MAX_PIXELS, decode_image
from tubesight.sources.buffers import PictureBuffers
from tubesight.sources.reader import BrokenPictureError

_START = b"\xff\xd8"


@cache
def strict_jpeg() -> bool:
    """Whether damage within a JPEG can be told (package ``simplejpeg``, extra ``live``).

    OpenCV decodes a picture of which bytes are missing or wrong without a word; libjpeg's own warnings are needed.
    """
    return find_spec("simplejpeg") is not None


def decode_picture(data: bytes, name: str, gray: bool, buffers: PictureBuffers | None = None) -> Image:
    """Decode a camera's picture: every warning of the decoder is an error.

    Parameters
    ----------
    buffers
        Of this camera, to decode into; None for memory of its own.

    Raises
    ------
    BrokenPictureError
        If the picture is cut off, damaged, no picture, or larger than 100 megapixels.
    """
    if not (strict_jpeg() and data[:2] == _START):
        try:
            image = decode_image(data, name)
        except InputError as error:
            raise BrokenPictureError(str(error)) from error
        return to_gray(image) if gray else image
    import simplejpeg

    try:
        width, height = picture_size(data)
        if not 0 < width * height <= MAX_PIXELS:
            raise BrokenPictureError(f"{name}: {width} x {height} pixels are more than a camera has; use smaller ones")
        room = None if buffers is None else buffers.take((height, width, 1 if gray else 3))
        pixels = simplejpeg.decode_jpeg(data, "GRAY" if gray else "BGR", buffer=room)
    except (BrokenPicture, ValueError) as error:
        if isinstance(error, BrokenPictureError):
            raise
        raise BrokenPictureError(f"{name}: a picture arrived damaged ({error}); check cable and network") from error
    return np.asarray(pixels[..., 0] if gray else pixels, dtype=np.uint8)


def to_gray(image: Image) -> Image:
    """Luminance (H, W) of a picture."""
    if image.ndim == 2:
        return image
    import cv2

    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8)
