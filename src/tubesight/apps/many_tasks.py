"""The tasks of a run over many inputs: what is measured, under which name, and from which files."""

from __future__ import annotations

import hashlib
import json
import os
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tubesight.apps.run import RunOptions, rig_and_tube
from tubesight.core import InputError
from tubesight.geometry.rig import Rig

# Beside the folders of the results; the dot keeps it out of their way and out of listings.
CACHE = ".tubesight"
# A table and its JSON.
SUMMARIES = ("summary.csv", "summary.json")


@dataclass(frozen=True, slots=True)
class Task:
    """One input to measure. Paths are absolute: another process, or another machine, reads them.

    Attributes
    ----------
    source, out
        The data set or the recording, and the folder of its results.
    method
        Of a recording; None for the one that it was measured with.
    options
        Of a data set; None for a recording, which holds its own.
    stamp
        Hash of what was found of all files that are read, their sizes and times of change: where one changes, this is
        another task.
    """

    source: Path
    out: Path
    method: str | None
    options: RunOptions | None
    stamp: str


def is_recording(path: Path) -> bool:
    """Whether an input is a recording rather than a data set."""
    return path.suffix.lower() == ".mcap" and not path.is_dir()


def absolute(path: Path) -> Path:
    """Absolute without ``..``, links as they are: a cluster knows folders by the names that the user knows."""
    return Path(os.path.abspath(path))


def names_of(sources: Sequence[Path]) -> list[str]:
    """Name the results of each input: by its stem, with as many parent folders as tell it from the others.

    Parameters
    ----------
    sources
        Absolute, no two equal.

    Raises
    ------
    InputError
        If even whole paths are the same but for case or for hyphens in the place of folders.
    """
    stems = [path.stem if is_recording(path) else path.name for path in sources]
    places = Counter((path.parent, stem) for path, stem in zip(sources, stems, strict=True))
    # A folder and the recording beside it may share their stem: then the suffix tells them apart.
    parts = [
        (*path.parent.parts[1:], stem if places[path.parent, stem] == 1 else path.name)
        for path, stem in zip(sources, stems, strict=True)
    ]
    depths = [1] * len(parts)
    while True:
        names = ["-".join(own[-depth:]) for own, depth in zip(parts, depths, strict=True)]
        # Many file systems take names that differ in case for one.
        count = Counter(name.casefold() for name in (*names, CACHE, *SUMMARIES))
        clashing = [k for k, name in enumerate(names) if count[name.casefold()] > 1 or not name]
        if not clashing:
            return names
        growing = [k for k in clashing if depths[k] < len(parts[k])]
        if not growing:
            raise InputError(
                f"{sources[clashing[0]]}: no name tells its results from others; rename it or run it alone"
            )
        for k in growing:
            depths[k] += 1


def tasks_of(sources: Sequence[Path], outs: Sequence[Path], options: Mapping[str, Any]) -> tuple[list[Task], list[str]]:
    """One task an input, and what the user should know; rig and tube are refused here, once for all folders."""
    tasks: list[Task] = []
    messages: list[str] = []
    rig: Rig | None = None
    for source, out in zip(sources, outs, strict=True):
        if is_recording(source):
            tasks.append(Task(source, out, options.get("method"), None, _stamp([source])))
            continue
        own = RunOptions(**options, folder=source, out=out)
        if rig is None:
            rig, _, messages = rig_and_tube(own)
        tasks.append(Task(source, out, None, own, _stamp(_files(own, rig))))
    unused = [key for key, value in options.items() if value and key != "method"]
    if unused and not any(task.options for task in tasks):
        messages.append(f"recordings are measured with what they hold; not used: {', '.join(unused)}")
    return tasks, messages


def _files(options: RunOptions, rig: Rig) -> list[Path]:
    """All files that a run reads, and those beside them."""
    folders = (options.folder, options.background_path or options.folder / "background")
    pictures = [
        Path(root) / file
        for folder in folders
        for name in rig.names
        for root, _, files in os.walk(folder / name)
        for file in files
    ]
    described = [path for path in (options.rig_path, options.tube_path) if path is not None]
    return sorted(pictures) + described


def _stamp(files: Iterable[Path]) -> str:
    """Hash of paths, sizes and times of change."""
    found: list[tuple[str, int, int]] = []
    for path in files:
        try:
            state = path.stat()
        except OSError:
            # What cannot be read is told when it is measured.
            continue
        found.append((str(path), state.st_size, state.st_mtime_ns))
    return hashlib.sha256(json.dumps(found).encode()).hexdigest()
