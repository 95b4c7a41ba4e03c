"""``tubesight import`` and ``tubesight rig-export``: rigs of and for other tools."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from tubesight.core import InputError
from tubesight.files.exporters import EXPORTERS
from tubesight.files.importers import Settings, import_rig
from tubesight.files.rig import load_rig, save_rig
from tubesight.files.safe import write_atomic
from tubesight.geometry.rig import Rig


@dataclass(frozen=True, slots=True, eq=False)
class Imported:
    """A rig of another tool, and what was assumed on the way.

    Attributes
    ----------
    format
        Name of the foreign format.
    notes
        Lines for the user.
    path
        The rig file that was written.
    """

    rig: Rig
    format: str
    notes: tuple[str, ...]
    path: Path

    @property
    def baselines_mm(self) -> Mapping[str, float]:
        """Distance of each camera from the first one, where the poses are known."""
        first, *others = self.rig.names
        known = [name for name in others if name in self.rig.camera_from_base]
        return {name: float(np.linalg.norm(self.rig.relative_pose(name, first).translation_mm)) for name in known}

    @property
    def next_step(self) -> str:
        """What to do with the rig."""
        if self.rig.camera_from_base:
            return "tubesight register, which places the base of the tube"
        return "tubesight register, which finds where the cameras are: the files told the lenses alone"

    def as_dict(self) -> dict[str, Any]:
        """Everything that ``--json`` prints."""
        cameras = {
            name: {"size_px": c.size_px, "lens": c.lens, "focal_px": c.focal_px, "centre_px": c.matrix[:2, 2]}
            for name, c in self.rig.cameras.items()
        }
        return {
            "format": self.format,
            "cameras": cameras,
            "baseline_mm": self.baselines_mm,
            "notes": self.notes,
            "files": [self.path],
        }


def import_files(
    paths: Sequence[Path], out: Path, settings: Settings | None = None, name: str | None = None
) -> Imported:
    """Read a rig of another tool and write it as ``rig.yaml``.

    Parameters
    ----------
    paths
        The files, the first camera's first.
    out
        The rig file to write.
    settings
        What the files leave open.
    name
        The format; None tells it from the content.

    Raises
    ------
    InputError
        If the files are no rig, or the rig cannot be written.
    """
    paths, out = [Path(path) for path in paths], Path(out)
    if out.is_dir():
        raise InputError(f"{out}: this is a folder; name the rig file to write")
    if any(path.exists() and out.exists() and path.samefile(out) for path in paths):
        raise InputError(f"{out}: this file is one of the files to read; name another rig file")
    rig, found, notes = import_rig(paths, settings, name)
    hashes = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in paths}
    save_rig(out, rig, {"imported": {"format": found, "hashes": hashes, "notes": list(notes)}})
    return Imported(rig, found, notes, out)


def export_rig(rig_path: Path, name: str, folder: Path) -> tuple[Path, ...]:
    """Write a rig for another tool into a folder; return the files.

    Parameters
    ----------
    name
        One of `EXPORTERS`.

    Raises
    ------
    InputError
        If the other tool cannot hold this rig, or the files cannot be written.
    """
    rig_path, folder = Path(rig_path), Path(folder)
    rig = load_rig(rig_path).rig
    try:
        files = EXPORTERS[name](rig)
    except InputError as error:
        raise InputError(f"{rig_path}: {error}") from error
    for file, text in files.items():
        write_atomic(folder / file, text)
    return tuple(folder / file for file in files)
