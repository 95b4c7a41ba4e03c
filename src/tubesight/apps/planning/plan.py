"""``tubesight plan``: what a rig will measure, or where to put its cameras, and what is written about it."""

from __future__ import annotations

import csv
import io
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from tubesight import __version__
from tubesight.apps.planning.config import Task, load_plan
from tubesight.apps.planning.placement import Place, Placement, best_places, rig_of, target_of
from tubesight.apps.planning.workspace import Pose, summary, survey
from tubesight.core import InputError
from tubesight.files.rig import load_rig, save_rig
from tubesight.files.safe import write_atomic
from tubesight.files.tables import write_json
from tubesight.geometry.rig import Rig, RigCovariance

Progress = Callable[[str, int, int], None]

# Poses of the workspace: fewer while places are compared, whose order they do not change.
_SEARCHED, _SURVEYED = (3, 12), (7, 24)


@dataclass(frozen=True, slots=True, eq=False)
class Plan:
    """What was planned.

    Attributes
    ----------
    rig
        The one asked about, or the best found.
    placements
        Best first; none where a rig was given.
    poses
        Of the workspace, with predicted deviations.
    remarks
        What the numbers rest on.
    """

    task: Task
    rig: Rig
    placements: tuple[Placement, ...]
    poses: tuple[Pose, ...]
    remarks: tuple[str, ...]

    def as_dict(self) -> dict[str, Any]:
        """Return everything but the single poses, for ``--json`` and ``plan.json``."""
        return {
            "version": __version__,
            "cameras": {name: asdict(place) for name, place in self.places().items()},
            "placements": [asdict(placement) for placement in self.placements],
            "workspace": summary(self.poses),
            "assumptions": asdict(self.task.errors) | {"calibration_px": self.task.calibration_px},
            "remarks": self.remarks,
        }

    def places(self) -> dict[str, Place]:
        """Where each camera of the rig stands, seen from the middle of the workspace."""
        target = target_of(self.task.workspace.poses(*_SEARCHED))
        made = {}
        for name in self.rig.names:
            x, y, z = (self.rig.centre_mm(name) - target).tolist()
            distance = float(np.sqrt(x * x + y * y + z * z))
            azimuth, elevation = float(np.degrees(np.arctan2(y, x)) % 360), float(np.degrees(np.arcsin(-z / distance)))
            made[name] = Place(round(azimuth, 3), round(elevation, 3) + 0.0, round(distance, 3))
        return made


def make_plan(
    plan_path: Path | None = None,
    rig_path: Path | None = None,
    *,
    count: int | None = None,
    apart_deg: float | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> Plan:
    """Predict what a rig will measure; without one find where its cameras should stand.

    Parameters
    ----------
    plan_path
        ``plan.yaml``; its defaults where absent.
    rig_path
        A rig to predict for.
    count, apart_deg
        In place of the file's.

    Raises
    ------
    InputError
        If a file cannot be used, or no place fulfils the rules.
    """
    task = load_plan(plan_path)
    task = replace(
        task,
        count=task.count if count is None else count,
        rules=task.rules if apart_deg is None else replace(task.rules, apart_deg=apart_deg),
    )
    if rig_path is not None:
        rig, remarks = _given(rig_path, task)
        poses = _survey(rig, task, progress)
        return Plan(task, rig, (), tuple(poses), (*remarks, *_unseen(poses)))
    few = task.workspace.poses(*_SEARCHED)
    found = best_places(few, task.tube, task.count, task.camera, task.rules, task.errors, task.calibration_px, progress)
    # The few poses leave out some that only a part of the cameras see: all are looked at for the best placements.
    made = []
    for placement in found:
        rig = rig_of(placement.places, task.camera, target_of(few), task.calibration_px)
        poses = _survey(rig, task, progress)
        tip = np.array([pose.deviations.tip_mm for pose in poses])
        seen = np.isfinite(tip)
        exact = replace(placement, tip_sd_mm=float(np.sqrt(np.mean(tip[seen] ** 2))), seen=float(seen.mean()))
        made.append((exact, rig, poses))
    made.sort(key=lambda one: (-one[0].seen, one[0].tip_sd_mm))
    _, rig, poses = made[0]
    remark = f"calibration taken to point each camera to {task.calibration_px:g} px"
    return Plan(task, rig, tuple(one[0] for one in made), tuple(poses), (remark, *_unseen(poses)))


def _survey(rig: Rig, task: Task, progress: Progress) -> list[Pose]:
    return survey(task.workspace.poses(*_SURVEYED), rig, task.tube, task.errors, task.rules.margin_px, progress)


def _given(path: Path, task: Task) -> tuple[Rig, list[str]]:
    rig = load_rig(path).rig
    if not rig.registered or len(rig.camera_from_base) < len(rig.cameras):
        raise InputError(f"{path}: not registered to the clamp; `tubesight register` does that, then plan again")
    if len(rig.cameras) < 2:
        raise InputError(f"{path}: one camera; a plan needs two or more")
    if rig.covariance is not None:
        return rig, ["calibration with the covariance in the rig file"]
    names = tuple(f"{name}.{axis}" for name in rig.names for axis in ("cx", "cy"))
    covariance = RigCovariance(names, task.calibration_px**2 * np.eye(len(names)))
    remark = f"the rig has no covariance: calibration taken to point each camera to {task.calibration_px:g} px"
    return replace(rig, covariance=covariance), [remark]


def _unseen(poses: Sequence[Pose]) -> list[str]:
    missed = {name for pose in poses for name in pose.unseen_by}
    return [
        f"{name} does not see all of the tube in {sum(name in p.unseen_by for p in poses)} of {len(poses)} poses"
        for name in sorted(missed)
    ]


def write_plan(out: Path, plan: Plan) -> list[Path]:
    """Write ``plan.json``, ``plan.csv`` (a row a pose), ``rig.yaml`` and, with matplotlib, ``plan.png``.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    from tubesight.apps.planning.picture import draw_plan
    from tubesight.outputs.plot3d import plots_installed

    write_json(out / "plan.json", plan.as_dict())
    rows = [pose.row() for pose in plan.poses]
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows({k: _cell(v) for k, v in row.items()} for row in rows)
    write_atomic(out / "plan.csv", text.getvalue())
    written = [out / "plan.json", out / "plan.csv"]
    if plan.placements:
        save_rig(out / "rig.yaml", plan.rig)
        written.append(out / "rig.yaml")
    if plots_installed():
        write_atomic(out / "plan.png", draw_plan(plan))
        written.append(out / "plan.png")
    return written


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.6g}" if np.isfinite(value) else ""
    return str(value)
