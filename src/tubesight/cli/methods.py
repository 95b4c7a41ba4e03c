"""``tubesight methods``."""

from __future__ import annotations

from typing import Annotated

import typer


def command(json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False) -> None:
    """List the methods with their traits and citations."""
    from tubesight.cli.console import stdout, table
    from tubesight.files.tables import to_json
    from tubesight.methods import METHODS

    if json:
        data = {
            name: {"summary": m.summary, "traits": dict(m.traits), "citation": m.citation}
            for name, m in METHODS.items()
        }
        typer.echo(to_json({"methods": data}))
        return
    traits = list(dict.fromkeys(trait for method in METHODS.values() for trait in method.traits))
    shown = table("", ("method", "summary", *traits), left=("method", "summary", *traits))
    for name, method in METHODS.items():
        shown.add_row(name, method.summary, *(method.traits.get(trait, "-") for trait in traits))
    stdout().print(shown)
    for name, method in METHODS.items():
        stdout().print(f"{name}: {method.citation}", soft_wrap=True)
