"""``tubesight plan``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubesight.apps.planning.plan import Plan


def command(
    plan: Annotated[
        Path | None, typer.Argument(help="Cameras, tube, workspace and rules: `plan.yaml`; defaults without it.")
    ] = None,
    rig: Annotated[
        Path | None, typer.Option("--rig", help="Predict for this rig instead of placing cameras: `rig.yaml`.")
    ] = None,
    cameras: Annotated[
        int | None, typer.Option("--cameras", min=2, max=6, help="Cameras to place; the file's by default.")
    ] = None,
    apart: Annotated[
        float | None,
        typer.Option(
            "--apart", min=0, max=90, help="Least angle between lines of sight, degrees; the file's by default."
        ),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("-o", "--out", help="Folder for the picture, the table and the rig.")
    ] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
    example: Annotated[bool, typer.Option("--example", help="Print a `plan.yaml` to fill in, and leave.")] = False,
) -> None:
    """Predict what a rig will measure over a workspace, and find the best places of its cameras.

    tubesight plan plan.yaml -o planned
    """
    from tubesight.apps.planning.config import EXAMPLE

    if example:
        typer.echo(EXAMPLE, nl=False)
        return
    if rig is not None and (cameras is not None or apart is not None):
        raise typer.BadParameter(
            "--cameras and --apart place cameras, those of a rig stand already", param_hint="--rig"
        )
    from tubesight.apps.planning.plan import make_plan, write_plan
    from tubesight.cli.calibrate import bar
    from tubesight.cli.console import stderr
    from tubesight.files.tables import to_json

    with bar() as progress:
        made = make_plan(plan, rig, count=cameras, apart_deg=apart, progress=progress)
    written = [] if out is None else write_plan(out, made)
    if json:
        typer.echo(to_json(made.as_dict()))
    else:
        _print(made)
    for path in written:
        stderr().print(f"wrote {path}", soft_wrap=True)


def _print(plan: Plan) -> None:
    from tubesight.apps.planning.workspace import QUANTITIES
    from tubesight.cli.console import fixed, remark, stdout, table

    console = stdout()
    shown = table(("camera", "azimuth\n[deg]", "elevation\n[deg]", "distance\n[mm]"), texts=1)
    for name, place in plan.places().items():
        shown.add_row(name, fixed(place.azimuth_deg, 1), fixed(place.elevation_deg, 1), fixed(place.distance_mm, 0))
    console.print(shown)
    told = plan.as_dict()["workspace"]
    shown = table(("predicted standard deviation", "mean", "95 %", "largest"), texts=1)
    for name, unit in QUANTITIES.items():
        values = told[f"{name}_sd_{unit}"]
        shown.add_row(f"{name} [{unit}]", *(fixed(values[key], 3) for key in ("mean", "p95", "max")))
    console.print(shown)
    console.print(f"{100 * told['seen']:.0f} % of {told['poses']} poses are seen whole by all cameras")
    if len(plan.placements) > 1:
        shown = table(("other placements: azimuth, elevation, distance", "tip rms\n[mm]", "seen\n[%]"), texts=1)
        for placement in plan.placements[1:]:
            where = "; ".join(
                f"{p.azimuth_deg:.0f}, {p.elevation_deg:.0f}, {p.distance_mm:.0f}" for p in placement.places
            )
            shown.add_row(where, fixed(placement.tip_sd_mm, 3), fixed(100 * placement.seen, 0))
        console.print(shown)
    remark(f"note: {line}" for line in plan.remarks)
    console.print("Predictions for circular bends, not measurements. Research use only, not a medical device.")
