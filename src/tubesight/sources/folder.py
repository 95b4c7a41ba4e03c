"""Pairs of pictures from a folder with one subfolder per camera."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from tubesight.core import FramePair, Image
from tubesight.files.dataset import backgrounds, list_pairs
from tubesight.files.images import read_image
from tubesight.geometry.rig import Rig


@dataclass(frozen=True, slots=True)
class FolderSource:
    """The pairs of a data set, read one at a time.

    Iterating yields a `FramePair` each and raises `InputError` at a picture that cannot be read; to go on behind such
    a picture, call `read` for each index.

    Attributes
    ----------
    folder
        Holds one subfolder of pictures per camera; pictures of one instant share their stem.
    rig
        Its camera names are the subfolders, its picture sizes those the pictures have to have.

    Raises
    ------
    InputError
        If a subfolder or the mate of a picture is missing.
    """

    folder: Path
    rig: Rig
    stems: tuple[str, ...] = field(init=False)
    paths: tuple[Mapping[str, Path], ...] = field(init=False)

    def __post_init__(self) -> None:
        pairs = list_pairs(self.folder, self.rig.names)
        object.__setattr__(self, "stems", tuple(stem for stem, _ in pairs))
        object.__setattr__(self, "paths", tuple(paths for _, paths in pairs))

    def __len__(self) -> int:
        return len(self.stems)

    def __iter__(self) -> Iterator[FramePair]:
        return (self.read(index) for index in range(len(self)))

    def read(self, index: int) -> FramePair:
        """Read one pair; raise `InputError` where a picture cannot be used."""
        return FramePair(read_images(self.paths[index], self.rig), self.stems[index])


def read_images(paths: Mapping[str, Path], rig: Rig) -> dict[str, Image]:
    """Read one picture per camera, of the size the camera was calibrated with."""
    return {name: read_image(path, rig.cameras[name].size_px) for name, path in paths.items()}


def read_backgrounds(folder: Path, rig: Rig) -> dict[str, Image]:
    """Read the pictures of the scene without the tube; empty where there is no such folder."""
    return read_images(backgrounds(folder, rig.names), rig)
