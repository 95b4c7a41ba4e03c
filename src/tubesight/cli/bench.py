"""``tubesight bench``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from tubesight.apps.bench import Benchmark


def command(
    pairs: Annotated[int, typer.Option("--pairs", min=1, max=100_000, help="Pairs of pictures each method sees.")] = 60,
    method: Annotated[list[str] | None, typer.Option("--method", help="A method; repeat for more.")] = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Time the methods on this machine: cold 1080p pictures, one thread, all methods in turn.

    tubesight bench --pairs 200
    """
    from rich.progress import Progress

    from tubesight.apps.bench import run_benchmark
    from tubesight.cli.console import stderr
    from tubesight.core import InputError
    from tubesight.files.tables import to_json

    with Progress(console=stderr(), transient=True) as bar:
        task = bar.add_task("timing", total=None)
        try:
            measured = run_benchmark(pairs, method or (), lambda k, n: bar.update(task, completed=k, total=n))
        except ValueError as error:
            raise InputError(str(error)) from None
    if json:
        typer.echo(to_json(measured.as_dict()))
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
    console.print(f"memory without the pictures: {measured.memory_mb:.0f} MB")
    width, height = measured.size_px
    console.print(f"CPU time of one thread, {measured.pairs} pairs of {width} x {height}, none of them in the cache")
