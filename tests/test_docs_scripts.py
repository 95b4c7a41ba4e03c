"""The scripts beside the pages draw their figures and print their tables."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import pytest

from tubesight.simulate import rig_around

DOCS = Path(__file__).resolve().parents[1] / "docs"


def script(name: str, monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"docs_{name}", DOCS / f"{name}.py")
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)
    spec.loader.exec_module(module)
    return module


def test_figures_are_drawn_and_shown(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("matplotlib")
    figures = script("figures", monkeypatch)
    figures.main(tmp_path)
    pages = "".join(page.read_text(encoding="utf-8") for page in DOCS.glob("*.md"))
    for name in figures.FIGURES:
        drawn = tmp_path / f"{name}.svg"
        # A dozen strokes and more each, beside the background.
        assert len(list(ElementTree.parse(drawn).getroot().iter("{http://www.w3.org/2000/svg}path"))) > 12
        assert (DOCS / "images" / drawn.name).is_file()
        assert f"(images/{name}.svg)" in pages


def test_tables_of_wrong_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = script("errors", monkeypatch)
    rig = rig_around(90.0, size_px=(960, 540))
    pairs = errors.pictures(rig, (60,), (140,))
    free = replace(errors.TUBE, clamped=False)
    changes = {
        name: errors.BASE[name]
        for name in ("shifted across the tube by 0.5 mm", "turned about the tube by 0.5 degrees")
    }
    lines = [line.split("|")[1:-1] for line in errors.table("base", changes, rig, pairs, free)]
    nothing, shifted, turned = ([float(cell) for cell in line[1:5]] for line in lines[2:])
    assert nothing == [0.0] * 4
    # A free tube is expressed in the wrong frame: its tip is off by the shift, its orientation by the turn, its shape
    # by nothing. The numbers have two decimals; another way into the fit moves them by less.
    assert shifted[0] == pytest.approx(0.5, abs=0.015)
    assert turned[2] == pytest.approx(0.5, abs=0.015)
    assert max(shifted[1], shifted[3], turned[1], turned[3]) <= 0.01


def test_the_page_has_every_row(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = script("errors", monkeypatch)
    page = (DOCS / "uncertainty.md").read_text(encoding="utf-8")
    for name in errors.BASE:
        assert page.count(f"| {name} |") == 2, name
    for name in errors.CAMERA:
        assert page.count(f"| {name} |") == 1, name


def test_table_of_families(monkeypatch: pytest.MonkeyPatch) -> None:
    """Times are only printed. The choice is at most 1.2 times as far off as the best family, or 0.01 mm more: noise."""
    families = script("families", monkeypatch)
    monkeypatch.setattr(families, "RUNS", 1)
    rig = rig_around(90.0, size_px=(960, 540))
    classes = {name: families.CLASSES[name][:1] for name in ("arc", "two segments in space")}
    head, rule, *lines = families.table(classes, rig)
    page = (DOCS / "theory.md").read_text(encoding="utf-8")
    assert f"{head}\n{rule}\n" in page
    for (name, _), line, family in zip(classes.items(), lines, ("circle", "arcs2"), strict=True):
        cells = [cell.strip() for cell in line.split("|")[1:-1]]
        assert cells[:2] == [name, family]
        assert float(cells[2]) <= 1.2 * float(cells[3]) + 0.01
        assert f"| {name} | {family} |" in page
