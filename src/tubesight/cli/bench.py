"""``tubesight bench``."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubesight.apps.bench import Benchmark


def command(
    pairs: Annotated[int, typer.Option("--pairs", min=1, max=100_000, help="Pairs of pictures each method sees.")] = 60,
    method: Annotated[list[str] | None, typer.Option("--method", help="A method; repeat for more.")] = None,
    soak: Annotated[
        int, typer.Option("--soak", min=0, max=10_000_000, help="Instead: measure so many pairs, watch the memory.")
    ] = 0,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Time the methods on this machine: cold 1080p pictures, one thread, all methods in turn.

    tubesight bench --pairs 200
    """
    from rich.progress import Progress

    from tubesight.apps.bench import run_benchmark, run_soak
    from tubesight.cli.console import stderr
    from tubesight.core import InputError
    from tubesight.files.tables import to_json
    from tubesight.sensor import DEFAULT_METHOD

    with Progress(console=stderr(), transient=True) as bar:
        task = bar.add_task("timing", total=None)

        def advance(done: int, total: int) -> None:
            bar.update(task, completed=done, total=total)

        try:
            if soak:
                grown = run_soak(soak, (method or [DEFAULT_METHOD])[0], advance)
            else:
                measured = run_benchmark(pairs, method or (), advance)
        except ValueError as error:
            raise InputError(str(error)) from None
    if json:
        typer.echo(to_json(asdict(grown) if soak else measured.as_dict()))
    elif soak:
        memory = f"{grown.first_mb:.1f} MB at first, {grown.last_mb:.1f} MB at last"
        typer.echo(f"{grown.pairs} pairs: {memory}, {grown.bytes_per_pair:.1f} bytes a pair")
    else:
        _print(measured)


def _print(measured: Benchmark) -> None:
    from tubesight.apps.bench import REFERENCES
    from tubesight.cli.console import fixed, stdout, table

    console = stdout()
    known = [name for name in REFERENCES if name in measured.methods]
    headings = (
        "method",
        "median\n[us]",
        "p99\n[us]",
        "failures",
        *(f"faster than\n{name}" for name in [*known, "paper"]),
    )
    shown = table(headings, texts=1)
    for name, timing in measured.methods.items():
        ratios = measured.ratios(name)
        shown.add_row(
            name,
            fixed(timing.median_us, 0),
            fixed(timing.p99_us, 0),
            str(timing.failures),
            *(fixed(ratios[other], 1) for other in [*known, "paper"]),
        )
    console.print(shown)
    for name, timing in measured.methods.items():
        parts = ", ".join(f"{stage} {us:.0f}" for stage, us in timing.stages_us.items())
        console.print(f"{name}: {parts} us", soft_wrap=True)
    decoding = ", ".join(f"{name} {us / 1e3:.1f} ms" for name, us in measured.decoding_us.items())
    console.print(f"decoding a picture: {decoding}", soft_wrap=True)
    planes = ", ".join(f"{name} {fixed(us, 0)} us" for name, us in measured.yuyv_us.items())
    console.print(f"Y planes of YUYV as they lie: {planes}", soft_wrap=True)
    console.print(f"memory of a process that only measures, without the pictures: {fixed(measured.memory_mb, 0)} MB")
    width, height = measured.size_px
    console.print(f"CPU time of one thread, {measured.pairs} pairs of {width} x {height}, none of them in the cache")
