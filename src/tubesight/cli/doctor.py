"""``tubesight doctor``."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer


def command(json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False) -> None:
    """Say what is wrong with this installation, and how to mend it.

        tubesight doctor

    Looks at versions, the OpenCV wheel, the cache, cameras, ports and disks.
    """
    from tubesight.apps.doctor import examine
    from tubesight.cli.console import stdout
    from tubesight.files.tables import to_json

    checks = examine()
    bad = [check for check in checks if check.grade == "bad"]
    if json:
        typer.echo(to_json({"ok": not bad, "checks": [asdict(check) for check in checks]}))
        raise typer.Exit(1 if bad else 0)
    console = stdout()
    width = max(len(check.name) for check in checks)
    for check in checks:
        console.print(f"{check.grade:4}  {check.name:{width}}  {check.found}", soft_wrap=True)
        if check.remedy:
            console.print(f"{'':{width + 8}}{check.remedy}", soft_wrap=True)
    warned = sum(check.grade == "warn" for check in checks)
    console.print(f"{len(checks)} checks: {len(bad)} bad, {warned} to know of", soft_wrap=True)
    raise typer.Exit(1 if bad else 0)
