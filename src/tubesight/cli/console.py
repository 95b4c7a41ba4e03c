"""Printing: results to stdout, progress and remarks to stderr, so that ``--json`` leaves stdout to JSON alone."""

from __future__ import annotations

import math
from collections.abc import Iterable

from rich.box import SIMPLE_HEAD
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


def table(headings: Iterable[str], texts: int) -> Table:
    """Make an empty table that fits 80 columns: the first `texts` columns are text, the others numbers on the right."""
    made = Table(box=SIMPLE_HEAD, collapse_padding=True, pad_edge=False, header_style="bold")
    for index, heading in enumerate(headings):
        made.add_column(heading, justify="left" if index < texts else "right", no_wrap=True)
    return made


def fixed(value: float, digits: int) -> str:
    """Format a number to a fixed number of decimals, a dash where it is not known."""
    return f"{value:.{digits}f}" if math.isfinite(value) else "-"
