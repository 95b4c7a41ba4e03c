"""`tubesight run` over many inputs: equal however spread, gone on with, and never stopped by one of them."""

import csv
import json
import os
import shutil
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from live_scenes import measured_moments, record
from small_set import write_small_set
from tubesight.apps.live.replay import replay_file
from tubesight.apps.many import ManyReport, run_many
from tubesight.apps.many_tasks import names_of
from tubesight.cli.main import main
from tubesight.core import InputError
from tubesight.files.tables import ShapeRow, read_curves, read_shapes
from tubesight.tracking.tracker import Tracker

pytest.importorskip("mcap")
NAMES = ("monday-photos", "tuesday-photos", "session", "empty")


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two data sets of one name, one of a single pair, a recording of two pairs, and a folder without pictures."""
    folder = tmp_path_factory.mktemp("many")
    write_small_set(folder)
    for day in ("monday", "tuesday"):
        shutil.copytree(folder / "photos", folder / day / "photos")
    for picture in (folder / "tuesday").rglob("*.png"):
        if picture.stem != "1":
            picture.unlink()
    record(folder / "session.mcap", measured_moments(2, Tracker(filtered=True)))
    (folder / "empty").mkdir()
    return folder


@pytest.fixture
def data(template: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(template, tmp_path / "data"))


@pytest.fixture(autouse=True)
def no_plots(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plots are drawn as for a single run; without them the tests here take half the time."""
    for module in ("tubesight.outputs.rows", "tubesight.apps.run"):
        monkeypatch.setattr(f"{module}.plots_installed", lambda: False)


def inputs(data: Path) -> list[Path]:
    return [data / "monday" / "photos", data / "tuesday" / "photos", data / "session.mcap", data / "empty"]


def measure(data: Path, out: Path, **options: Any) -> ManyReport:
    return run_many(inputs(data), out, {"rig_path": data / "rig.yaml", "tube_path": data / "tube.yaml"}, **options)


def shapes(folder: Path) -> list[ShapeRow]:
    """Rows without their times, as text: NaN is not equal to itself."""
    return [replace(row, total_ms=0.0) for row in read_shapes(folder / "shapes.csv")]


def leave(*args: Any) -> int:
    with pytest.raises(SystemExit) as left:
        main([str(arg) for arg in args])
    return int(left.value.code or 0)


class Watch:
    """Progress: notes what is done, and interrupts when so many are."""

    def __init__(self, stop_at: int | None = None) -> None:
        self.done: list[int] = []
        self.stop_at = stop_at

    def __call__(self, batch: str, done: int, total: int) -> None:
        self.done.append(done)
        if done == self.stop_at:
            raise KeyboardInterrupt


def test_results_are_the_same_whatever_the_number_of_workers(data: Path, tmp_path: Path) -> None:
    reports = [measure(data, tmp_path / str(workers), workers=workers) for workers in (1, 2)]
    for report in reports:
        assert [row.name for row in report.rows] == list(NAMES)
        assert [(row.pairs, row.ok) for row in report.rows] == [(3, 3), (1, 1), (2, 2), (0, 0)]
        assert [bool(row.problem) for row in report.rows] == [False, False, False, True]
        assert not report.complete
    one, two = ([replace(row, median_ms=0.0) for row in report.rows] for report in reports)
    assert one == two
    for name in NAMES[:3]:
        first, second = (tmp_path / workers / name for workers in "12")
        assert str(shapes(first)) == str(shapes(second))
        for a, b in zip(*(read_curves(out / "curves.npz").xyz_mm for out in (first, second)), strict=True):
            assert np.array_equal(a, b)
    assert not (tmp_path / "1" / "empty").exists()


def test_the_summary_is_what_the_tables_say(data: Path, tmp_path: Path) -> None:
    (data / "monday" / "photos" / "left" / "2.png").write_bytes(b"no picture")
    report = measure(data, tmp_path)
    rows = list(csv.DictReader((tmp_path / "summary.csv").read_text().splitlines()))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["format"] == "tubesight-runs/1"
    assert summary["configuration"]["rig_path"] == str(data / "rig.yaml")
    for row, cells, entry, path in zip(report.rows, rows, summary["inputs"], inputs(data), strict=True):
        assert row.input == cells["input"] == entry["input"] == str(path)
        assert row.name == cells["name"] == entry["name"]
        assert entry["problem"] == cells["problem"] == row.problem
    assert rows[0]["status"] == "ok 2; bad_image 1" and summary["inputs"][0]["status"] == {"ok": 2, "bad_image": 1}
    assert str(data / "monday" / "photos" / "left" / "2.png") in rows[0]["problem"]
    times = [row.total_ms for row in read_shapes(tmp_path / NAMES[0] / "shapes.csv") if row.status == "ok"]
    assert float(rows[0]["median_ms"]) == pytest.approx(np.median(times), rel=1e-6)
    assert rows[3]["median_ms"] == "" and summary["inputs"][3]["median_ms"] is None


def test_a_recording_is_measured_as_replay_does(data: Path, tmp_path: Path) -> None:
    report = run_many([data / "session.mcap"], tmp_path / "many", {})
    replay_file(data / "session.mcap", tmp_path / "alone")
    assert report.complete and report.rows[0].name == "session"
    assert str(shapes(tmp_path / "many" / "session")) == str(shapes(tmp_path / "alone"))


def test_what_was_interrupted_goes_on_where_it_stopped(data: Path, tmp_path: Path) -> None:
    with pytest.raises(KeyboardInterrupt):
        measure(data, tmp_path, progress=Watch(stop_at=2))
    tables = [tmp_path / name / "shapes.csv" for name in NAMES[:3]]
    assert [table.exists() for table in tables] == [True, True, False]
    assert not (tmp_path / "summary.csv").exists()
    written = [table.stat().st_mtime_ns for table in tables[:2]]
    watch = Watch()
    report = measure(data, tmp_path, resume=True, progress=watch)
    assert watch.done == [2, 3, 4]
    assert [table.stat().st_mtime_ns for table in tables[:2]] == written
    assert [row.pairs for row in report.rows] == [3, 1, 2, 0]


def test_what_changed_is_measured_again_and_so_is_what_failed(data: Path, tmp_path: Path) -> None:
    def kept(**options: Any) -> int:
        watch = Watch()
        measure(data, tmp_path, progress=watch, **options)
        return watch.done[0]

    assert kept() == 0
    assert kept(resume=True) == 3, "the folder without pictures was not measured"
    os.utime(data / "tuesday" / "photos" / "left" / "1.png", ns=(1, 1))
    assert kept(resume=True) == 2
    (tmp_path / "session" / "shapes.csv").write_text("of something else")
    assert kept(resume=True) == 2
    (tmp_path / NAMES[0] / "shapes.csv").unlink()
    assert kept(resume=True) == 2
    next((tmp_path / ".tubesight").iterdir()).write_bytes(b"{cut of")
    assert kept(resume=True) in (2, 3)
    os.utime(data / "tube.yaml", ns=(1, 1))
    assert kept(resume=True) == 1, "the tube is of both folders"
    assert kept() == 0


@pytest.mark.parametrize(
    ("paths", "names"),
    [
        (["/a/x", "/a/y.mcap"], ["x", "y"]),
        (["/a/x", "/b/x"], ["a-x", "b-x"]),
        (["/a/p/x", "/b/p/x", "/c/q/x"], ["a-p-x", "b-p-x", "q-x"]),
        (["/a/x", "/b/X.mcap"], ["a-x", "b-X"]),
        (["/a/x", "/a/x.mcap"], ["x", "x.mcap"]),
        (["/a/run.1", "/a/run.2"], ["run.1", "run.2"]),
        (["/a/summary.csv", "/a/.tubesight"], ["a-summary.csv", "a-.tubesight"]),
        (["/x", "/a/x", "/a-x"], None),
        (["/a/x", "/a/X"], None),
        (["/"], None),
    ],
)
def test_names_tell_inputs_apart(paths: list[str], names: list[str] | None) -> None:
    if names is None:
        with pytest.raises(InputError, match="rename"):
            names_of([Path(path) for path in paths])
    else:
        assert names_of([Path(path) for path in paths]) == names


@pytest.mark.filterwarnings("default")
def test_a_cluster_gives_the_same_though_a_worker_dies(data: Path, tmp_path: Path, cluster: Any) -> None:
    killed = []

    def kill(batch: str, done: int, total: int) -> None:
        if done == 1:
            killed.append(cluster.workers[0].pid)
            os.kill(killed[0], signal.SIGKILL)

    report = measure(data, tmp_path / "cluster", scheduler=cluster.scheduler_address, progress=kill)
    assert len(killed) == 1
    assert [(row.pairs, row.ok) for row in report.rows] == [(3, 3), (1, 1), (2, 2), (0, 0)]
    measure(data, tmp_path / "here")
    for name in NAMES[:3]:
        assert str(shapes(tmp_path / "cluster" / name)) == str(shapes(tmp_path / "here" / name))


def test_the_command_measures_many(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "out"
    (data / "run.yaml").write_text("rig_path: rig.yaml\ntube_path: tube.yaml\nmethod: cone_ray\n", encoding="utf-8")
    args = ("run", *inputs(data)[:3], "--config", data / "run.yaml", "-o", out, "--workers", "1")
    assert leave(*args) == 0
    printed = capsys.readouterr()
    assert "6 of 6 pairs measured in 3 inputs" in printed.out
    assert {row.method for name in NAMES[:3] for row in shapes(out / name)} == {"cone_ray"}
    assert leave(*args[:3], inputs(data)[3], *args[4:], "--json", "--resume") == 1
    printed = capsys.readouterr()
    told = json.loads(printed.out)
    assert [entry["ok"] for entry in told["inputs"]] == [3, 1, 0]
    assert f"error: empty: {data / 'empty'}: no subfolder 'left'" in printed.err


def test_one_folder_has_a_summary_where_it_is_asked_for(data: Path, tmp_path: Path) -> None:
    photos, known = data / "tuesday" / "photos", ("--rig", data / "rig.yaml", "--tube", data / "tube.yaml")
    assert leave("run", photos, *known, "-o", tmp_path / "alone") == 0
    assert leave("run", photos, photos, *known, "-o", tmp_path / "twice", "--workers", "1") == 0
    assert str(shapes(tmp_path / "alone")) == str(shapes(tmp_path / "twice" / "photos"))
    assert not (tmp_path / "alone" / "summary.csv").exists()
    assert len((tmp_path / "twice" / "summary.csv").read_text().splitlines()) == 2


@pytest.mark.parametrize(
    ("args", "code", "told"),
    [
        (["monday/photos", "session.mcap", "-o", "out"], 2, "--rig"),
        (["monday/photos", "session.mcap", "--rig", "rig.yaml"], 2, "--out"),
        (["session.mcap", "-o", "out", "--workers", "0"], 2, "--workers"),
        (["monday/photos", "session.mcap", "--rig", "none.yaml", "-o", "out"], 1, "none.yaml: no such file"),
        (["monday/photos", "empty", "--rig", "rig.yaml", "--base", "up:1,2", "-o", "out"], 1, "camera 'up'"),
        (["monday/photos", "empty", "--rig", "rig.yaml", "-o", "tube.yaml"], 1, "tube.yaml: results cannot be"),
        (["session.mcap", "-o", "out", "--scheduler", "nowhere"], 1, "nowhere"),
    ],
)
def test_what_concerns_all_inputs_is_refused_first(
    args: list[str],
    code: int,
    told: str,
    template: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(template)
    monkeypatch.setattr("tubesight.apps.pool._CONNECT_S", 0.2)
    assert leave("run", *args) == code
    error = capsys.readouterr().err
    assert told in error
    assert code == 2 or (error.startswith("error: ") and error.count("\n") == 1)
    assert not (template / "out").exists()


@pytest.mark.parametrize("name", ["none.mcap", "text.mcap", "cut.mcap", "folder.mcap", "nowhere"])
def test_an_input_that_cannot_be_read_does_not_stop_the_others(name: str, data: Path, tmp_path: Path) -> None:
    (data / "text.mcap").write_text("no recording")
    (data / "cut.mcap").write_bytes((data / "session.mcap").read_bytes()[:300])
    (data / "folder.mcap").mkdir()
    report = run_many([data / name, data / "session.mcap"], tmp_path, {"rig_path": data / "rig.yaml"})
    assert [row.ok for row in report.rows] == [0, 2]
    assert report.rows[0].problem.startswith(str(data / name))
    assert "\n" not in report.rows[0].problem
    assert not report.complete
