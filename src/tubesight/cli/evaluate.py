"""``tubesight evaluate``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubesight.apps.evaluate import Evaluation

# Quantity and heading.
_COLUMNS = {
    "tip_x_mm": "tip x\n[mm]",
    "tip_y_mm": "y\n[mm]",
    "tip_z_mm": "z\n[mm]",
    "tip_mm": "tip\n[mm]",
    "bending_deg": "bending\n[deg]",
    "orientation_deg": "orient.\n[deg]",
    "length_mm": "length\n[mm]",
    "curve_mm": "curve\n[mm]",
}


def command(
    out: Annotated[Path, typer.Argument(help="Folder that `tubesight run` wrote.")],
    truth: Annotated[Path, typer.Option("--truth", help="The true shapes: `truth.json`.")],
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Compare results with the truth: errors by frame, their mean and largest.

    Rows without `ok` are counted, not averaged.

        tubesight evaluate results --truth truth.json
    """
    from tubesight.apps.evaluate import evaluate
    from tubesight.files.tables import to_json

    evaluation = evaluate(out, truth)
    if json:
        typer.echo(to_json(evaluation.as_dict()))
    else:
        _print(evaluation)


def _print(evaluation: Evaluation) -> None:
    from tubesight.cli.console import fixed, stdout, table

    console = stdout()
    shown = table(("frame", *_COLUMNS.values()), texts=1)
    for name, error in evaluation.frames.items():
        if error.status == "ok":
            shown.add_row(name, *(fixed(getattr(error, key), 3) for key in _COLUMNS))
    shown.add_section()
    for label, summary in (("mean", evaluation.mean), ("largest", evaluation.max)):
        shown.add_row(label, *(fixed(summary(key), 3) for key in _COLUMNS))
    console.print(shown)
    console.print("errors are measured minus true; mean and largest are of their sizes")
    console.print(f"{len(evaluation.frames)} frames, {evaluation.failures} of them without a shape")
    for name, error in evaluation.frames.items():
        if error.status != "ok":
            console.print(f"{name}: {error.status}", soft_wrap=True)
    for what, names in (("a row", evaluation.without_row), ("a truth", evaluation.without_truth)):
        if names:
            console.print(f"frames without {what}: {', '.join(names)}", soft_wrap=True)
