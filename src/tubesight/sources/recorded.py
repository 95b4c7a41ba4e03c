"""One camera's pictures out of a recording, at the times at which they were taken."""

from __future__ import annotations

from pathlib import Path

from tubesight.core import InputError
from tubesight.files.recording import PICTURE_TOPIC, RecordedPicture, Recording, read_messages
from tubesight.sources.jpeg import decode_picture
from tubesight.sources.reader import Picture, Source, Wanted


def recording_source(path: Path, wanted: Wanted) -> Source:
    """Read the pictures of the camera wanted; their times count from the first picture of any camera."""
    first = next((m.time_ns for m in read_messages(path) if m.topic.startswith(PICTURE_TOPIC)), None)
    if first is None:
        raise InputError(f"{path}: holds no pictures; record with --pictures lossless")
    return Source(f"{path} ({wanted.camera})", lambda: _RecordingReader(path, wanted, first), live=False)


class _RecordingReader:
    def __init__(self, path: Path, wanted: Wanted, first_ns: int) -> None:
        self._path, self._wanted, self._first_ns = path, wanted, first_ns
        entries = Recording(path).entries()
        self._pictures = (e for e in entries if isinstance(e, RecordedPicture) and e.camera == wanted.camera)

    def read(self) -> Picture | None:
        entry = next(self._pictures, None)
        if entry is None:
            return None
        image = decode_picture(entry.data, f"{self._path}: {entry.camera} {entry.number}", self._wanted.gray)
        # A camera's own code is kept; pixels are not coded.
        coded = entry.data if entry.format in ("jpeg", "png") else b""
        return Picture(image, (entry.time_ns - self._first_ns) / 1e9, coded)

    def close(self) -> None:
        self._pictures.close()
