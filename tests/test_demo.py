"""The demo: no camera, no file, and at the end measured shapes beside true ones."""

import re
from pathlib import Path

import pytest

from tubesight.apps.demo import Demo, run_demo
from tubesight.apps.demo_report import HEADINGS, cells
from tubesight.cli.main import main
from tubesight.core import InputError, Status


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demo")


@pytest.fixture(scope="module")
def demo(folder: Path) -> Demo:
    return run_demo(folder, quick=True)


def test_shapes_are_measured_and_near_the_truth(demo: Demo) -> None:
    frames = {comparison.row.frame: comparison for comparison in demo.comparisons}
    assert set(frames) == {"arc_50", "straight", "s_shape"}
    for name in ("arc_50", "straight"):
        row, true = frames[name].row, frames[name].true
        assert row.status == Status.OK
        # Half a pixel of these small pictures (0.56 mm at the tube); a mixed-up frame or camera is centimetres off.
        assert frames[name].tip_error_mm < 0.28
        # That over half the tube's length, in degrees.
        assert row.bending_deg == pytest.approx(true.bending_deg, abs=0.3)
        assert row.length_mm == pytest.approx(true.length_mm, abs=0.28)
    # A method that knows circles and ellipses alone says so instead of measuring an S.
    assert frames["s_shape"].row.status in (Status.OK, Status.NOT_QUADRATIC)
    assert demo.summary.startswith(("3 of 3", "2 of 3"))


def test_everything_it_names_is_there(demo: Demo) -> None:
    for what, path in demo.places.items():
        assert path.exists(), what
    assert {path.stem for path in demo.places["overlays"].iterdir()} == {c.row.frame for c in demo.comparisons}
    assert len(demo.verdicts) == 2
    assert set(demo.seconds) == {"photographs", "calibration", "shapes"}


def test_report_needs_no_other_file(demo: Demo) -> None:
    page = demo.places["report"].read_text(encoding="utf-8")
    sources = re.findall(r'(?:src|href)="([^"]*)"', page)
    # Three overlays, and the plot where matplotlib is installed.
    assert len(sources) in (3, 4)
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert "http" not in page.replace(sources[0], "")
    for comparison in demo.comparisons:
        for cell in cells(comparison):
            assert f"<td>{cell}</td>" in page
        assert len(cells(comparison)) == len(HEADINGS)


def test_command_prints_the_table_and_may_be_repeated(demo: Demo, folder: Path, capsys) -> None:
    """Over the folder of an earlier demo, with pictures of other frames in it."""
    stale = demo.places["photographs"] / "left" / "stale.jpg"
    stale.write_bytes(b"")
    with pytest.raises(SystemExit) as left:
        main(["demo", "--quick", "-o", str(folder)])
    assert left.value.code == 0
    printed = capsys.readouterr().out
    for comparison in demo.comparisons:
        assert re.search(rf"{comparison.row.frame} +{comparison.row.status}", printed)
    assert str(demo.places["report"]) in printed
    assert not stale.exists()


def test_foreign_folders_are_not_touched(tmp_path: Path) -> None:
    treasure = tmp_path / "data" / "treasure.txt"
    treasure.parent.mkdir()
    treasure.write_text("mine")
    with pytest.raises(InputError, match="not from a demo"):
        run_demo(tmp_path, quick=True)
    assert treasure.read_text() == "mine"
