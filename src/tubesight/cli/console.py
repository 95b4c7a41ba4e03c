"""Printing: results to stdout, progress and remarks to stderr, so that ``--json`` leaves stdout to JSON alone."""

from __future__ import annotations

import math
from collections.abc import Iterable

from rich.console import Console
from rich.table import Table

# Text that is piped into a file or a pager is not folded at 80 columns.
_PIPED_WIDTH = 200


def stdout() -> Console:
    """Console of results."""
    console = Console(markup=False, highlight=False)
    return console if console.is_terminal else Console(markup=False, highlight=False, width=_PIPED_WIDTH)


def stderr() -> Console:
    """Console of progress and remarks."""
    console = Console(stderr=True, markup=False, highlight=False)
    return console if console.is_terminal else Console(stderr=True, markup=False, highlight=False, width=_PIPED_WIDTH)


def remark(lines: Iterable[str]) -> None:
    """Print remarks to stderr, one a line, unfolded."""
    for line in lines:
        stderr().print(line, soft_wrap=True)


def table(title: str, columns: Iterable[str], left: Iterable[str] = ()) -> Table:
    """Make an empty table; numbers stand right, the columns in `left` are text."""
    made = Table(title=title, title_justify="left", title_style="bold", header_style="bold")
    for column in columns:
        text = column in tuple(left)
        made.add_column(column, justify="left" if text else "right", no_wrap=not text, overflow="fold")
    return made


def fixed(value: float, digits: int) -> str:
    """Format a number to a fixed number of decimals, a dash where it is not known."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"
