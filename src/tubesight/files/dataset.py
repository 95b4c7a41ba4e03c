"""A data set: one subfolder of pictures per camera; pictures of one instant share their stem."""

from __future__ import annotations

import re
from collections.abc import Iterable
from pathlib import Path

from tubesight.core import InputError
from tubesight.files.images import SUFFIXES

# Subfolders of a data set that are not cameras.
_OTHER_FOLDERS = ("background", "calibration", "registration")


def _natural(text: str) -> list[tuple[int, int, str]]:
    """Sort key that puts picture 2 before picture 10."""
    return [(0, int(part), "") if part.isdecimal() else (1, 0, part) for part in re.split(r"(\d+)", text) if part]


def list_pictures(folder: Path) -> dict[str, Path]:
    """Pictures in a folder by stem, in natural order; refuses two pictures of one stem. Hidden files are left out."""
    pictures: dict[str, Path] = {}
    for path in sorted(_entries(folder), key=lambda p: _natural(p.name)):
        if path.name.startswith(".") or path.suffix.lower() not in SUFFIXES or not path.is_file():
            continue
        if path.stem in pictures:
            raise InputError(f"{folder}: {pictures[path.stem].name} and {path.name} have one stem; remove one")
        pictures[path.stem] = path
    return pictures


def list_pairs(folder: Path, camera_names: Iterable[str]) -> list[tuple[str, dict[str, Path]]]:
    """Pictures of one instant, by stem in natural order and by camera.

    Raises
    ------
    InputError
        If a camera has no subfolder, a subfolder no pictures, or a picture has no mate in every other camera.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name the folder that holds one subfolder of pictures per camera")
    names = tuple(camera_names)
    pictures = {}
    for name in names:
        if not (folder / name).is_dir():
            found = camera_folders(folder)
            seen = f"it has {', '.join(found)}" if found else "it has no folder of pictures"
            raise InputError(
                f"{folder}: no subfolder {name!r} for that camera ({seen}); put its pictures into {folder / name}"
            )
        pictures[name] = list_pictures(folder / name)
        if not pictures[name]:
            raise InputError(
                f"{folder / name}: no pictures here ({', '.join(SUFFIXES)}); put those of camera {name!r} here"
            )
    for name in names:
        for stem, path in pictures[name].items():
            lacking = [other for other in names if stem not in pictures[other]]
            if lacking:
                mates = ", ".join(f"{other}/{stem}" for other in lacking)
                raise InputError(
                    f"{path}: this picture has no mate {mates}; add the missing picture or remove this one"
                )
    return [(stem, {name: pictures[name][stem] for name in names}) for stem in pictures[names[0]]]


def camera_folders(folder: Path) -> list[str]:
    """Names of the subfolders that hold pictures, in natural order, without ``background`` and the like."""
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; name the folder that holds one subfolder of pictures per camera")
    candidates = [
        p for p in _entries(folder) if p.is_dir() and p.name not in _OTHER_FOLDERS and not p.name.startswith(".")
    ]
    names = [p.name for p in candidates if any(q.suffix.lower() in SUFFIXES for q in _entries(p))]
    return sorted(names, key=_natural)


def backgrounds(folder: Path, camera_names: Iterable[str]) -> dict[str, Path]:
    """Picture of the scene without the tube per camera: the first in ``<folder>/<camera>/``.

    Parameters
    ----------
    folder
        The ``background`` folder. Where there is none, no camera has a background.

    Raises
    ------
    InputError
        If the folder exists but holds no picture for any of the cameras.
    """
    folder = Path(folder)
    if not folder.exists():
        return {}
    found = {}
    names = tuple(camera_names)
    for name in names:
        pictures = list_pictures(folder / name) if (folder / name).is_dir() else {}
        if pictures:
            found[name] = next(iter(pictures.values()))
    if not found:
        raise InputError(
            f"{folder}: no background picture in {', '.join(f'{n}/' for n in names)}; add one or remove the folder"
        )
    return found


def _entries(folder: Path) -> list[Path]:
    try:
        return list(Path(folder).iterdir())
    except OSError as error:
        raise InputError(f"{folder}: cannot be listed ({error.strerror}); check its permissions") from error
