"""``tubesight run``: every pair of a folder to tables, curves and pictures."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field, replace
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

import cv2
import numpy as np

from tubesight import __version__
from tubesight.core import Array, FramePair, Image, InputError, Status, Tube
from tubesight.files.rig import load_rig, rig_hash
from tubesight.files.safe import write_atomic
from tubesight.files.tables import ShapeRow
from tubesight.files.tube import load_tube
from tubesight.geometry.rig import Rig
from tubesight.outputs.machine import machine
from tubesight.outputs.overlay import draw_overlay
from tubesight.outputs.plot3d import plots_installed
from tubesight.outputs.rows import curves_of, shape_row, unreadable_row, write_results
from tubesight.outputs.stages import write_stages
from tubesight.sensor import DEFAULT_METHOD, Reconstruction, ShapeSensor
from tubesight.sources.folder import FolderSource, read_backgrounds

Progress = Callable[[int, int], None]


@dataclass(frozen=True, slots=True)
class RunOptions:
    """What a run needs to know; goes into ``run.json`` as it is.

    Attributes
    ----------
    folder
        Data set: one subfolder of pictures per camera.
    rig_path
        ``rig.yaml``.
    out
        Folder for the results, made where there is none.
    tube_path
        ``tube.yaml``; None for a tube of unknown diameter with a round end that no clamp holds.
    method
        Name of a registered method.
    background_path
        Folder with one subfolder per camera that holds a picture without the tube; None for ``background`` in the data
        set, where there is one.
    base_px
        Pixel of the tube's base by camera, where it is not to be found from the rig.
    overlay
        Whether to draw what was found on the photographs.
    stages
        Whether to draw what each stage made of them.
    """

    folder: Path
    rig_path: Path
    out: Path
    tube_path: Path | None = None
    method: str = DEFAULT_METHOD
    background_path: Path | None = None
    base_px: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    overlay: bool = False
    stages: bool = False


@dataclass(frozen=True, slots=True)
class RunReport:
    """What a run found.

    Attributes
    ----------
    rows
        One a pair, as in ``shapes.csv``.
    problems
        A line for each pair whose pictures could not be read.
    messages
        What the user should know: assumptions, chosen segmenters, what was left out.
    files
        What was written.
    """

    rows: tuple[ShapeRow, ...]
    problems: tuple[str, ...]
    messages: tuple[str, ...]
    files: tuple[Path, ...]

    @property
    def complete(self) -> bool:
        """Whether every pair was read and at least one row is ``ok``."""
        return not self.problems and any(row.status == Status.OK for row in self.rows)


def run_folder(options: RunOptions, progress: Progress | None = None) -> RunReport:
    """Reconstruct every pair of a data set and write the results.

    Nothing is written before the last pair is done, but for the overlays and the stages.

    Parameters
    ----------
    progress
        Called with the number of pairs done and their total.

    Raises
    ------
    InputError
        If rig, tube, folder or background cannot be used, none of the pairs can be read, or the results cannot be
        written.
    """
    refuse_place(options.out)
    started = datetime.now(UTC)
    sensor, source, messages = sensor_for(options)
    rig, tube = sensor.rig, sensor.tube
    rows, curves, problems, views, files = [], [], [], [], []
    for index, stem in enumerate(source.stems):
        try:
            pair = source.read(index)
        except InputError as error:
            problems.append(str(error))
            rows.append(unreadable_row(stem, str(error), options.method))
        else:
            result = sensor(pair)
            rows.append(shape_row(result, pair.time_s))
            views.append({name: view.segmenter for name, view in result.views.items()})
            if result and result.curve is not None:
                curves.append((stem, result.curve))
            if options.overlay:
                files.append(_write_overlay(options.out, pair, result, rig))
            if options.stages:
                files += write_stages(options.out, pair, result, sensor)
        if progress is not None:
            progress(index + 1, len(source))
    if len(problems) == len(source):
        others = f" (none of the {len(source)} pairs can be read)" if len(source) > 1 else ""
        raise InputError(problems[0] + others)
    messages += _segmenters(views)
    if not plots_installed():
        messages.append("no 3-D plot: matplotlib is missing (pip install 'tubesight[plots]')")
    about = _run_json(options, rig, tube, rows, messages, started)
    files += write_results(options.out, rows, curves_of(curves), about)
    return RunReport(tuple(rows), tuple(problems), tuple(messages), tuple(files))


def sensor_for(options: RunOptions) -> tuple[ShapeSensor, FolderSource, list[str]]:
    """Make the sensor and the source of a run, and say what the user should know.

    Raises
    ------
    InputError
        If rig, tube, folder or background cannot be used.
    """
    rig, tube, messages = rig_and_tube(options)
    source = FolderSource(options.folder, rig)
    backgrounds = _backgrounds(options, rig, messages)
    base_px: dict[str, Array] = {name: np.array(px, float) for name, px in options.base_px.items()}
    return ShapeSensor(rig, tube, options.method, backgrounds, base_px), source, messages


def refuse_place(out: Path) -> None:
    """Refuse a place that cannot be written before the work is done, not after."""
    parent = next(p for p in (out, *out.absolute().parents) if p.exists())
    if not parent.is_dir() or not os.access(parent, os.W_OK):
        raise InputError(f"{out}: results cannot be written there; name a folder with -o that can be made or written")


def rig_and_tube(options: RunOptions) -> tuple[Rig, Tube, list[str]]:
    """Read rig and tube of a run, and say what is assumed.

    Raises
    ------
    InputError
        If they cannot be used to measure.
    """
    rig = load_rig(options.rig_path).rig
    lacking = [name for name in rig.names if name not in rig.camera_from_base]
    if lacking:
        raise InputError(
            f"{options.rig_path}: the pose of {', '.join(lacking)} is not known; run `tubesight calibrate` on pictures "
            "both cameras took of one board, or `tubesight register`"
        )
    if len(rig.names) < 2:
        raise InputError(f"{options.rig_path}: a 3-D shape needs two cameras, the rig has one; add a second camera")
    for name in options.base_px:
        if name not in rig.names:
            raise InputError(
                f"{options.rig_path}: --base names camera {name!r}, but the rig has {', '.join(rig.names)}"
            )
    messages: list[str] = []
    tube = tube_for(options.tube_path, rig, messages)
    if len(options.base_px) > 1 and tube.clamped:
        messages.append("the base is marked by hand (--base): it takes the place of the clamp")
        tube = replace(tube, clamped=False)
    if rig.covariance is None:
        messages.append("the rig has no covariance: deviations cover the pictures alone, not the calibration")
    return rig, tube, messages


def tube_for(path: Path | None, rig: Rig, messages: list[str], otherwise: Tube | None = None) -> Tube:
    """Read what is known of the tube, and say what is assumed; no clamp holds it where the rig is not registered.

    Parameters
    ----------
    path
        ``tube.yaml``, or None.
    messages
        What the user should know is appended.
    otherwise
        The tube where there is no file and yet something is known.
    """
    if path is not None:
        tube = load_tube(path)
    elif otherwise is not None:
        tube = otherwise
    else:
        tube = Tube()
        messages.append("no tube file: the diameter is estimated, a round end and no clamp are assumed (--tube)")
    if not rig.registered:
        messages.append(
            f"the rig is not registered: coordinates are those of camera {rig.base_frame!r} (`tubesight register`)"
        )
        tube = replace(tube, clamped=False)
    return tube


def _backgrounds(options: RunOptions, rig: Rig, messages: list[str]) -> dict[str, Image]:
    folder = options.background_path or options.folder / "background"
    if options.background_path is not None and not folder.is_dir():
        raise InputError(f"{folder}: no such folder; --background names one with a subfolder per camera")
    found = read_backgrounds(folder, rig)
    if found:
        messages.append(f"background pictures of {', '.join(found)} from {folder}")
    return found


def _write_overlay(out: Path, pair: FramePair, result: Reconstruction, rig: Rig) -> Path:
    path = out / "overlay" / f"{result.frame}.png"
    _, data = cv2.imencode(".png", draw_overlay(pair, result, rig))
    write_atomic(path, data.tobytes())
    return path


def _segmenters(views: list[dict[str, str]]) -> list[str]:
    """Say per camera which segmenter was chosen and why, the commonest first."""
    lines = []
    for name in dict.fromkeys(name for view in views for name in view):
        counts = Counter(view[name] for view in views if name in view)
        lines += [f"{name}: {why} ({count} of {len(views)} pairs)" for why, count in counts.most_common()]
    return lines


def _run_json(
    options: RunOptions, rig: Rig, tube: Tube, rows: list[ShapeRow], messages: list[str], started: datetime
) -> dict[str, Any]:
    """Collect what made the results: a run can be repeated from it."""
    times = [row.total_ms for row in rows if row.status == Status.OK]
    return {
        "format": "tubesight-run/1",
        "version": __version__,
        "started": started.isoformat(timespec="seconds"),
        "configuration": asdict(options) | {"tube": asdict(tube)},
        "rig": {
            "sha256": rig_hash(options.rig_path),
            "cameras": list(rig.names),
            "base_frame": rig.base_frame,
            "covariance": rig.covariance is not None,
        },
        # Nothing in a run is drawn at random.
        "seed": None,
        "machine": machine(),
        "status": dict(Counter(row.status for row in rows)),
        "median_ms": median(times) if times else None,
        "messages": messages,
    }
