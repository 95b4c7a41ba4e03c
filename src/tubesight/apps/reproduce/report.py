"""The report: one HTML file that needs no other."""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Mapping
from html import escape
from typing import Any

from tubesight import __version__
from tubesight.apps.reproduce.study import Figure, StudyResult, Table

_PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>tubesight reproduce</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>
body {{ font: 16px/1.5 system-ui, sans-serif; color: #1c2733; background: #f6f7f9; margin: 0 }}
main {{ max-width: 1100px; margin: 0 auto; padding: 1.5rem }}
h1 {{ font-size: 1.6rem; margin-bottom: 0 }}
h2 {{ font-size: 1.25rem; margin-top: 3rem; border-top: 1px solid #cfd6dd; padding-top: 1.5rem }}
p, li, figcaption, caption {{ max-width: 80ch }}
.scroll {{ overflow-x: auto; margin: 1.2rem 0 }}
table {{ border-collapse: collapse; background: #fff; font-variant-numeric: tabular-nums }}
th, td {{ padding: .3rem .7rem; border-bottom: 1px solid #dde2e8; text-align: right; white-space: nowrap }}
th {{ white-space: normal; vertical-align: bottom }}
th.words, td.words {{ text-align: left; white-space: normal; min-width: 7em }}
caption {{ text-align: left; padding: .2rem 0; color: #414d59 }}
figure {{ margin: 1.2rem 0 }}
img {{ max-width: 100%; height: auto; border-radius: 4px; background: #fff; display: block }}
figcaption, small {{ color: #414d59 }}
</style></head><body><main>
<h1>Fast vision-based catheter 3D reconstruction, measured again</h1>
<p><small>tubesight {version}, {about}. Research use only, not a medical device.</small></p>
<p>Each section below repeats a figure or a table of Dalvand, Nahavandi and Howe (2016, Physics in Medicine and Biology
61, 5128) on rendered photographs whose truth is known exactly. <code>reference</code> is the paper's own pipeline,
<code>cone_ray</code> its closed form on sub-pixel edges, <code>silhouette</code> the fit to those edges. Rendered
photographs are kinder than real ones: tubes are exactly as stated and the lenses are those of the model. Every number
is read from <code>data/</code>.</p>
<ul>{contents}</ul>
{sections}
</main></body></html>
"""


def page(results: Mapping[str, StudyResult], about: Mapping[str, Any]) -> str:
    """Write all results as one page; figures are embedded."""
    contents = "".join(f'<li><a href="#{name}">{escape(r.title)}</a></li>' for name, r in results.items())
    return _PAGE.format(
        version=escape(__version__),
        about=escape(", ".join(f"{key} {value}" for key, value in about.items())),
        contents=contents,
        sections="".join(_section(name, result) for name, result in results.items()),
    )


def _section(name: str, result: StudyResult) -> str:
    parts = [f'<section id="{escape(name)}"><h2>{escape(result.title)}</h2>']
    parts += [f"<p>{escape(paragraph)}</p>" for paragraph in result.paragraphs]
    parts += [_table(table) for table in result.tables]
    parts += [_figure(figure) for figure in result.figures]
    names = ", ".join(f"<code>data/{escape(path.name)}</code>" for path in result.data)
    parts.append(f"<p><small>Data: {names}</small></p></section>" if names else "</section>")
    return "\n".join(parts)


def _table(table: Table) -> str:
    """Columns with words are aligned left, numbers right."""
    words = [any(any(map(str.isalpha, cell)) for cell in column) for column in zip(*table.rows, strict=True)]

    def line(tag: str, cells: tuple[str, ...]) -> str:
        kinds = (' class="words"' if is_words else "" for is_words in words)
        return "".join(f"<{tag}{kind}>{escape(cell)}</{tag}>" for kind, cell in zip(kinds, cells, strict=True))

    rows = "".join(f"<tr>{line('td', row)}</tr>" for row in table.rows)
    head = f"<caption>{escape(table.caption)}</caption><thead><tr>{line('th', table.heading)}</tr></thead>"
    return f'<div class="scroll"><table>{head}<tbody>{rows}</tbody></table></div>'


def _figure(figure: Figure) -> str:
    data = b64encode(figure.path.read_bytes()).decode()
    caption = escape(figure.caption)
    return (
        f'<figure><img alt="{caption}" src="data:image/png;base64,{data}"><figcaption>{caption}</figcaption></figure>'
    )
