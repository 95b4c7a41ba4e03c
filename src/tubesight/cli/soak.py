"""``tubesight soak``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, NoReturn

import typer

from tubesight.cli.live_options import EveryOption, PicturesOption, SizeOption, pictures_of, size_of

if TYPE_CHECKING:
    from tubesight.apps.live.options import RecordOptions


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
    everything: Annotated[
        bool,
        typer.Option(
            "--everything",
            help="Instead: cameras over HTTP, recording, all outputs with a client each, and a page in a browser, at "
            "once.",
        ),
    ] = False,
    every: EveryOption = 1,
    faults: Annotated[
        int, typer.Option("--faults", min=0, help="Kill so many recording sessions, and fill the disk of as many.")
    ] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Show what has to hold for hours: pairing, false alarms of the watch over the rig, memory, rates and latency.

    tubesight soak --seconds 3600 --hz 200 --size 1920x1080

    tubesight soak --everything --seconds 600 --record soak.mcap --pictures lossless

    tubesight soak --seconds 10 --faults 100
    """
    from tubesight.apps.live.options import RecordOptions
    from tubesight.apps.live.soak import soak
    from tubesight.cli.console import stdout
    from tubesight.cli.live import recorded, refusals
    from tubesight.files.tables import to_json

    sources = dict.fromkeys(("left", "right"), f"sim:{hz:g}")
    recording = RecordOptions(record, pictures_of(pictures), every) if record is not None else None
    if everything:
        _everything(seconds, hz, size_of(size), recording, json)
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


def _everything(
    seconds: float, hz: float, size_px: tuple[int, int] | None, record: RecordOptions | None, json: bool
) -> NoReturn:
    from tubesight.apps.live.everything import everything
    from tubesight.cli.console import remark, stdout
    from tubesight.cli.live import recorded, refusals
    from tubesight.files.tables import to_json
    from tubesight.sources.simulated import SIM_SIZE

    done = everything(seconds, hz, size_px or SIM_SIZE, record, lambda line: remark([line]))
    if json:
        typer.echo(to_json(done.as_dict()))
    else:
        figures = done.figures
        for line in (
            f"live: {figures.line()}",
            f"live: {done.mixed} of {done.pairs} pairs mix two instants up",
            f"live: from decoded pictures to every output {done.decoded_median_ms:.1f} ms, "
            f"99 % within {done.decoded_p99_ms:.1f} ms",
            f"live: {done.memory.words()}; {done.cpu_ms_per_pair:.1f} ms of CPU per pair",
            *(f"{name}: received {_counted(kinds)}" for name, kinds in done.clients.items()),
            f"page: {'no browser found' if done.pages is None else f'{done.pages} open at the end'}",
            *refusals(figures),
            *recorded(figures),
        ):
            stdout().print(line, soft_wrap=True)
    raise typer.Exit(0 if done.good else 1)


def _counted(kinds: Mapping[str, int]) -> str:
    return ", ".join(f"{count} {kind}" for kind, count in kinds.items()) or "nothing"
