"""``tubesight evaluate``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubesight.apps.evaluate import Evaluation

# Quantity, heading, decimals.
_COLUMNS = (
    ("tip_x_mm", "tip x [mm]", 3),
    ("tip_y_mm", "y", 3),
    ("tip_z_mm", "z", 3),
    ("tip_mm", "distance", 3),
    ("bending_deg", "bending [deg]", 3),
    ("orientation_deg", "orientation", 3),
    ("length_mm", "length [mm]", 3),
    ("curve_mm", "centreline [mm]", 3),
)


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

    headings = ("frame", "status", *(heading for _, heading, _ in _COLUMNS))
    shown = table("measured minus true", headings, left=("frame", "status"))
    for name, error in evaluation.frames.items():
        shown.add_row(name, error.status, *(fixed(getattr(error, key), digits) for key, _, digits in _COLUMNS))
    shown.add_section()
    for label, summary in (("mean", evaluation.mean), ("max", evaluation.max)):
        shown.add_row(f"{label} |error|", "", *(fixed(summary(key), digits) for key, _, digits in _COLUMNS))
    console = stdout()
    console.print(shown)
    console.print(f"{len(evaluation.frames)} frames, {evaluation.failures} of them without a shape")
    for what, names in (("a row", evaluation.without_row), ("a truth", evaluation.without_truth)):
        if names:
            console.print(f"frames without {what}: {', '.join(names)}", soft_wrap=True)
