"""Folders of pictures as a camera."""

from __future__ import annotations

from pathlib import Path

from tubesight.core import InputError
from tubesight.files.dataset import list_pictures
from tubesight.files.images import read_image
from tubesight.sources.jpeg import to_gray
from tubesight.sources.reader import Picture, Source, Wanted


def folder_source(folder: Path, wanted: Wanted) -> Source:
    """Read one camera's pictures of a folder in natural order."""
    if not list_pictures(folder):
        raise InputError(f"{folder}: no pictures in this folder; name one that holds a camera's pictures")
    return Source(str(folder), lambda: _FolderReader(folder, wanted), live=False)


class _FolderReader:
    def __init__(self, folder: Path, wanted: Wanted) -> None:
        self._paths = iter(list_pictures(folder).values())
        self._wanted = wanted

    def read(self) -> Picture | None:
        path = next(self._paths, None)
        if path is None:
            return None
        image = read_image(path, self._wanted.size_px)
        return Picture(to_gray(image) if self._wanted.gray else image, float("nan"))

    def close(self) -> None:
        pass
