"""``tubesight soak``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tubesight.cli.live_options import EveryOption, PicturesOption, SizeOption, pictures_of, size_of


def command(
    seconds: Annotated[float, typer.Option("--seconds", min=1, help="Length of the live session.")] = 60.0,
    hz: Annotated[
        float, typer.Option("--hz", min=1, max=1000, help="Pictures a second of the simulated cameras.")
    ] = 30.0,
    size: SizeOption = None,
    instants: Annotated[int, typer.Option("--instants", min=1, help="Instants paired in simulated time.")] = 100_000,
    hours: Annotated[float, typer.Option("--hours", min=0, help="Simulated hours of a rig at rest.")] = 24.0,
    record: Annotated[Path | None, typer.Option("--record", help="Record the live session into this file.")] = None,
    pictures: PicturesOption = "none",
    every: EveryOption = 1,
    faults: Annotated[
        int, typer.Option("--faults", min=0, help="Kill so many recording sessions, and fill the disk of as many.")
    ] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Show what has to hold for hours: pairing, false alarms of the watch over the rig, memory, rates and latency.

    tubesight soak --seconds 3600 --hz 200 --size 1920x1080

    tubesight soak --seconds 10 --faults 100
    """
    from tubesight.apps.live.options import RecordOptions
    from tubesight.apps.live.soak import soak
    from tubesight.cli.console import stdout
    from tubesight.cli.live import recorded, refusals
    from tubesight.files.tables import to_json

    sources = dict.fromkeys(("left", "right"), f"sim:{hz:g}")
    recording = RecordOptions(record, pictures_of(pictures), every) if record is not None else None
    done = soak(sources, seconds, instants, hours, size_of(size), recording, faults=faults)
    if json:
        typer.echo(to_json(done.as_dict()))
    else:
        trial, figures = done.pairing, done.figures
        for line in (
            f"pairing: {trial.mixed} of {trial.pairs} pairs mix two instants up; of {trial.pictures} pictures with "
            f"drops, jitter and delays {trial.refused} were refused",
            f"watch over the rig: {done.false_alarms} false alarms in {done.hours:g} simulated hours",
            f"live: {figures.line()}",
            f"live: {done.memory.words()}; {done.cpu_ms_per_pair:.1f} ms of CPU per pair",
            *(line for trial in done.faults for line in (trial.line(), *trial.problems)),
            *refusals(figures),
            *recorded(figures),
        ):
            stdout().print(line, soft_wrap=True)
    good = done.pairing.mixed == 0 and done.figures.ok and all(trial.good for trial in done.faults)
    raise typer.Exit(0 if good else 1)
