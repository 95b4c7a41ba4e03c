"""``tubesight record``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from tubesight.cli.live_options import (
    EveryOption,
    GrayOption,
    PicturesOption,
    RigOption,
    SecondsOption,
    SizeOption,
    SourceOption,
    ToleranceOption,
    TubeOption,
    pictures_of,
    size_of,
    sources_of,
)


def command(
    source: SourceOption,
    out: Annotated[Path, typer.Option("-o", "--out", help="The recording to write, `.mcap`; must be new.")],
    rig: RigOption = None,
    tube: TubeOption = None,
    size: SizeOption = None,
    gray: GrayOption = False,
    tolerance: ToleranceOption = 10.0,
    pictures: PicturesOption = "lossless",
    every: EveryOption = 1,
    seconds: SecondsOption = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone, at the end.")] = False,
) -> None:
    """Record pairs of pictures without measuring them; `tubesight replay` measures them later.

    tubesight record --source left=0 --source right=2 --rig rig.yaml -o session.mcap
    """
    from tubesight.apps.live.options import LiveOptions, RecordOptions, set_up
    from tubesight.apps.live.session import run_session
    from tubesight.cli.console import remark
    from tubesight.cli.live import report, screen

    options = LiveOptions(
        sources=sources_of(source),
        rig_path=rig,
        tube_path=tube,
        size_px=size_of(size),
        gray=gray,
        tolerance_s=tolerance / 1e3,
        seconds=seconds,
        record=RecordOptions(out, pictures_of(pictures), every),
    )
    setup = set_up(options)
    remark(setup.messages)
    with screen(False, json) as tell:
        figures = run_session(options, setup, tell, measuring=False)
    report(figures, json, [])
    raise typer.Exit(0 if figures.recorded.get("results") and not figures.recorded.get("stopped") else 1)
