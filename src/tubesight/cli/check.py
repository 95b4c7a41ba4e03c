"""``tubesight check``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubesight.apps.check import Checked


def command(
    folder: Annotated[Path, typer.Argument(help="New pictures of a board (or tube): one subfolder per camera.")],
    rig: Annotated[Path, typer.Option("--rig", help="The cameras: `rig.yaml`.")],
    board: Annotated[
        Path | None, typer.Option("--board", help="The board: `board.yaml`; that of the calibration by default.")
    ] = None,
    tube: Annotated[
        Path | None, typer.Option("--tube", help="The pictures show the tube instead: `tube.yaml`.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Tell whether a rig is still as it was calibrated: exit code 0, or 1 where something moved.

    Compares new pictures with the calibration's own error, and says what probably changed.

        tubesight check today --rig rig.yaml
    """
    if board is not None and tube is not None:
        raise typer.BadParameter("the pictures show a board or the tube, not both", param_hint="--tube")
    from tubesight.apps.check import check_board, check_tube
    from tubesight.cli.calibrate import bar

    with bar() as progress:
        if tube is not None:
            checked = check_tube(folder, rig, tube, progress)
        else:
            checked = check_board(folder, rig, board, progress)
    _print(checked, json)
    raise typer.Exit(0 if checked.right else 1)


def _print(checked: Checked, json: bool) -> None:
    from tubesight.cli.console import remark, stdout, table
    from tubesight.files.tables import to_json

    if json:
        verdict = {"sentence": checked.sentence, "reason": checked.reason, "next_step": checked.next_step}
        typer.echo(to_json(checked.figures | {"remarks": checked.remarks, "verdict": verdict}))
        return
    console = stdout()
    shown = table([heading.replace(" [", "\n[") for heading in checked.rows[0]], texts=1)
    for row in checked.rows[1:]:
        shown.add_row(*row)
    console.print(shown)
    remark(f"note: {line}" for line in checked.remarks)
    console.print(checked.sentence, soft_wrap=True)
    if checked.reason:
        console.print(checked.reason, soft_wrap=True)
    console.print(f"next: {checked.next_step}", soft_wrap=True)
