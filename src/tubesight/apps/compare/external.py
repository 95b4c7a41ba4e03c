"""icpReconstructor (Hoffmann et al. 2024) in the same comparison, in a process and an environment of its own.

It fits a polynomial of curvature to the pixels of two masks by iterative closest points. It is given the true length
and the masks that tubesight's own edges enclose. As shipped (0.1.5) its fit ends in a NameError; both that and the fit
with the missing name set are reported.
"""

from __future__ import annotations

import json
import subprocess
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from tubesight.apps.compare.cases import Case, Shot
from tubesight.apps.compare.measure import CRASHED, Measured, Row, errors
from tubesight.core import Array, InputError, Status
from tubesight.geometry.rig import Rig
from tubesight.geometry.shape import shape_of
from tubesight.geometry.splines import interpolating
from tubesight.sensor import Reconstruction, ShapeSensor
from tubesight.vision.view import View

SHIPPED, PATCHED = "icpReconstructor", "icpReconstructor_patched"
GIVEN = ("length", "masks of the other methods")
# Its step is 0.2 in curvature (1 / m), and a bend of 70 degrees has 8: 40 steps to get there, and as many again to
# settle five times over.
_ITERATIONS = 200
# On pictures of 1080p a pair took 5 to 160 s: what takes longer than this does not end.
_LONGEST_S = 900
# Pixels to a side of the picture of a mask: more only makes its search for closest points slower.
_MASK_PX = 20_000
_WORKER = Path(__file__).with_name("icp_worker.py")


def check(python: str) -> None:
    """Refuse an interpreter that lacks icpReconstructor, before hours of work.

    Raises
    ------
    InputError
        If it cannot be started or cannot import the package.
    """
    remedy = "install it in an environment of its own and name that with --external-python"
    try:
        code = "import icpReconstructor.torch_reconstruction"
        done = subprocess.run([python, "-E", "-c", code], capture_output=True, text=True, timeout=_LONGEST_S)
    except (OSError, subprocess.TimeoutExpired) as error:
        raise InputError(f"--external: {python} cannot be run ({error}); {remedy}") from error
    if done.returncode != 0:
        last = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise InputError(f"--external: {python} has no icpReconstructor ({last}); {remedy}")


def external(case: Case, python: str) -> Iterator[Measured]:
    """Measure a case as shipped and patched."""
    shot = case.shot("plain")
    views = ShapeSensor(shot.rig, case.tube, backgrounds=shot.backgrounds)(shot.pair).views
    width = next(iter(shot.pair.images.values())).shape[1]
    known = {"case": case.name, "kind": case.true.kind, "width_px": width, "cameras": len(shot.rig.names)}
    if len(views) < len(shot.rig.names):
        for name in (SHIPPED, PATCHED):
            row = Row(name, **known, status=str(Status.TUBE_NOT_FOUND), reason="no masks: the tube was not found")
            yield Measured(row, shot, None)
        return
    results = _run(_job(views, shot.rig, case.true.length_mm), python)
    shipped = results.get("as_shipped", {"error": "no result"})
    for name, result in ((SHIPPED, shipped), (PATCHED, results.get("patched", shipped))):
        yield _measured(name, result, case, shot, known)


def _measured(name: str, result: Mapping[str, Any], case: Case, shot: Shot, known: Mapping[str, Any]) -> Measured:
    points = 1e3 * np.array(result.get("points_m", np.nan), dtype=np.float64)
    if "error" in result or not np.isfinite(points).all():
        reason = str(result.get("error", "the curve is not finite"))
        return Measured(Row(name, **known, status=CRASHED, reason=reason), shot, None)
    curve = interpolating(points)
    shape = shape_of(curve, 0.0)
    off = errors(curve, case.true, np.degrees(shape.bending_rad), np.degrees(shape.orientation_rad))
    good = Row(name, **known, status=str(Status.OK), ms=1e3 * float(result["seconds"]))
    row = replace(good, **off)  # type: ignore[arg-type]
    return Measured(row, shot, Reconstruction(case.name, Status.OK, (), shape, curve, {}, name))


def _job(views: Mapping[str, View], rig: Rig, length_mm: float) -> dict[str, Any]:
    """Arrays of the worker: masks as pixels, cameras, length."""
    job: dict[str, Any] = {"cameras": len(views), "length_m": length_mm / 1e3, "iterations": _ITERATIONS}
    for k, (name, view) in enumerate(views.items()):
        camera, pose = rig.cameras[name], rig.camera_from_base[name]
        pixels = mask_pixels(view, camera.size_px)
        job[f"pixels{k}"] = pixels[:: max(len(pixels) // _MASK_PX, 1)]
        job[f"matrix{k}"] = camera.matrix
        job[f"distortion{k}"] = camera.distortion[:5]
        extrinsic = np.column_stack([pose.rotation, pose.translation_mm / 1e3])
        job[f"projection{k}"] = camera.matrix @ extrinsic
    return job


def mask_pixels(view: View, size_px: tuple[int, int]) -> np.ndarray[Any, np.dtype[np.int64]]:
    """Pixels (N, 2), x and y, between the edges of a view and of its tip."""
    mask = np.zeros(size_px[::-1], np.uint8)
    for outline in (np.concatenate([view.edges_px[:, 0], view.edges_px[::-1, 1]]), _tip_outline(view)):
        cv2.fillPoly(mask, [np.rint(outline * 16).astype(np.int32)], 1, cv2.LINE_8, 4)
    return np.argwhere(mask)[:, ::-1].astype(np.int64)


def _tip_outline(view: View) -> Array:
    """Hull of the last edges and the contour of the tip."""
    points = np.concatenate([view.edges_px[-1], view.tip.contour_px])
    return np.asarray(cv2.convexHull(points.astype(np.float32))[:, 0], dtype=np.float64)


def _run(job: Mapping[str, Any], python: str) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as folder:
        source, target = Path(folder) / "job.npz", Path(folder) / "result.json"
        np.savez(source, **job)
        command = [python, "-E", str(_WORKER), str(source), str(target)]
        try:
            done = subprocess.run(command, capture_output=True, text=True, timeout=_LONGEST_S)
        except subprocess.TimeoutExpired:
            return {"as_shipped": {"error": f"no result within {_LONGEST_S} s"}}
        if done.returncode != 0 or not target.is_file():
            last = (done.stderr.strip().splitlines() or ["no message"])[-1]
            return {"as_shipped": {"error": last}}
        found: dict[str, Any] = json.loads(target.read_text(encoding="utf-8"))
        return found
