"""``tubesight capture``."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from tubesight.cli.live_options import SizeOption, SourceOption, ViewOption, size_of, sources_of

if TYPE_CHECKING:
    from tubesight.apps.capture import Captured, State

# Without a terminal a line is printed for each pair kept, and one this often for what is seen.
_EVERY_S = 5.0


def command(
    board: Annotated[Path, typer.Option("--board", help="The board: `board.yaml`.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="Folder for the pairs; goes on where pairs are there.")],
    source: SourceOption,
    pairs: Annotated[int, typer.Option("--pairs", min=4, max=200, help="How many pairs to keep at least.")] = 15,
    seconds: Annotated[float, typer.Option("--seconds", min=1, help="Longest time to go on.")] = 900.0,
    size: SizeOption = None,
    view: ViewOption = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON alone.")] = False,
) -> None:
    """Take pairs of pictures of a board to calibrate with, and say where to hold it.

    Keeps a pair when all cameras see the board sharp and still and it shows something new; stops by itself when
    nothing is lacking. Ctrl-C stops it earlier; what is kept stays.

        tubesight capture --source left=0 --source right=2 --board board.yaml -o calibration

        tubesight capture --source left=0 --source right=2 --board board.yaml -o calibration --view 8080
    """
    from tubesight.apps.capture import CaptureOptions, capture
    from tubesight.files.tables import to_json

    options = CaptureOptions(sources_of(source), board, out, pairs, seconds, size_of(size))
    with _screen(json) as tell, _page(view) as show:

        def both(state: State) -> None:
            tell(state)
            show(state)

        captured = capture(options, both)
    if json:
        typer.echo(to_json(captured.as_dict()))
    else:
        _print(captured)
    raise typer.Exit(1 if captured.level == "too few" else 0)


@contextmanager
def _page(port: int | None) -> Iterator[Callable[[State], None]]:
    """Show states in the browser, where a port is given."""
    if port is None:
        yield lambda state: None
        return
    from tubesight.cli.console import remark
    from tubesight.files.packages import require_package

    require_package("viser", "view", "the viewer needs the package viser")
    from tubesight.apps.viewer.boards import BoardPage

    with BoardPage(port) as page:
        remark([f"open {page.address} in a browser on this machine"])
        yield lambda state: page.show(state.images, state.looks, state.collection, state.word, bool(state.kept))


@contextmanager
def _screen(quiet: bool) -> Iterator[Callable[[State], None]]:
    """Show states on stderr: in place on a terminal, else a line now and then."""
    from rich.live import Live
    from rich.text import Text

    from tubesight.cli.console import remark, stderr

    console = stderr()
    if console.is_terminal:
        with Live(console=console, transient=True, refresh_per_second=8) as live:
            yield lambda state: live.update(Text("\n".join([*_lines(state), *_grids(state)])))
        return
    told = [time.monotonic()]

    def tell(state: State) -> None:
        if quiet or not (state.kept or time.monotonic() - told[0] >= _EVERY_S):
            return
        told[0] = time.monotonic()
        remark([" | ".join(_lines(state))])

    yield tell


def _lines(state: State) -> list[str]:
    """Say what each camera sees, what is kept, and what to do."""
    lines = []
    for name, look in state.looks.items():
        seen = "no board"
        if look.corners is not None:
            sharp = f"{'sharp' if look.sharp else 'blurred'} ({look.blur_px:.1f} px)"
            seen = f"board, {sharp}, {'still' if state.still[name] else 'moving'}"
        lines.append(f"{name}: {seen}, {100 * state.collection.covered(name).covered:.0f} % covered")
    todo = state.collection.lacking()
    lines.append(f"{len(state.collection)} of {state.collection.wanted} pairs: {state.word}")
    return [*lines, f"next: {todo[0]}"] if todo else lines


def _grids(state: State) -> list[str]:
    """Cells of the pictures that hold corners, side by side."""
    names = list(state.looks)
    grids = [["".join("■ " if n else "· " for n in row) for row in state.collection.cells(name)] for name in names]
    return ["  ".join(rows) for rows in zip(*grids, strict=True)]


def _print(captured: Captured) -> None:
    from tubesight.cli.console import stdout

    console = stdout()
    for name in captured.collection.looks:
        quality = captured.collection.covered(name)
        turned = captured.collection.turned_deg(name)
        console.print(
            f"{name}: corners cover {quality.coverage_words}; tilts span {turned:.0f} degrees", soft_wrap=True
        )
    console.print(captured.sentence, soft_wrap=True)
    console.print(f"next: {captured.next_step}", soft_wrap=True)
