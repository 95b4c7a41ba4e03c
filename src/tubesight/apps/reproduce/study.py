"""What a study gets and what it gives: the interface between the studies and the command that runs them."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, TypeVar
from zlib import crc32

from tubesight import __version__
from tubesight.files.nested import plain
from tubesight.files.safe import write_atomic

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

Task = TypeVar("Task")
Result = TypeVar("Result")

# Sharp in print at a column's width of 3.3 inches and on screens of twice the usual density.
_DPI = 200


@dataclass(frozen=True, slots=True)
class Figure:
    """A picture of the report.

    Attributes
    ----------
    path
        PNG; its stem is the figure's name.
    caption
        What it shows, plain text.
    """

    path: Path
    caption: str


@dataclass(frozen=True, slots=True)
class Table:
    """A table of the report; cells are plain text, those of the first column are names."""

    caption: str
    heading: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]


@dataclass(frozen=True, slots=True)
class StudyResult:
    """What a study found.

    Attributes
    ----------
    title
        Heading in the report.
    paragraphs
        Plain text, escaped by the report; every number in it comes from the data.
    figures, tables
        In the order of the report.
    summary
        The study's entry of ``summary.json``: by method, then by quantity; empty for a study that measures nothing.
    data
        Files written below ``OUT/data``.
    """

    title: str
    paragraphs: tuple[str, ...]
    figures: tuple[Figure, ...] = ()
    tables: tuple[Table, ...] = ()
    summary: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    data: tuple[Path, ...] = ()


class Spread(Protocol):
    """Does tasks, on however many processors, and remembers what is done."""

    def __call__(self, batch: str, function: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
        """Return the results in the order of the tasks."""
        ...


@dataclass(frozen=True, slots=True)
class Context:
    """What a study gets.

    Attributes
    ----------
    study
        Its name.
    out
        Folder of the report; a study writes below ``data`` and ``figures`` through the functions here.
    quick
        Whether minutes are wanted rather than fine steps.
    seed
        Of everything random; `seed_of` derives one for each task.
    spread
        Where tasks are done, see `map`.
    """

    study: str
    out: Path
    quick: bool
    seed: int
    spread: Spread

    def map(self, function: Callable[[Task], Result], tasks: Sequence[Task]) -> list[Result]:
        """Do tasks, spread over processes; tasks done before an interruption are not done again.

        Parameters
        ----------
        function
            Of a module's top level: it is sent to other processes. Equal tasks have to give equal results.
        tasks
            Frozen dataclasses of plain data (numbers, text, None, tuples and dataclasses of those), seeds included.

        Returns
        -------
        list
            In the order of the tasks, as JSON gives them back: mappings, lists, numbers, text.
        """
        return self.spread(self.study, function, tasks)

    def seed_of(self, *what: object) -> int:
        """Return a seed of its own for each thing named: equal for equal names, whatever else is drawn."""
        return crc32("/".join(map(str, (self.seed, self.study, *what))).encode())

    def write_data(self, name: str, rows: Sequence[Mapping[str, Any]], configuration: Mapping[str, Any]) -> Path:
        """Write ``data/NAME.csv``: lines ``# key: value`` with what made it, then the rows.

        Parameters
        ----------
        rows
            All with the keys of the first; numbers are written with seven digits, NaN as an empty cell.
        configuration
            What was chosen: rig, tube, steps; plain data.
        """
        text = io.StringIO()
        about = {"tubesight": __version__, "study": self.study, "seed": self.seed, "quick": self.quick}
        for key, value in about.items():
            text.write(f"# {key}: {value}\n")
        text.write(f"# configuration: {json.dumps(plain(configuration))}\n")
        columns = list(rows[0])
        writer = csv.DictWriter(text, columns, lineterminator="\n")
        writer.writeheader()
        for row in rows:
            writer.writerow({key: _cell(value) for key, value in row.items()})
        path = self.out / "data" / f"{name}.csv"
        write_atomic(path, text.getvalue())
        return path

    def write_figure(self, name: str, drawing: Drawing, caption: str) -> Figure:
        """Write ``figures/NAME.png`` and ``figures/NAME.pdf``."""
        for suffix, options in ((".pdf", {"metadata": {"CreationDate": None}}), (".png", {"dpi": _DPI})):
            data = io.BytesIO()
            drawing.savefig(data, format=suffix[1:], **options)
            write_atomic(self.out / "figures" / f"{name}{suffix}", data.getvalue())
        return Figure(self.out / "figures" / f"{name}.png", caption)


def _cell(value: Any) -> str:
    if isinstance(value, float):
        return f"{value:.7g}" if math.isfinite(value) else ""
    return "" if value is None else str(value)
