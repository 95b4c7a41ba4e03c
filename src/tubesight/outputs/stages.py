"""Pictures of what each stage of a pipeline makes of a photograph, as figure 4 of Dalvand, Nahavandi & Howe 2016."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from string import ascii_lowercase

import cv2
import numpy as np

from tubesight.core import Array, FramePair, Image, Unmeasurable
from tubesight.files.safe import write_atomic
from tubesight.methods import METHODS
from tubesight.outputs.stages_own import own_stages
from tubesight.outputs.stages_paper import paper_stages
from tubesight.sensor import Reconstruction, ShapeSensor
from tubesight.vision.reference import Reference

# Longer side of a stage's picture; size of its panel in the sheet of all of them, four in a row as in the paper.
_SIDE_PX, _PANEL_PX, _TITLE_PX, _COLUMNS = 960, 420, 34, 4


def write_stages(out: Path, pair: FramePair, result: Reconstruction, sensor: ShapeSensor) -> list[Path]:
    """Write each camera's stages to ``stages/FRAME/CAMERA_LETTER_NAME.png``, and a sheet of them, ``CAMERA.png``.

    The reference pipelines give figure 4 (a) to (l) of the paper; the others picture, signal, scans, edges, tip
    contour, centreline and reprojection. The pictures end with the stage that failed.
    """
    folder, files = out / "stages" / result.frame, []
    for name in sensor.rig.names:
        panels = []
        for letter, (title, picture) in zip(ascii_lowercase, _stages(name, pair, result, sensor), strict=False):
            files.append(_write(folder / f"{name}_{letter}_{title.replace(' ', '_')}.png", _fitted(picture, _SIDE_PX)))
            panels.append(_panel(f"({letter}) {title}", picture))
        if panels:
            files.append(_write(folder / f"{name}.png", _sheet(panels)))
    return files


def _stages(name: str, pair: FramePair, result: Reconstruction, sensor: ShapeSensor) -> Iterator[tuple[str, Image]]:
    image, camera = pair.images[name], sensor.rig.cameras[name]
    if isinstance(METHODS[result.method].see, Reference):
        try:
            start, base_px = sensor.start_of(name)
        except Unmeasurable:
            return
        yield from paper_stages(image, camera, sensor.tube, start, base_px)
        return
    yield "picture", image
    view = result.views.get(name)
    if view is not None:
        yield from own_stages(image, sensor.backgrounds.get(name), view, _curve_px(name, result, sensor))


def _curve_px(name: str, result: Reconstruction, sensor: ShapeSensor) -> Array | None:
    """Project the curve (201, 2) into a camera; None where there is none."""
    if result.curve is None:
        return None
    return sensor.rig.project(name, result.curve.at(np.linspace(0.0, result.curve.length_mm, 201)))


def _write(path: Path, picture: Image) -> Path:
    _, data = cv2.imencode(".png", picture)
    write_atomic(path, data.tobytes())
    return path


def _fitted(picture: Image, side: int) -> Image:
    """Resize to a longer side; enlarged pixels stay sharp squares."""
    scale = side / max(picture.shape[:2])
    size = (max(round(picture.shape[1] * scale), 1), max(round(picture.shape[0] * scale), 1))
    return np.asarray(
        cv2.resize(picture, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_NEAREST), np.uint8
    )


def _panel(title: str, picture: Image) -> Image:
    """Square panel (H, W, 3) with a title below the picture."""
    fitted = _fitted(picture, _PANEL_PX)
    if fitted.ndim == 2:
        fitted = np.asarray(cv2.cvtColor(fitted, cv2.COLOR_GRAY2BGR), np.uint8)
    panel = np.full((_PANEL_PX + _TITLE_PX, _PANEL_PX + 8, 3), 255, np.uint8)
    x, y = 4 + (_PANEL_PX - fitted.shape[1]) // 2, (_PANEL_PX - fitted.shape[0]) // 2
    panel[y : y + fitted.shape[0], x : x + fitted.shape[1]] = fitted
    at = (8, _PANEL_PX + _TITLE_PX - 10)
    cv2.putText(panel, title, at, cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 0), 1, cv2.LINE_AA)
    return panel


def _sheet(panels: list[Image]) -> Image:
    """Panels in rows of four."""
    blank = np.full_like(panels[0], 255)
    padded = panels + [blank] * (-len(panels) % _COLUMNS)
    rows = [np.concatenate(padded[i : i + _COLUMNS], axis=1) for i in range(0, len(padded), _COLUMNS)]
    return np.concatenate(rows)
