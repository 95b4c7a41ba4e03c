"""A comparison as one HTML file that needs no other."""

from __future__ import annotations

from base64 import b64encode
from collections import Counter
from collections.abc import Mapping
from html import escape
from math import isfinite

import cv2

from tubesight import __version__
from tubesight.apps.compare.comparison import Comparison
from tubesight.apps.compare.criteria import CRITERIA, stated
from tubesight.apps.compare.measure import largest, mean
from tubesight.core import Image

_PICTURE_PX, _QUALITY = 1400, 82
_MARKS = {True: "yes", False: "no", None: "open"}
_CAPTIONS = {
    "error_time.png": "Mean distance of the measured centrelines from the true ones against the time a pair takes; "
    "dashed: 1 mm and 30 pairs a second. Both axes are logarithmic; failures count on neither.",
    "resolution.png": "The same against the width of the pictures, on three of the tubes.",
}
_HEADINGS = (
    ("tip", "mm"),
    ("bending", "deg"),
    ("orientation", "deg"),
    ("length", "mm"),
    ("curve", "mm"),
)
_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>tubesight compare</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: #1c2733; background: #f6f7f9; margin: 0 }}
main {{ max-width: 1200px; margin: 0 auto; padding: 1.5rem }}
h1 {{ font-size: 1.6rem; margin-bottom: 0 }}
h2 {{ font-size: 1.25rem; margin-top: 2.5rem }}
h3 {{ font-size: 1rem; margin: 2rem 0 .3rem }}
p, li, figcaption {{ max-width: 85ch }}
.scroll {{ overflow-x: auto; margin: 1.2rem 0 }}
table {{ border-collapse: collapse; background: #fff; font-variant-numeric: tabular-nums; font-size: .9rem }}
th, td {{ padding: .3rem .6rem; border-bottom: 1px solid #dde2e8; text-align: right; white-space: nowrap }}
th {{ vertical-align: bottom }}
th:first-child, td:first-child, td.text, th.text {{ text-align: left }}
td.text {{ white-space: normal; min-width: 9rem }}
td.yes {{ background: #e3f1ea }} td.no {{ background: #f8e5de }} td.open {{ color: #5a6672 }}
td small {{ display: block; color: #5a6672 }}
img {{ max-width: 100%; height: auto; border-radius: 4px; background: #fff; display: block }}
figure {{ margin: 1.2rem 0 }}
figcaption, small {{ color: #414d59 }}
</style></head><body><main>
<h1>Methods compared on identical pictures</h1>
<p><small>tubesight {version}, {source}, {cores} cores, {platform}.
Research use only, not a medical device.</small></p>
<p>{intro}</p>
<h2>Errors and times</h2>
<div class="scroll">{table}</div>
<p>Each cell: mean, largest absolute error of the pairs that gave a shape. <b>curve</b> is the distance between the
measured and the true centreline, the larger of the two directions: its mean along the curve averaged over the pairs,
and its largest value. <b>time</b> is processor time of one core from pictures to curve, failures included.</p>
{figures}
<h2>The nine criteria</h2>
<p>Dalvand, Nahavandi and Howe (2016) list nine criteria for vision-based shape sensing and state, from the literature,
which system meets which. Here they are decided by measurement; small print: what their table 2 states.</p>
<div class="scroll">{criteria}</div>
<ol>{rules}</ol>
<h2>Failures</h2>
{failures}
<h2>Worst case of each method</h2>
<p>Green: the true centreline. Where no pair gave a curve, the first failure is shown.</p>
{worst}
</main></body></html>
"""


def page(made: Comparison, pictures: Mapping[str, bytes]) -> str:
    """Write the page.

    Parameters
    ----------
    pictures
        PNG of the drawings by name (`tubesight.apps.compare.figures`).
    """
    machine = made.about["machine"]
    source = made.about["pictures"]
    return _PAGE.format(
        version=escape(__version__),
        source=escape(source if isinstance(source, str) else ", ".join(source)),
        cores=machine["cores"],
        platform=escape(str(machine["platform"])),
        intro=escape(_intro(made)),
        table=_table(made),
        figures="".join(_figure(data, "png", _CAPTIONS[name]) for name, data in pictures.items()),
        criteria=_criteria(made),
        rules="".join(f"<li>{escape(rule)}</li>" for rule in CRITERIA.values()),
        failures=_failures(made),
        worst="".join(_worst(made, name) for name in made.methods),
    )


def _intro(made: Comparison) -> str:
    cases = len({row.case for row in made.rows})
    rendered = isinstance(made.about["pictures"], str)
    how = (
        "Rendered photographs of tubes with exactly known shape, seen by cameras whose calibration is exact: every "
        "method gets the same tubes, from the same places, with the same noise, and the pictures with bands, a grid or "
        "more cameras that its paper needs. Rendered photographs are kinder than real ones."
        if rendered
        else "The pictures of these folders with their own rig; methods whose paper needs bands, a grid or more "
        "cameras get the same pictures and fail where they lack them."
    )
    return f"{len(made.methods)} methods on {cases} pairs of pictures. {how}"


def _table(made: Comparison) -> str:
    head = '<th>method</th><th class="text">given beyond two<br>calibrated pictures</th>'
    head += "".join(f"<th>{name}<br>[{unit}]</th>" for name, unit in _HEADINGS)
    head += "<th>time<br>[ms]</th><th>failed</th>"
    rows = []
    for name in made.methods:
        own = made.of(name)
        cells = [_pair(mean(own, column), largest(own, top)) for column, top in _COLUMNS]
        numbers = "".join(f"<td>{cell}</td>" for cell in cells)
        failed = f"{sum(not row.ok for row in own)} of {len(own)}"
        rows.append(
            f"<tr><td>{escape(name)}</td><td class='text'>{escape(', '.join(made.given[name]) or 'nothing')}</td>"
            f"{numbers}<td>{_number(mean(own, 'ms'), 1)}</td><td>{failed}</td></tr>"
        )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


_COLUMNS = (
    ("tip_mm", "tip_mm"),
    ("bending_deg", "bending_deg"),
    ("orientation_deg", "orientation_deg"),
    ("length_mm", "length_mm"),
    ("curve_mean_mm", "curve_max_mm"),
)


def _pair(one: float, other: float) -> str:
    return f"{_number(one, 3)}, {_number(other, 2)}" if isfinite(one) else "-"


def _number(value: float, digits: int) -> str:
    return f"{value:.{digits}f}" if isfinite(value) else "-"


def _criteria(made: Comparison) -> str:
    head = "".join(f"<th>{key}</th>" for key in CRITERIA)
    rows = []
    for name in made.methods:
        paper = stated(name)
        cells = ""
        for key, met in made.criteria[name].items():
            small = f"<small>stated: {_MARKS[paper[key]].replace('open', '?')}</small>" if paper else ""
            cells += f'<td class="{_MARKS[met]}">{_MARKS[met]}{small}</td>'
        rows.append(f"<tr><td>{escape(name)}</td>{cells}</tr>")
    return f"<table><thead><tr><th>method</th>{head}</tr></thead><tbody>{''.join(rows)}</tbody></table>"


def _failures(made: Comparison) -> str:
    lines = []
    for name in made.methods:
        bad = [row for row in made.of(name) if not row.ok]
        counts = Counter((row.status, row.reason) for row in bad).most_common(3)
        if counts:
            texts = "; ".join(f"{status} ({count}): {reason}" for (status, reason), count in counts)
            lines.append(f"<li><b>{escape(name)}</b>, {len(bad)} pairs: {escape(texts)}</li>")
    return f"<ul>{''.join(lines)}</ul>" if lines else "<p>None.</p>"


def _worst(made: Comparison, name: str) -> str:
    worst = made.worst[name]
    row = worst.row
    said = f"largest distance {row.curve_max_mm:.2f} mm, tip {row.tip_mm:.2f} mm" if row.ok else row.status
    caption = f"{row.case}: {said}"
    return f"<h3>{escape(name)}</h3>{_figure(_jpeg(worst.picture), 'jpeg', caption)}"


def _figure(data: bytes, kind: str, caption: str) -> str:
    source = f"data:image/{kind};base64,{b64encode(data).decode()}"
    text = escape(caption)
    return f'<figure><img alt="{text}" src="{source}"><figcaption>{text}</figcaption></figure>'


def _jpeg(image: Image) -> bytes:
    scale = min(_PICTURE_PX / image.shape[1], 1.0)
    small = cv2.resize(image, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, _QUALITY])[1].tobytes()
