"""``tubesight live``."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tubesight.cli.live_options import (
    BackgroundOption,
    BaseOption,
    EveryOption,
    GrayOption,
    IgtlOption,
    OffsetOption,
    PicturesOption,
    RigOption,
    SecondsOption,
    SizeOption,
    SourceOption,
    TipOption,
    ToleranceOption,
    TubeOption,
    UdpOption,
    ViewOption,
    WebsocketOption,
    offsets_of,
    pictures_of,
    size_of,
    sources_of,
)
from tubesight.cli.places import places_of

if TYPE_CHECKING:
    from tubesight.apps.live.loop import Moment
    from tubesight.apps.live.options import LiveOptions
    from tubesight.apps.live.publishing import PublishOptions
    from tubesight.apps.live.stats import Figures
    from tubesight.tracking.tracker import Tracked

# On a terminal the view is drawn so often, without one a line is printed so often, and at every change of state.
_VIEW_S, _LINE_S = 0.1, 5.0


def command(
    source: SourceOption,
    rig: RigOption = None,
    tube: TubeOption = None,
    method: Annotated[str | None, typer.Option("--method", help="One of `tubesight methods`.")] = None,
    background: BackgroundOption = None,
    base: BaseOption = None,
    tip: TipOption = None,
    size: SizeOption = None,
    gray: GrayOption = False,
    tolerance: ToleranceOption = 10.0,
    offset: OffsetOption = None,
    deadline: Annotated[float, typer.Option("--deadline", min=0, help="Flag results later than this, ms.")] = 50.0,
    seconds: SecondsOption = None,
    filtered: Annotated[bool, typer.Option("--filter", help="Filter the shape too, beside the measured one.")] = False,
    record: Annotated[Path | None, typer.Option("--record", help="Record into this file, `.mcap`.")] = None,
    pictures: PicturesOption = "lossless",
    every: EveryOption = 1,
    igtl: IgtlOption = None,
    websocket: WebsocketOption = None,
    udp: UdpOption = None,
    view: ViewOption = None,
    stats: Annotated[bool, typer.Option("--stats", help="Print a line of figures every second.")] = False,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone, at the end.")] = False,
) -> None:
    """Measure while the cameras run.

    Pairs pictures by their times, measures the newest, and says what it is doing. Ctrl-C ends it.

        tubesight live --source left=sim: --source right=sim:

        tubesight live --source left=0 --source right=2 --rig rig.yaml --tube tube.yaml

        tubesight live --source left=sim: --source right=sim: --view 8080 --igtl 18944 --websocket 8765
    """
    from tubesight.apps.live.options import LiveOptions, RecordOptions
    from tubesight.cli.run import refuse_unknown
    from tubesight.sensor import DEFAULT_METHOD

    if method is not None:
        refuse_unknown(method)
    options = LiveOptions(
        sources=sources_of(source),
        rig_path=rig,
        tube_path=tube,
        method=method or DEFAULT_METHOD,
        base_px=places_of(base or []),
        tip_px=places_of(tip or [], "--tip"),
        background_path=background,
        size_px=size_of(size),
        gray=gray,
        tolerance_s=tolerance / 1e3,
        offset_s=offsets_of(offset or []),
        deadline_s=deadline / 1e3,
        seconds=seconds,
        filtered=filtered,
        record=RecordOptions(record, pictures_of(pictures), every) if record is not None else None,
    )
    _run(options, _publishing(igtl, websocket, udp, view), stats, json)


def _publishing(igtl: str | None, websocket: str | None, udp: str | None, view: int | None) -> PublishOptions:
    from tubesight.apps.live.publishing import Place, PublishOptions

    return PublishOptions(
        igtl=Place.of(igtl) if igtl is not None else None,
        websocket=Place.of(websocket) if websocket is not None else None,
        udp=Place.of(udp) if udp is not None else None,
        view_port=view,
    )


def _run(options: LiveOptions, publishing: PublishOptions, stats: bool, json: bool) -> None:
    from tubesight.apps.live.options import set_up
    from tubesight.apps.live.publishing import open_subscribers
    from tubesight.apps.live.session import run_session
    from tubesight.apps.live.steering import steering_of
    from tubesight.cli.console import remark

    setup = set_up(options)
    steering = steering_of(options, setup)
    subscribers, addresses = open_subscribers(publishing, steering)
    remark([*setup.messages, *addresses])
    with screen(stats, json) as tell:
        figures = run_session(options, setup, tell, subscribers, steering=steering)
    report(figures, json, [figures.line()])
    raise typer.Exit(0 if figures.ok else 1)


def report(figures: Figures, json: bool, first: list[str]) -> None:
    """Print the figures of a session that ended: JSON, or some lines after the first."""
    from tubesight.cli.console import stdout
    from tubesight.files.tables import to_json

    if json:
        typer.echo(to_json(figures.as_dict()))
        return
    for line in [*first, *refusals(figures), *recorded(figures), *figures.rig]:
        stdout().print(line, soft_wrap=True)


@contextmanager
def screen(stats: bool, quiet: bool) -> Iterator[Callable[[Moment], None]]:
    """Show moments on stderr: in place on a terminal, else a line now and then and at every change of state."""
    from rich.live import Live
    from rich.text import Text

    from tubesight.cli.console import remark, stderr

    told_s, told_state = 0.0, ""
    console = stderr()
    every = 1.0 if stats else _LINE_S

    def line(moment: Moment) -> None:
        nonlocal told_s, told_state
        tracked, now = moment.tracked, time.monotonic()
        state = str(tracked.state) + (", the rig changed" if tracked.moved else "")
        if quiet or (state == told_state and now - told_s < every):
            return
        if state != told_state:
            remark([" | ".join(filter(None, [state, *tracked.notes, tracked.moved]))])
        else:
            remark([f"{state} | {moment.figures().line()}"])
        told_s, told_state = now, state

    if stats or quiet or not console.is_terminal:
        yield line
        return
    with Live(console=console, transient=True, auto_refresh=False) as live:

        def view(moment: Moment) -> None:
            nonlocal told_s
            now = time.monotonic()
            if now - told_s >= _VIEW_S:
                told_s = now
                live.update(Text("\n".join(view_lines(moment.tracked, moment.figures()))), refresh=True)

        yield view


def view_lines(tracked: Tracked, figures: Figures) -> list[str]:
    """Lines of the view on a terminal."""
    import math

    lines = [f"{tracked.state}: {tracked.state.meaning}"]
    shape = tracked.result.shape if tracked.result is not None else None
    if tracked.result is not None:
        lines.append(f"status {tracked.result.status}{'  LATE' if tracked.late else ''}")
    if shape is not None:
        tip = ", ".join(f"{value:8.2f}" for value in shape.tip_mm)
        sd = max(shape.sd[name] for name in ("tip_x", "tip_y", "tip_z"))
        lines.append(f"tip [mm]         {tip}   +- {sd:.2f}")
        lines.append(f"bending [deg]    {math.degrees(shape.bending_rad):8.2f}")
        lines.append(f"orientation [deg]{math.degrees(shape.orientation_rad):8.2f}")
        lines.append(f"length [mm]      {shape.length_mm:8.2f}")
    lines.append(
        f"{figures.rate_hz:.1f} pairs/s   latency {figures.latency_ms:.1f} ms (measuring {figures.compute_ms:.1f})   "
        f"skew {figures.skew_ms:.2f} ms   late {figures.late}"
    )
    lines += refusals(figures)
    return [
        *lines,
        *recorded(figures),
        *tracked.notes,
        *filter(None, [tracked.moved]),
        "Ctrl-C ends it. Research use only, not a medical device.",
    ]


def recorded(figures: Figures) -> list[str]:
    """Say what was recorded; nothing where nothing is."""
    said = ", ".join(f"{key.replace('_', ' ')} {value}" for key, value in figures.recorded.items())
    return [f"recording: {said}"] if said else []


def refusals(figures: Figures) -> list[str]:
    """Say per camera what arrived and what was in no pair, and why."""
    lines = []
    for name, counts in figures.cameras.items():
        out = ", ".join(f"{n} {reason}" for reason, n in counts.items() if reason != "arrived")
        lines.append(f"{name}: {counts['arrived']} pictures" + (f", of these {out}" if out else ""))
    return lines
