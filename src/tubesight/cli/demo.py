"""``tubesight demo``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubesight.apps.demo import Demo


def command(
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for everything the demo makes.")] = Path("demo-out"),
    quick: Annotated[bool, typer.Option("--quick", help="Smaller pictures, fewer of them.")] = False,
) -> None:
    """See it work: no camera and no file is needed.

    Simulates photographs of a chessboard and of tubes of known shape, calibrates and registers the cameras, measures
    the shapes, compares them with the truth, and says where the pictures and the report are.

        tubesight demo -o demo-out
    """
    from tubesight.apps.demo import run_demo
    from tubesight.cli.calibrate import bar

    with bar() as progress:
        demo = run_demo(out, quick, progress)
    _print(demo)
    measured = any(comparison.row.status == "ok" for comparison in demo.comparisons)
    raise typer.Exit(0 if measured else 1)


def _print(demo: Demo) -> None:
    from tubesight.apps.demo_report import HEADINGS, cells
    from tubesight.cli.console import stdout, table
    from tubesight.core import Status

    console = stdout()
    for verdict in demo.verdicts:
        console.print(verdict, soft_wrap=True)
    shown = table(HEADINGS, texts=2)
    for comparison in demo.comparisons:
        shown.add_row(*cells(comparison))
    console.print(shown)
    console.print(demo.summary, soft_wrap=True)
    for comparison in demo.comparisons:
        row = comparison.row
        if row.status != Status.OK:
            console.print(f"{row.frame}: {row.status}: {row.notes}", soft_wrap=True)
    steps = ", ".join(f"{step} {seconds:.0f} s" for step, seconds in demo.seconds.items())
    console.print(f"took {sum(demo.seconds.values()):.0f} s: {steps}")
    width = max(map(len, demo.places))
    for what, path in demo.places.items():
        console.print(f"{what:{width}}  {path}", soft_wrap=True)
