"""``tubesight``: the command line."""

from __future__ import annotations

import sys
from typing import Annotated

import typer

from tubesight import __version__
from tubesight.cli import (
    bench,
    board,
    calibrate,
    capture,
    check,
    compare,
    demo,
    devices,
    doctor,
    evaluate,
    export,
    import_,
    init,
    live,
    methods,
    plan,
    record,
    recover,
    register,
    replay,
    reproduce,
    rig_export,
    run,
    simulate,
    soak,
    view,
    warmup,
)
from tubesight.cli.places import PlacesCommand
from tubesight.core.errors import InputError

app = typer.Typer(
    name="tubesight",
    help="3-D shape of catheters, continuum robots and other slender tubes from two or more calibrated cameras.",
    epilog="Start with `tubesight demo`. Research use only, not a medical device.",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"tubesight {__version__}")
        raise typer.Exit


@app.callback()
def _common(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and leave.")
    ] = False,
) -> None:
    pass


# By the order in which one meets them.
app.command("demo")(demo.command)
app.command("init")(init.command)
app.command("board")(board.command)
app.command("capture")(capture.command)
app.command("calibrate")(calibrate.command)
app.command("register", cls=PlacesCommand)(register.command)
app.command("import")(import_.command)
app.command("rig-export")(rig_export.command)
app.command("check")(check.command)
app.command("run", cls=PlacesCommand)(run.command)
app.command("view")(view.command)
app.command("live", cls=PlacesCommand)(live.command)
app.command("record")(record.command)
app.command("replay")(replay.command)
app.command("recover")(recover.command)
app.command("export")(export.command)
app.command("evaluate")(evaluate.command)
app.command("methods")(methods.command)
app.command("plan")(plan.command)
app.command("simulate")(simulate.command)
app.command("compare")(compare.command)
app.command("bench")(bench.command)
app.command("reproduce")(reproduce.command)
app.command("soak")(soak.command)
app.command("devices")(devices.command)
app.command("warmup")(warmup.command)
app.command("doctor")(doctor.command)


def main(args: list[str] | None = None) -> None:
    """Run the command line: exit code 0, 1 for bad input, 2 for wrong usage, 130 when interrupted."""
    try:
        app(args, prog_name="tubesight")
    except InputError as error:
        print(f"error: {error}", file=sys.stderr)
        raise SystemExit(1) from None


if __name__ == "__main__":
    main()
