"""``tubesight compare``."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubesight.apps.compare.comparison import Comparison


def command(
    folders: Annotated[
        list[Path] | None, typer.Argument(metavar="[FOLDER]...", help="Pictures with rig, tube.yaml and truth.json.")
    ] = None,
    methods: Annotated[
        list[str] | None, typer.Option("--methods", metavar="NAME,...", help="Methods to compare; all without it.")
    ] = None,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Folder for the page, the rows and figures.")] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Fewer and smaller pictures.")] = False,
    external: Annotated[
        bool, typer.Option("--external", help="Compare icpReconstructor too, in a process of its own.")
    ] = False,
    external_python: Annotated[
        str, typer.Option("--external-python", metavar="PYTHON", help="Interpreter that has icpReconstructor.")
    ] = sys.executable,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Measure the same pictures with every method and compare errors, times and what each needs.

    Without a folder, experiment 1 of Dalvand, Nahavandi and Howe (2016) is rendered, with the bands, the grid and the
    cameras that a method needs.

        tubesight compare --quick -o compared
    """
    from tubesight.apps.compare.comparison import compare
    from tubesight.apps.compare.writing import write
    from tubesight.cli.calibrate import bar
    from tubesight.cli.console import remark
    from tubesight.files.tables import to_json

    names = [name.strip() for text in methods or () for name in text.split(",")]
    with bar() as progress:
        made = compare(folders or (), names, quick, external_python if external else None, progress)
    if out is not None:
        written = write(made, out)
        remark(f"wrote {path}" for path in written)
    if json:
        typer.echo(to_json(made.as_dict()))
    else:
        _print(made)


def _print(made: Comparison) -> None:
    from tubesight.apps.compare.measure import largest, mean
    from tubesight.cli.console import fixed, stdout, table

    columns = ("tip\nmean", "[mm]\nmax", "curve\nmean", "[mm]\nmax", "time\n[ms]", "failed")
    shown = table(("method", *columns, "criteria met"), texts=1)
    for name in made.methods:
        rows = made.of(name)
        shown.add_row(
            name,
            fixed(mean(rows, "tip_mm"), 3),
            fixed(largest(rows, "tip_mm"), 3),
            fixed(mean(rows, "curve_mean_mm"), 3),
            fixed(largest(rows, "curve_max_mm"), 3),
            fixed(mean(rows, "ms"), 1),
            f"{sum(not row.ok for row in rows)}/{len(rows)}",
            "".join(key if met else "." for key, met in made.criteria[name].items()),
        )
    stdout().print(shown)
