"""Pictures: every format gives the pixels as they lie in the file; what is broken or too large is refused undecoded."""

import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tubesight.core import InputError
from tubesight.files.headers import BrokenPicture, picture_size
from tubesight.files.images import read_image

RNG = np.random.default_rng(0)
COLOUR = cv2.GaussianBlur(RNG.integers(0, 256, (48, 64, 3), np.uint8), (0, 0), 3)
GRAY = COLOUR[..., 1].copy()
FORMATS = (".png", ".jpg", ".bmp", ".tiff", ".pgm", ".ppm")


def encoded(suffix: str, image: np.ndarray) -> bytes:
    ok, data = cv2.imencode(suffix, image)
    assert ok
    return bytes(data.tobytes())


def chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def png_bomb(side: int) -> bytes:
    """A PNG of about a megabyte or less that decodes to side x side pixels."""
    head = chunk(b"IHDR", struct.pack(">IIBBBBB", side, side, 8, 2, 0, 0, 0))
    squeeze = zlib.compressobj(9)
    row = bytes(1 + 3 * side)
    data = b"".join(squeeze.compress(row) for _ in range(side // 30)) + squeeze.flush()
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", data) + chunk(b"IEND", b"")


def refused(path: Path, data: bytes, size_px: tuple[int, int] | None = None) -> str:
    path.write_bytes(data)
    with pytest.raises(InputError) as error:
        read_image(path, size_px)
    message = str(error.value)
    assert "\n" not in message and str(path) in message
    return message


@pytest.mark.parametrize("suffix", [".png", ".bmp", ".tiff", ".pgm", ".ppm"])
def test_lossless_pictures_are_read_exactly(tmp_path: Path, suffix: str) -> None:
    image = GRAY if suffix == ".pgm" else COLOUR
    path = tmp_path / f"picture{suffix}"
    path.write_bytes(encoded(suffix, image))
    got = read_image(path, (64, 48))
    assert got.dtype == np.uint8 and got.flags.c_contiguous
    assert np.array_equal(got, image)


def test_jpeg_and_gray_keep_their_kind(tmp_path: Path) -> None:
    path = tmp_path / "picture.jpg"
    for image in (COLOUR, GRAY):
        path.write_bytes(encoded(".jpg", image))
        assert read_image(path).shape == image.shape


def test_sixteen_bits_are_scaled_and_transparency_dropped(tmp_path: Path) -> None:
    path = tmp_path / "picture.png"
    deep = GRAY.astype(np.uint16) * 257
    path.write_bytes(encoded(".png", deep))
    assert np.array_equal(read_image(path), GRAY)
    # Between two gray levels (257 apart) the nearer one is taken.
    path.write_bytes(encoded(".png", np.array([[128, 129, 257 + 100]], np.uint16)))
    assert read_image(path).tolist() == [[0, 1, 1]]
    path.write_bytes(encoded(".png", np.dstack([COLOUR, np.full(GRAY.shape, 7, np.uint8)])))
    assert np.array_equal(read_image(path), COLOUR)


def test_exif_rotation_is_ignored(tmp_path: Path) -> None:
    """The calibration holds for the pixels as the sensor gave them."""
    plain = encoded(".jpg", COLOUR)
    entry = struct.pack(">HHIHH", 0x0112, 3, 1, 6, 0)
    tiff = b"MM\0*" + struct.pack(">IH", 8, 1) + entry + struct.pack(">I", 0)
    exif = b"\xff\xe1" + struct.pack(">H", 2 + 6 + len(tiff)) + b"Exif\0\0" + tiff
    (tmp_path / "plain.jpg").write_bytes(plain)
    (tmp_path / "turned.jpg").write_bytes(plain[:2] + exif + plain[2:])
    flag = cv2.IMREAD_COLOR
    assert cv2.imread(str(tmp_path / "turned.jpg"), flag).shape == (64, 48, 3), "the file is one that OpenCV turns"
    assert np.array_equal(read_image(tmp_path / "turned.jpg", (64, 48)), read_image(tmp_path / "plain.jpg"))


@pytest.mark.parametrize("suffix", FORMATS)
@pytest.mark.parametrize("part", [0.02, 0.3, 0.9, 0.999])
def test_cut_off_pictures_are_refused(tmp_path: Path, suffix: str, part: float) -> None:
    whole = encoded(suffix, GRAY if suffix == ".pgm" else COLOUR)
    refused(tmp_path / f"cut{suffix}", whole[: min(int(part * len(whole)), len(whole) - 1)])


def test_end_marker_of_a_thumbnail_is_not_that_of_the_picture(tmp_path: Path) -> None:
    thumbnail = encoded(".jpg", GRAY[::4, ::4])
    whole = encoded(".jpg", COLOUR)
    segment = b"\xff\xe1" + struct.pack(">H", 2 + len(thumbnail)) + thumbnail
    data = whole[:2] + segment + whole[2:]
    path = tmp_path / "picture.jpg"
    path.write_bytes(data + b"what some cameras append")
    assert read_image(path).shape == COLOUR.shape
    assert "cut off" in refused(path, data[:-200])


def test_damage_inside_a_png_is_found(tmp_path: Path) -> None:
    data = bytearray(encoded(".png", COLOUR))
    data[len(data) // 2] ^= 0xFF
    assert "damaged" in refused(tmp_path / "picture.png", bytes(data))


def test_huge_pictures_are_refused_before_decoding(tmp_path: Path) -> None:
    bomb = png_bomb(30_000)
    assert len(bomb) < 1_000_000
    assert "30000 x 30000 pixels is more than" in refused(tmp_path / "bomb.png", bomb)
    bmp = bytearray(encoded(".bmp", GRAY))
    struct.pack_into("<iiHHI", bmp, 18, 100_000, -100_000, 1, 8, 1)
    assert "100000 x 100000" in refused(tmp_path / "bomb.bmp", bytes(bmp))
    jpeg = bytearray(encoded(".jpg", GRAY))
    frame = jpeg.index(b"\xff\xc0")
    struct.pack_into(">HH", jpeg, frame + 5, 65_000, 65_000)
    assert "65000 x 65000" in refused(tmp_path / "bomb.jpg", bytes(jpeg))
    assert "pixels is more" in refused(tmp_path / "bomb.pgm", b"P2\n# text\n99999 99999\n255\n0 ")


def test_other_sizes_than_the_cameras_are_refused(tmp_path: Path) -> None:
    message = refused(tmp_path / "picture.png", encoded(".png", COLOUR), (640, 480))
    assert "64 x 48" in message and "640 x 480" in message and "calibrate again" in message


@pytest.mark.parametrize(
    "data", [b"", b"\0", b"hello", b"GIF89a", b"\xff\xd8", b"BM", b"II*\0", b"\x89PNG\r\n\x1a\n", b"P5\n"]
)
def test_what_is_no_picture_is_refused(tmp_path: Path, data: bytes) -> None:
    refused(tmp_path / "picture.png", data)


def test_floating_point_pictures_are_refused(tmp_path: Path) -> None:
    assert "8 or 16 bits" in refused(tmp_path / "picture.tiff", encoded(".tiff", np.ones((4, 4), np.float32)))


@pytest.mark.parametrize("suffix", FORMATS)
def test_sizes_are_read_from_headers(suffix: str) -> None:
    assert picture_size(encoded(suffix, GRAY if suffix == ".pgm" else COLOUR)) == (64, 48)


@settings(max_examples=300, deadline=None)
@given(suffix=st.sampled_from(FORMATS), at=st.floats(0, 1), what=st.binary(min_size=1, max_size=8), cut=st.floats(0, 1))
def test_no_header_makes_the_reader_stumble(suffix: str, at: float, what: bytes, cut: float) -> None:
    """Whatever the bytes, there is a size or a reason."""
    data = bytearray(encoded(suffix, GRAY if suffix == ".pgm" else COLOUR))
    # Most of the damage goes where the headers are.
    start = int(at**4 * (len(data) - len(what)))
    data[start : start + len(what)] = what
    try:
        width, height = picture_size(bytes(data[: max(int(cut**0.25 * len(data)), 1)]))
    except BrokenPicture:
        return
    assert width >= 0 and height >= 0
