"""Pictures, checked before they are decoded."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from tubesight.core import Image, InputError
from tubesight.files.headers import BrokenPicture, picture_size
from tubesight.files.safe import read_bytes

# A 0.9 MB PNG can decode to 30000 x 30000 pixels, 2.7 GB. Industrial cameras rarely have more than 65 megapixels.
MAX_PIXELS = 100_000_000
# An uncompressed colour picture of that size.
_MAX_BYTES = 3 * MAX_PIXELS + (1 << 20)

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm", ".ppm", ".pnm")


def read_image(path: Path, size_px: tuple[int, int] | None = None) -> Image:
    """Read a picture as it lies in the file: gray (H, W) or BGR (H, W, 3), 8 bit.

    A rotation noted in the EXIF data is ignored, since a calibration holds for the pixels as the sensor gave them.
    16-bit pictures are scaled to 8 bit, transparency is dropped.

    Parameters
    ----------
    size_px
        (width, height) the picture has to have, usually that of the rig's camera.

    Raises
    ------
    InputError
        If the file cannot be read, is cut off, declares more than 100 megapixels (told from the header, before
        decoding), or has another size than `size_px`.
    """
    return decode_image(read_bytes(Path(path), _MAX_BYTES), path, size_px)


def decode_image(data: bytes, path: Path | str, size_px: tuple[int, int] | None = None) -> Image:
    """Decode a picture from its bytes, with the checks of `read_image`.

    Parameters
    ----------
    path
        Where it comes from, for the messages.
    """
    if not data:
        raise InputError(f"{path}: the picture is empty; take it again or leave it out")
    try:
        width, height = picture_size(data)
    except BrokenPicture as error:
        raise InputError(f"{path}: the picture cannot be used ({error}); take it again or leave it out") from error
    if not 0 < width * height <= MAX_PIXELS:
        raise InputError(
            f"{path}: {width} x {height} pixels is more than the 100 megapixels allowed; scale the picture down"
        )
    if size_px is not None and (width, height) != tuple(size_px):
        raise InputError(
            f"{path}: the picture has {width} x {height} pixels but the camera was calibrated with "
            f"{size_px[0]} x {size_px[1]}; use pictures of that size or calibrate again"
        )
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    if image is None or image.shape[:2] != (height, width):
        raise InputError(f"{path}: the picture cannot be decoded; take it again or leave it out")
    return _eight_bit(np.asarray(image), path)


def _eight_bit(image: NDArray[np.uint8 | np.uint16], path: Path | str) -> Image:
    if image.dtype not in (np.uint8, np.uint16):
        raise InputError(f"{path}: pixels of type {image.dtype} are not supported; save it with 8 or 16 bits")
    if image.ndim == 3:
        image = image[..., 0] if image.shape[2] < 3 else image[..., :3]
    if image.dtype == np.uint16:
        # 65535 / 255 is exactly 257.
        return np.asarray(cv2.convertScaleAbs(image, alpha=1 / 257.0), dtype=np.uint8)
    return np.ascontiguousarray(image, dtype=np.uint8)
