"""``tubesight init``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    folder: Annotated[Path, typer.Argument(help="Where to put them; made where there is none.")] = Path("."),
    force: Annotated[bool, typer.Option("--force", help="Overwrite what is there.")] = False,
) -> None:
    """Write the files a session needs, with comments: tube, board, registration, run.

        tubesight init lab

    What is there already is kept.
    """
    from tubesight.apps.init import start_folder
    from tubesight.cli.console import stdout

    started = start_folder(folder, force)
    for path in started.written:
        stdout().print(f"{path}: written; change the numbers to yours", soft_wrap=True)
    for path in started.kept:
        stdout().print(f"{path}: is there already, kept (--force overwrites it)", soft_wrap=True)
