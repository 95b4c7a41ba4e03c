"""``tubesight methods``."""

from __future__ import annotations

from typing import Annotated

import typer


def command(json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False) -> None:
    """List the methods with their traits and citations."""
    from tubesight.cli.console import stdout
    from tubesight.files.tables import to_json
    from tubesight.methods import METHODS

    if json:
        data = {
            name: {"summary": m.summary, "traits": dict(m.traits), "given": list(m.given), "citation": m.citation}
            for name, m in METHODS.items()
        }
        typer.echo(to_json({"methods": data}))
        return
    for name, method in METHODS.items():
        traits = "; ".join(f"{trait}: {value}" for trait, value in method.traits.items())
        given = f"  given beyond two calibrated pictures: {', '.join(method.given) or 'nothing'}"
        for line in (name, f"  {method.summary}", f"  {traits}", given, f"  {method.citation}", ""):
            stdout().print(line, soft_wrap=True)
