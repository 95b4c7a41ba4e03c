"""``tubesight recover``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer


def command(
    recording: Annotated[Path, typer.Argument(help="A recording whose writer was cut off.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="The whole recording to write, `.mcap`; must be new.")],
) -> None:
    """Write a recording that was cut off anew, whole and with its index.

    tubesight recover session.mcap -o whole.mcap
    """
    from tubesight.apps.live.recover import recover
    from tubesight.cli.console import stdout

    found = recover(recording, out)
    stdout().print(f"{found.results} results over {found.seconds:.1f} s in {out}", soft_wrap=True)
