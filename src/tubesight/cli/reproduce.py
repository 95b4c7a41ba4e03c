"""``tubesight reproduce``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tubesight.apps.reproduce.registry import STUDIES
from tubesight.cli.spread_options import Resume, Scheduler, Workers


def command(
    studies: Annotated[
        list[str] | None, typer.Argument(metavar="[STUDY]...", help=f"Of {', '.join(STUDIES)}; all without one.")
    ] = None,
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for report, data and figures.")] = Path("reproduced"),
    quick: Annotated[bool, typer.Option("--quick", help="Coarse steps: minutes instead of most of an hour.")] = False,
    workers: Workers = None,
    scheduler: Scheduler = None,
    resume: Resume = False,
    seed: Annotated[int, typer.Option("--seed", min=0, help="Of all that is random.")] = 0,
) -> None:
    """Repeat the figures and tables of Dalvand, Nahavandi and Howe (2016) on rendered photographs.

    Writes a report that needs no other file, the data behind it, and a summary for programs.

        tubesight reproduce experiment1 --quick -o reproduced
    """
    from tubesight.apps.pool import usable_cores
    from tubesight.apps.reproduce.runner import reproduce
    from tubesight.cli.calibrate import bar
    from tubesight.cli.console import stdout

    with bar() as progress:
        made = reproduce(
            out,
            studies or (),
            quick=quick,
            seed=seed,
            workers=workers or usable_cores(),
            scheduler=scheduler,
            resume=resume,
            progress=progress,
        )
    console = stdout()
    for result in made.results.values():
        console.print(result.title, style="bold")
        for paragraph in result.paragraphs:
            console.print(paragraph)
    console.print(f"report   {made.report}", soft_wrap=True)
    console.print(f"summary  {made.summary}", soft_wrap=True)
