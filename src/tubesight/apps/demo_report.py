"""The demo's report: one HTML file that needs no other."""

from __future__ import annotations

import math
from base64 import b64encode
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

import cv2
import numpy as np

from tubesight import __version__
from tubesight.apps.evaluate import Evaluation
from tubesight.core import Image
from tubesight.files.safe import write_atomic
from tubesight.files.tables import ShapeRow
from tubesight.files.truth import TrueShape

# Overlays are 1920 px wide; at this width two cameras side by side still show edges, and the report stays small.
_PICTURE_PX, _PICTURE_QUALITY = 1200, 85

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>tubesight demo</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: #1c2733; background: #f6f7f9; margin: 0 }}
main {{ max-width: 1100px; margin: 0 auto; padding: 1.5rem }}
h1 {{ font-size: 1.6rem; margin-bottom: 0 }} h2 {{ font-size: 1.2rem; margin-top: 2.2rem }}
p, li {{ max-width: 75ch }}
.scroll {{ overflow-x: auto }}
table {{ border-collapse: collapse; background: #fff; font-variant-numeric: tabular-nums }}
th, td {{ padding: .3rem .7rem; border-bottom: 1px solid #dde2e8; text-align: right; white-space: nowrap }}
th:first-child, td:first-child, td.text {{ text-align: left }}
td.text {{ white-space: normal }}
img {{ max-width: 100%; height: auto; border-radius: 4px; display: block; margin: .4rem 0 1.2rem }}
small {{ color: #5b6875 }}
</style></head><body><main>
<h1>tubesight demo</h1>
<p><small>version {version}, {seconds} s. Research use only, not a medical device.</small></p>
<p>Photographs of a board and of tubes of known shape were simulated, the cameras calibrated and registered from the
boards, and the shapes measured. Nothing of the truth was used but to compare at the end.</p>
<h2>Measured against true</h2>
<div class="scroll">{table}</div>
<p>{summary}. Simulated photographs are kinder than real ones: their lenses are exactly those of the model, boards are
flat, nothing moves.</p>
<h2>Cameras</h2><ul>{verdicts}</ul>
<h2>What the pictures decided</h2><ul>{messages}</ul>
<h2>Pictures</h2>{pictures}
</main></body></html>
"""


@dataclass(frozen=True, slots=True)
class Comparison:
    """One frame of the demo.

    Attributes
    ----------
    row
        What was measured.
    true
        What is true.
    tip_error_mm
        Distance of the measured tip from the true one; NaN without a shape.
    """

    row: ShapeRow
    true: TrueShape
    tip_error_mm: float


# Headings of the table on screen and in the report; measured and true side by side.
HEADINGS = (
    *("frame", "status", "tip error\n[mm]"),
    *("bending\n[deg]", "true\n", "orientation\n[deg]", "true\n", "length\n[mm]", "true\n"),
)


def compare(rows: Iterable[ShapeRow], truth: Mapping[str, TrueShape], evaluation: Evaluation) -> list[Comparison]:
    """Pair rows with the truth."""
    return [Comparison(row, truth[row.frame], evaluation.frames[row.frame].tip_mm) for row in rows]


def cells(comparison: Comparison) -> list[str]:
    """Texts of one row of the table, in the order of `HEADINGS`."""
    row, true = comparison.row, comparison.true
    pairs = (
        (row.bending_deg, true.bending_deg),
        (row.orientation_deg, true.orientation_deg),
        (row.length_mm, true.length_mm),
    )
    numbers = [_fixed(comparison.tip_error_mm, 3), *(_fixed(value, 2) for pair in pairs for value in pair)]
    return [row.frame, row.status, *numbers]


def summary(evaluation: Evaluation) -> str:
    """Say how many shapes were measured, and the largest errors."""
    measured = len(evaluation.frames) - evaluation.failures
    tip, bending = evaluation.max("tip_mm"), evaluation.max("bending_deg")
    orientation, length = evaluation.max("orientation_deg"), evaluation.max("length_mm")
    return (
        f"{measured} of {len(evaluation.frames)} shapes measured; largest errors: tip {tip:.3f} mm, bending "
        f"{bending:.3f} deg, orientation {orientation:.3f} deg, length {length:.3f} mm"
    )


def write_report(
    path: Path,
    comparisons: Sequence[Comparison],
    evaluation: Evaluation,
    verdicts: Iterable[str],
    messages: Iterable[str],
    seconds: Mapping[str, float],
    results: Path,
) -> None:
    """Write the report.

    Parameters
    ----------
    verdicts
        On the cameras, a line each.
    messages
        Of the run, a line each.
    seconds
        By step.
    results
        Folder of the run; its overlays and plot go into the report.
    """
    page = _PAGE.format(
        version=escape(__version__),
        seconds=", ".join(f"{escape(step)} {value:.0f}" for step, value in seconds.items()),
        table=_table(comparisons),
        summary=escape(summary(evaluation)),
        verdicts=_items(verdicts),
        messages=_items(messages),
        pictures=_pictures([c.row.frame for c in comparisons], results),
    )
    write_atomic(path, page)


def _fixed(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"


def _table(comparisons: Sequence[Comparison]) -> str:
    head = "".join(f"<th>{escape(heading).replace(chr(10), '<br>')}</th>" for heading in (*HEADINGS, "notes"))
    rows = [
        "".join(f"<td>{escape(cell)}</td>" for cell in cells(c)) + f'<td class="text">{escape(c.row.notes)}</td>'
        for c in comparisons
    ]
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(f'<tr>{row}</tr>' for row in rows)}</tbody></table>"


def _items(lines: Iterable[str]) -> str:
    return "".join(f"<li>{escape(line)}</li>" for line in lines)


def _pictures(frames: Sequence[str], results: Path) -> str:
    """Embed the 3-D plot, where there is one, and the overlays."""
    found = [("all shapes, base frame", results / "shapes.png")]
    found += [(frame, results / "overlay" / f"{frame}.png") for frame in frames]
    images = [(name, np.asarray(cv2.imread(str(path)), np.uint8)) for name, path in found if path.is_file()]
    return "".join(
        f'<h3>{escape(name)}</h3><img alt="{escape(name)}" src="{_embedded(image)}">' for name, image in images
    )


def _embedded(image: Image) -> str:
    """Picture as a data URL, no wider than the page."""
    scale = min(_PICTURE_PX / image.shape[1], 1.0)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    _, data = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _PICTURE_QUALITY])
    return f"data:image/jpeg;base64,{b64encode(data.tobytes()).decode()}"
