"""``tubesight replay``."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import Annotated

import typer


def command(
    recording: Annotated[Path, typer.Argument(help="A recording, `.mcap`.")],
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for `shapes.csv` and `curves.npz` of what is measured.")
    ] = None,
    method: Annotated[str | None, typer.Option("--method", help="Another method than that of the recording.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Measure the pictures of a recording again, and compare with what was measured then.

    Exit code 0 where every pair that was measured then gives the same numbers to their last bit.

        tubesight replay session.mcap
    """
    from tubesight.apps.live.replay import replay_file
    from tubesight.cli.console import remark, stdout
    from tubesight.cli.run import refuse_unknown
    from tubesight.files.tables import to_json

    if method is not None:
        refuse_unknown(method)
    done = replay_file(recording, out, method)
    if json:
        typer.echo(to_json(asdict(done)))
    else:
        remark(done.differences)
        stdout().print(
            f"{done.pairs} pairs measured; of {done.compared} measured then, {done.equal} give the same numbers",
            soft_wrap=True,
        )
        if done.without_pictures:
            stdout().print(f"{done.without_pictures} pairs without pictures are left out")
        if not done.exact:
            stdout().print("the recording holds coded copies of the pictures: differences are to be expected")
    raise typer.Exit(0 if done.equal == done.compared else 1)
