"""A calibration in pictures: where corners were seen and how they fit, and one page that holds everything."""

from __future__ import annotations

import base64
from collections.abc import Mapping, Sequence
from html import escape

import cv2
import numpy as np

from tubesight.calibration.coverage import tint_empty
from tubesight.calibration.quality import Verdict
from tubesight.calibration.scene import Observation, rms
from tubesight.core import Array, Image

# Width of a coverage picture; enough to tell corners 20 pixels apart in a picture of 1920.
_WIDTH_PX = 960
# Length in the picture, as a share of its width, of a residual three times the RMS.
_VECTOR_SHARE = 0.02
# BGR, on the dimmed photograph: corners that fit, corners off by three times the RMS.
_GOOD, _BAD = np.array([120.0, 220.0, 90.0]), np.array([60.0, 70.0, 255.0])

Label = tuple[str, str]
"""Camera and view of an observation."""


def coverage_picture(
    size_px: tuple[int, int],
    observations: Sequence[Observation],
    residuals_px: Sequence[Array],
    photograph: Image | None,
) -> Image:
    """Draw all corners of one camera over a photograph, with their residuals enlarged; empty cells are tinted.

    Parameters
    ----------
    photograph
        One of the camera's pictures, dimmed; None for a plain ground.
    """
    width, height = size_px
    scale = _WIDTH_PX / width
    shape = (round(height * scale), _WIDTH_PX)
    picture = np.full((*shape, 3), 40, np.uint8)
    if photograph is not None:
        gray = photograph if photograph.ndim == 2 else cv2.cvtColor(photograph, cv2.COLOR_BGR2GRAY)
        dimmed = cv2.resize(gray, shape[::-1], interpolation=cv2.INTER_AREA).astype(float) * 0.35 + 25
        picture = np.repeat(dimmed[..., None], 3, -1).astype(np.uint8)
    px = np.concatenate([o.px for o in observations])
    off = np.concatenate(list(residuals_px))
    tint_empty(picture, px * scale)
    typical = max(rms([off]), 1e-6)
    longer = _VECTOR_SHARE * _WIDTH_PX / (3 * typical)
    for place, vector in zip(px, off, strict=True):
        start = (place + 0.5) * scale - 0.5
        share = min(float(np.linalg.norm(vector)) / (3 * typical), 1.0)
        colour = tuple(float(c) for c in _GOOD + share * (_BAD - _GOOD))
        # Fixed-point coordinates with 4 fractional bits.
        ends = [tuple(int(v) for v in np.rint(16 * p)) for p in (start, start + longer * vector)]
        cv2.circle(picture, ends[0], 2 * 16, colour, -1, cv2.LINE_AA, 4)
        cv2.line(picture, ends[0], ends[1], colour, 1, cv2.LINE_AA, 4)
    caption = f"{len(px)} corners, RMS {rms([off]):.3f} px, lines: misfit enlarged {longer / scale:.0f} times"
    cv2.rectangle(picture, (0, shape[0] - 26), (shape[1], shape[0]), (20, 20, 20), -1)
    cv2.putText(picture, caption, (8, shape[0] - 8), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (235, 235, 235), 1, cv2.LINE_AA)
    return np.asarray(picture, dtype=np.uint8)


def page(
    title: str,
    verdict: Verdict,
    tables: Mapping[str, Sequence[Sequence[str]]],
    view_px: Mapping[Label, float],
    notes: Sequence[str],
    pictures: Mapping[str, bytes],
) -> str:
    """Write the report: one HTML page that needs no other file.

    Parameters
    ----------
    tables
        By caption: rows of cells, the first row being the heading.
    view_px
        RMS of each picture.
    notes
        Pictures left out and warnings.
    pictures
        PNG files by caption.
    """
    parts = [
        f"<h1>{escape(title)}</h1>",
        f'<p class="verdict {verdict.level}">{escape(verdict.sentence)}</p>',
        f"<p><b>Next:</b> {escape(verdict.next_step)}.</p>",
    ]
    remarks = [*verdict.remarks, *notes]
    if remarks:
        parts.append("<ul>" + "".join(f"<li>{escape(r)}</li>" for r in remarks) + "</ul>")
    parts += [_table(caption, rows) for caption, rows in tables.items()]
    parts.append(_bars(view_px))
    parts += [
        f'<figure><img alt="{escape(caption)}" src="data:image/png;base64,{base64.b64encode(data).decode()}">'
        f"<figcaption>{escape(caption)}</figcaption></figure>"
        for caption, data in pictures.items()
    ]
    return (
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{escape(title)}</title>'
        f"<style>{_STYLE}</style></head><body>{''.join(parts)}</body></html>\n"
    )


def _table(caption: str, rows: Sequence[Sequence[str]]) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in rows[0])
    body = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in rows[1:])
    return f"<h2>{escape(caption)}</h2><table><tr>{head}</tr>{body}</table>"


def _bars(view_px: Mapping[Label, float]) -> str:
    """Bar chart of the RMS of each picture."""
    longest = max(view_px.values(), default=0.0)
    rows = "".join(
        f"<tr><td>{escape(camera)}/{escape(view)}</td><td>{px:.3f}</td>"
        f'<td class="wide"><div class="bar" style="width:{100 * px / max(longest, 1e-9):.0f}%"></div></td></tr>'
        for (camera, view), px in view_px.items()
    )
    return f"<h2>Pictures: RMS [px]</h2><table>{rows}</table>"


_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 62rem; margin: 2rem auto; padding: 0 1rem; color: #1c2733 }
h1 { font-size: 1.5rem } h2 { font-size: 1.1rem; margin: 1.6rem 0 .4rem }
table { border-collapse: collapse } td, th { padding: .15rem .8rem .15rem 0; text-align: left; vertical-align: top }
th { border-bottom: 1px solid #8a97a5 } td { font-variant-numeric: tabular-nums }
td.wide { width: 24rem } .bar { background: #4f81bd; height: .7rem }
.verdict { padding: .5rem .8rem; border-left: .4rem solid } .good { border-color: #3a9d5d; background: #eaf6ee }
.usable { border-color: #d39a1f; background: #fbf4e3 } .poor { border-color: #c8463c; background: #fbeae8 }
figure { margin: 1.2rem 0 } img { max-width: 100% } figcaption { color: #55626f }
"""
