"""Section 4 of the paper: what a pair of pictures of 1080p costs, measured by the benchmark."""

from __future__ import annotations

from typing import TYPE_CHECKING

from tubesight.apps.bench import PAPER_US, Benchmark, run_benchmark
from tubesight.apps.reproduce import drawing
from tubesight.apps.reproduce.shots import METHODS
from tubesight.apps.reproduce.study import Context, StudyResult, Table
from tubesight.outputs.machine import machine

if TYPE_CHECKING:
    from matplotlib.figure import Figure as Drawing

# Section 4 of the paper, Core i7 of 3 GHz, milliseconds: image processing and reconstruction.
_PAPER_MS = (2.75, 2.25)
_PAIRS, _QUICK_PAIRS = 200, 30


def run(context: Context) -> StudyResult:
    """Time the methods, alone on the machine's processor as far as this command can see to it."""
    measured = run_benchmark(_QUICK_PAIRS if context.quick else _PAIRS, METHODS)
    rows = [
        {"method": name, "stage": stage, "median_us": us}
        for name, timing in measured.methods.items()
        for stage, us in (*timing.stages_us.items(), ("all", timing.median_us), ("all, 99th percentile", timing.p99_us))
    ]
    data = context.write_data("timing", rows, {"pairs": measured.pairs, "size_px": measured.size_px, **machine()})
    summary = {
        name: {
            "median_us": timing.median_us,
            "p99_us": timing.p99_us,
            "failures": timing.failures,
            "n": measured.pairs,
        }
        for name, timing in measured.methods.items()
    }
    each = ", ".join(f"{name} {timing.median_us / 1e3:.2f} ms" for name, timing in measured.methods.items())
    text = (
        f"The paper needs {sum(_PAPER_MS):.0f} ms a pair of 1920 x 1080 on a Core i7 of 3 GHz. On this machine the "
        f"medians are {each}: CPU time of one thread, each pair fresh from memory. These figures depend on the machine "
        "and on what else it does; all other data of this report do not."
    )
    return StudyResult(
        "Section 4: time a pair",
        (text,),
        (context.write_figure("timing", _bars(measured), "Median CPU time a pair by stage, beside the paper's."),),
        (_table(measured),),
        summary,
        (data,),
    )


def _table(measured: Benchmark) -> Table:
    heading = ("", "median [ms]", "99th percentile [ms]", "pairs a second", "faster than the paper")
    rows = [
        (
            name,
            f"{timing.median_us / 1e3:.2f}",
            f"{timing.p99_us / 1e3:.2f}",
            f"{1e6 / timing.median_us:.0f}",
            f"{PAPER_US / timing.median_us:.1f} times",
        )
        for name, timing in measured.methods.items()
    ]
    rows.append(("the paper", f"{PAPER_US / 1e3:.2f}", "-", f"{1e6 / PAPER_US:.0f}", "-"))
    return Table(f"CPU time a pair over {measured.pairs} pairs.", heading, tuple(rows))


def _bars(measured: Benchmark) -> Drawing:
    """Stacked bars: image processing and reconstruction."""
    made, axes = drawing.panels(1, 1, (7.0, 2.4))
    panel = axes[0][0]
    parts = {"the paper": _PAPER_MS} | {
        name: (
            sum(us for stage, us in timing.stages_us.items() if stage.startswith("see")) / 1e3,
            timing.stages_us["solve"] / 1e3,
        )
        for name, timing in measured.methods.items()
    }
    names = list(parts)
    seeing, solving = ([parts[name][i] for name in names] for i in (0, 1))
    panel.barh(names, seeing, color=drawing.COLOURS["cone_ray"], label="image processing, both pictures")
    panel.barh(names, solving, left=seeing, color=drawing.COLOURS["reference"], hatch="//", label="reconstruction")
    panel.invert_yaxis()
    panel.grid(axis="y", visible=False)
    panel.set_xlabel("time a pair [ms]")
    drawing.legend_below(made, panel, columns=2)
    return made
