"""A comparison as files."""

from __future__ import annotations

from pathlib import Path

from tubesight.apps.compare.comparison import Comparison
from tubesight.apps.compare.figures import drawings
from tubesight.apps.compare.page import page
from tubesight.files.safe import write_atomic
from tubesight.files.tables import write_json
from tubesight.outputs.plot3d import plots_installed


def write(made: Comparison, out: Path) -> list[Path]:
    """Write ``report.html``, ``summary.json``, ``data/rows.csv`` and, where matplotlib is there, ``figures/*.png``.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    pictures = drawings(made) if plots_installed() else {}
    files = {out / "figures" / name: data for name, data in pictures.items()}
    report, summary, rows = out / "report.html", out / "summary.json", out / "data" / "rows.csv"
    for path, data in files.items():
        write_atomic(path, data)
    write_atomic(rows, made.table())
    write_json(summary, made.as_dict())
    write_atomic(report, page(made, pictures))
    return [report, summary, rows, *files]
