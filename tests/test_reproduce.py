"""`tubesight reproduce`: its tasks, what a study measures, what the command writes."""

import csv
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

import reproduce_tasks as tasks
from reproduce_tasks import Number
from tubesight.apps.pool import open_pool
from tubesight.apps.remembered import Remembered, forget
from tubesight.apps.reproduce import disturbed, drawing, experiment, experiment1, experiment2, sensitivity
from tubesight.apps.reproduce.cases import ADVICE, cases
from tubesight.apps.reproduce.disturbed import Disturbed, Look, Told
from tubesight.apps.reproduce.mockup import phantom_of, true_rig
from tubesight.apps.reproduce.registry import STUDIES, study
from tubesight.apps.reproduce.runner import reproduce
from tubesight.apps.reproduce.session import PlainRig, Session, calibrated
from tubesight.apps.reproduce.shots import ERRORS, METHODS, Shot, measured, statistics
from tubesight.apps.reproduce.study import Context
from tubesight.cli.main import app, main
from tubesight.core import Image, InputError
from tubesight.simulate import rig_around, truth

ROOT = Path(__file__).resolve().parents[1]
NUMBERS = range(8)


@pytest.fixture
def calls(tmp_path: Path) -> Path:
    folder = tmp_path / "calls"
    folder.mkdir()
    return folder


def numbers(calls: Path) -> list[Number]:
    return [Number(float(value), str(calls)) for value in NUMBERS]


@pytest.mark.parametrize("workers", [1, 2])
def test_results_come_in_order_whatever_the_number_of_workers(workers: int, calls: Path) -> None:
    with open_pool(workers) as pool:
        results = Remembered(calls.parent / "cache", pool)("study", tasks.third, numbers(calls))
    assert results == [{"third": value / 3} for value in NUMBERS]
    assert len({path.name.rpartition("-")[2] for path in calls.iterdir()}) <= workers


def test_an_interrupted_run_goes_on_where_it_stopped(calls: Path) -> None:
    seen: list[tuple[int, int]] = []
    with open_pool(1) as pool:
        spread = Remembered(calls.parent / "cache", pool, lambda study, done, total: seen.append((done, total)))
        with pytest.raises(KeyboardInterrupt):
            spread("study", tasks.until_four, numbers(calls))
        # What was done is in the cache under the function's name.
        assert spread("study", tasks.until_four, numbers(calls)[:4]) == [{"third": v / 3} for v in range(4)]
    assert len(list(calls.iterdir())) == 4
    assert seen[-1] == (4, 4)
    assert seen[4] == (4, 8)


def test_other_tasks_and_other_code_are_not_mixed_up(calls: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with open_pool(1) as pool:
        spread = Remembered(calls.parent / "cache", pool)
        spread("study", tasks.third, numbers(calls)[:1])
        spread("study", tasks.third, [Number(1e-9, str(calls))])
        monkeypatch.setattr("tubesight.apps.remembered._source", lambda: "changed")
        spread("study", tasks.third, numbers(calls)[:1])
    assert len(list(calls.iterdir())) == 3


def test_only_what_was_kept_is_forgotten(calls: Path) -> None:
    """A folder of results may hold a `cache` of somebody else's."""
    cache = calls.parent / "cache"
    forget(cache)
    with open_pool(1) as pool:
        Remembered(cache, pool)("study", tasks.third, numbers(calls)[:2])
    (cache / "mine.json").write_text("{}")
    assert len(list(cache.iterdir())) == 3
    forget(cache)
    assert [path.name for path in cache.iterdir()] == ["mine.json"]


def test_workers_end_with_a_parent_that_is_killed(calls: Path) -> None:
    script = (
        "import reproduce_tasks as tasks, sys\n"
        "from tubesight.apps.pool import open_pool\n"
        "if __name__ == '__main__':\n"
        "    with open_pool(2) as pool:\n"
        "        for _ in pool(tasks.third, [tasks.Number(float(i), sys.argv[1]) for i in range(10**5)]):\n"
        "            pass\n"
    )
    (calls.parent / "parent.py").write_text(script)
    folders = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    parent = subprocess.Popen(
        [sys.executable, calls.parent / "parent.py", calls], env={**os.environ, "PYTHONPATH": folders}
    )
    while not any(calls.iterdir()):
        assert parent.poll() is None
        time.sleep(0.05)
    parent.kill()
    parent.wait()
    # Each call names its process. A second is thousands of calls; a process that lives on would make more of them.
    time.sleep(1.0)
    before = len(list(calls.iterdir()))
    time.sleep(0.5)
    assert len(list(calls.iterdir())) == before


def test_a_killed_process_is_told_in_one_line(calls: Path) -> None:
    with open_pool(2) as pool, pytest.raises(InputError, match="--resume") as caught:
        list(pool(tasks.fatal, numbers(calls)))
    assert "\n" not in str(caught.value)


@pytest.mark.filterwarnings("default")
def test_a_cluster_survives_the_death_of_a_worker(calls: Path, cluster: Any) -> None:
    with open_pool(1, cluster.scheduler_address) as pool:
        results = Remembered(calls.parent / "cache", pool)("study", tasks.fatal, numbers(calls))
    assert (calls / "killed").exists()
    assert results == [value**2 for value in NUMBERS]


@pytest.mark.filterwarnings("default")
def test_a_task_that_kills_its_workers_is_told_in_one_line(calls: Path, cluster: Any) -> None:
    # Dask tries three more workers; starting them takes the time of this test.
    cluster.scheduler.allowed_failures = 0
    with open_pool(1, cluster.scheduler_address) as pool, pytest.raises(InputError, match="memory") as caught:
        list(pool(tasks.deadly, numbers(calls)[:1]))
    assert "\n" not in str(caught.value)


def test_an_interruption_does_not_wait_for_tasks_that_run(calls: Path) -> None:
    with pytest.raises(KeyboardInterrupt), open_pool(2) as pool:
        for _ in pool(tasks.slow_but_first, numbers(calls)[:2]):
            raise KeyboardInterrupt
    assert [path.name for path in calls.iterdir()] == ["started"]


def test_no_scheduler_is_told_in_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("distributed")
    monkeypatch.setattr("tubesight.apps.pool._CONNECT_S", 0.2)
    # Port 9 (discard) has no listener on any ordinary machine.
    with pytest.raises(InputError, match="dask scheduler") as caught, open_pool(1, "tcp://127.0.0.1:9"):
        pass
    assert "\n" not in str(caught.value)


def test_a_rig_survives_being_plain_data() -> None:
    rig = true_rig()
    back = PlainRig.from_plain(json.loads(json.dumps(asdict(PlainRig.of(rig))))["cameras"]).rig()
    point = np.array([[10.0, -20.0, 90.0]])
    for name in rig.names:
        assert (back.project(name, point) == rig.project(name, point)).all()
    assert back.registered


def test_a_session_recovers_the_rig() -> None:
    """Six views of a quarter of the pixels: the tip's room is seen within 0.2 px, 0.1 mm.

    A rendered corner is measured to 0.02 px; tips lie at the edge of the room the board was carried through, where six
    views leave ten times that at most.
    """
    session = Session(seed=3, views=6, size_px=(960, 540))
    made = calibrated(session)
    assert not made["refused"]
    rig, true = PlainRig.from_plain(json.loads(json.dumps(made))["cameras"]).rig(), true_rig()
    # Pixels of the larger true rig are twice as fine.
    tips = np.array([phantom_of(40.0, phi).at([160.0])[0] for phi in (0.0, 120.0, 240.0)])
    for name in rig.names:
        off = rig.cameras[name].unproject(rig.project(name, tips)) - true.cameras[name].unproject(
            true.project(name, tips)
        )
        assert np.abs(off).max() * rig.cameras[name].focal_px < 0.2


def test_a_refused_calibration_is_a_result() -> None:
    made = calibrated(Session(seed=0, views=1, size_px=(480, 270)))
    assert made["cameras"] == []
    assert "board" in made["refused"]


def test_a_shot_is_measured_by_every_method_with_every_rig() -> None:
    true = PlainRig.of(true_rig())
    shot = Shot("circular 30", 30.0, 1.0, 60.0, true, (("a", true), ("b", true)), 7)
    rows = measured(shot)
    assert [(row["rig"], row["method"]) for row in rows] == [(r, m) for r in "ab" for m in METHODS]
    for a, b in zip(rows[:3], rows[3:], strict=True):
        assert {**a, "rig": ""} == {**b, "rig": ""}
    for row in rows:
        # The paper's largest errors; measured here 0.3 (reference) and 0.04.
        assert max(abs(row[key]) for key in ERRORS) < (0.6 if row["method"] == "reference" else 0.15), row
        assert row["tip_x_mm"] - row["tip_x_error_mm"] == pytest.approx(truth(phantom_of(30.0, 60.0))["tip"][0])


def test_statistics_are_over_good_rows() -> None:
    good: dict[str, Any] = dict.fromkeys(ERRORS, 0.0)
    rows = [
        {"status": "ok", **good, "tip_x_error_mm": -0.3, "bending_error_deg": 0.1},
        {"status": "ok", **good, "tip_z_error_mm": 0.6, "bending_error_deg": -0.3, "orientation_error_deg": np.nan},
        {"status": "tip_not_found", **dict.fromkeys(ERRORS, np.nan)},
    ]
    entry = statistics(rows)
    assert entry["tip_max_mm"] == 0.6
    assert entry["tip_mean_mm"] == pytest.approx((0.3 + 0.6) / 6)
    assert entry["bending_max_deg"] == 0.3
    assert entry["bending_mean_deg"] == pytest.approx(0.2)
    assert entry["orientation_mean_deg"] == 0.0
    assert (entry["failures"], entry["n"]) == (1, 3)
    assert np.isnan(statistics(rows[2:])["tip_max_mm"])


class TestDisturbed:
    def clock(self, time_s: float) -> Image:
        """Picture whose gray level tells the time, 100 at zero, one level a millisecond."""
        return np.full((90, 4, 3), round(100 + 1e3 * time_s), np.uint8)

    def test_rows_are_read_one_after_the_other(self) -> None:
        picture = disturbed._exposed(self.clock, Look(readout_s=0.09), 0.02)
        times = picture[:, 0, 0].astype(int)
        assert (np.diff(times) >= 0).all()
        # Middle row at the start; first and last instant half a step from the ends.
        assert times[45] == 120
        step = 90 / disturbed._ROW_STEPS
        assert times[[0, -1]] == pytest.approx([120 - 45 + step / 2, 120 + 45 - step / 2], abs=0.5)

    def test_an_open_shutter_averages_light(self) -> None:
        picture = disturbed._exposed(self.clock, Look(open_s=0.02), 0.0)
        assert picture.min() == picture.max() == 100

    def test_nothing_wrong_is_the_plain_picture(self) -> None:
        assert (disturbed._exposed(self.clock, Look(), 0.05) == 150).all()

    def test_the_tip_has_its_speed(self) -> None:
        shot = Disturbed(Look(tip_speed_mm_s=100.0), 30.0, 1.0, 60.0, 0)
        there, later = (np.array(truth(disturbed._phantom(shot, t))["tip"]) for t in (0.0, 0.01))
        # 1 mm for a bending of 0; at 30 degrees the tip is 2 % slower (the chord is shorter than the tube).
        assert np.linalg.norm(later - there) == pytest.approx(1.0, abs=0.03)

    def test_the_truth_moves_with_the_clamp(self) -> None:
        shot = Disturbed(Look(clamp_shift_mm=1.0), 30.0, 1.0, 60.0, 0)
        moved = disturbed._phantom(shot, 0.0).at([0.0])[0]
        assert np.linalg.norm(moved) == pytest.approx(1.0)

    def test_light_is_multiplied(self) -> None:
        gray = disturbed._brighter((100.0, 100.0, 100.0), 2.0)
        # 100 sRGB is 0.1274 of full light; twice that is 138.2.
        assert gray == pytest.approx((138.2,) * 3, abs=0.1)
        assert disturbed._brighter((230.0,) * 3, 2.0)[0] > 255

    def test_a_wrong_diameter_is_told_to_the_methods(self) -> None:
        small = Look(size_px=(960, 540))
        told = (Told(), Told(diameter_error_mm=0.3))
        right, wrong = disturbed.measured_disturbed(Disturbed(small, 50.0, 1.0, 60.0, 1, told))
        assert [row["method"] for row in right] == list(METHODS)
        # The reference uses the diameter for nothing but its start; the fit believes it.
        assert right[-1]["tip_z_error_mm"] != wrong[-1]["tip_z_error_mm"]

    def test_photographs_are_shared_and_change_nothing(self) -> None:
        """What is measured beside something else is measured as alone."""
        small = Look(size_px=(640, 360))
        rig = PlainRig.of(rig_around(size_px=small.size_px))
        told = (Told(), Told(diameter_error_mm=-0.1), Told(rig))
        together = disturbed.measured_disturbed(Disturbed(small, 30.0, 1.0, 60.0, 1, told))
        for alone, rows in zip(told, together, strict=True):
            assert [rows] == disturbed.measured_disturbed(Disturbed(small, 30.0, 1.0, 60.0, 1, (alone,)))
        assert together[0] != together[1]


def test_every_cause_has_advice_and_every_case_a_name() -> None:
    listed = cases(0)
    assert {case.cause for case in listed} == set(ADVICE)
    assert len({(case.cause, case.level) for case in listed}) == len(listed)
    assert {case.cause for case in listed if case.quick} >= {"nothing", "clamp tilt", "diameter"}


def perfect(session: Session) -> dict[str, Any]:
    """Calibrate without a picture and without an error."""
    return {"cameras": asdict(PlainRig.of(true_rig()))["cameras"], "rms_px": 0.0, "refused": ""}


def hopeless(session: Session) -> dict[str, Any]:
    """Calibrate from pictures that show nothing."""
    return {"cameras": [], "rms_px": float("nan"), "refused": "left: no board"}


@pytest.fixture
def small(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Experiments of two tubes at few orientations, with a perfect calibration."""
    for module in (experiment, sensitivity):
        monkeypatch.setattr(module, "calibrated", perfect)
    # Coarse pictures are drawn faster.
    monkeypatch.setattr("tubesight.apps.reproduce.study._DPI", 40)
    monkeypatch.setattr(experiment1, "BENDING_DEG", (30,))
    monkeypatch.setattr(experiment1, "ORIENTATIONS_DEG", (60,))
    monkeypatch.setattr(experiment2, "_BENDING_DEG", (70,))
    monkeypatch.setattr(experiment2, "_QUICK_STEP_DEG", 180)
    yield


def read(path: Path) -> tuple[dict[str, str], list[dict[str, str]]]:
    lines = path.read_text().splitlines()
    about = dict(line[2:].split(": ", 1) for line in lines if line.startswith("#"))
    return about, list(csv.DictReader(line for line in lines if not line.startswith("#")))


@pytest.mark.usefixtures("small")
def test_experiments_are_measured_and_reported(tmp_path: Path) -> None:
    result = CliRunner().invoke(
        app, ["reproduce", "experiment2", "experiment1", "--quick", "--workers", "1", "-o", str(tmp_path)]
    )
    assert result.exit_code == 0, result.output
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert list(summary) == ["experiment1", "experiment2"]
    for name, count in (("experiment1", 2), ("experiment2", 4)):
        about, rows = read(tmp_path / "data" / f"{name}.csv")
        assert about["study"] == name
        assert about["seed"] == "0"
        assert json.loads(about["configuration"])["tube"]["diameter_mm"] == 12.0
        assert len(rows) == 2 * len(METHODS) * count
        for method in METHODS:
            entry = summary[name][method]
            own = [r for r in rows if r["method"] == method and r["rig"] == "calibrated"]
            worst = max(abs(float(r[f"tip_{axis}_error_mm"])) for r in own for axis in "xyz")
            assert entry["tip_max_mm"] == pytest.approx(worst, rel=1e-6)
            assert (entry["failures"], entry["n"]) == (0, count)
        # A perfect calibration measures what the true rig does.
        assert summary[name]["silhouette"] == summary[name]["silhouette/true_rig"]
    page = (tmp_path / "report.html").read_text()
    assert page.count("data:image/png;base64,") == 7
    assert 'src="http' not in page
    assert "Research use only" in page
    assert f"{summary['experiment1']['silhouette']['tip_max_mm']:.3f} mm at most" in page
    for number in range(5, 12):
        assert (tmp_path / "figures" / f"figure{number}.pdf").read_bytes().startswith(b"%PDF")


@pytest.mark.usefixtures("small")
def test_running_twice_gives_equal_data_and_resuming_does_nothing_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(experiment1, "_absolute", lambda *_: drawing.panels(1, 1, (2.0, 2.0))[0])
    for folder in ("a", "b"):
        reproduce(tmp_path / folder, ["experiment1"], quick=True)
    files = [
        p.relative_to(tmp_path / "a") for p in (tmp_path / "a").rglob("*") if p.suffix in (".csv", ".json", ".pdf")
    ]
    assert len(files) > 4
    for path in files:
        assert (tmp_path / "a" / path).read_bytes() == (tmp_path / "b" / path).read_bytes(), path
    done: list[tuple[int, int]] = []
    reproduce(
        tmp_path / "a", ["experiment1"], quick=True, resume=True, progress=lambda study, k, n: done.append((k, n))
    )
    assert done == [(1, 1), (2, 2)]


def test_seeds_differ_by_what_they_are_for() -> None:
    context = Context("a", Path(), True, 0, Remembered(Path(), open_pool))  # type: ignore[arg-type]
    seeds = {
        context.seed_of("x"),
        context.seed_of("x", 1),
        replace(context, seed=1).seed_of("x"),
        replace(context, study="b").seed_of("x"),
    }
    assert len(seeds) == 4
    assert context.seed_of("x") in seeds


@pytest.mark.usefixtures("small")
def test_a_refused_calibration_ends_the_experiment_in_one_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(experiment, "calibrated", hopeless)
    with pytest.raises(InputError, match="seed 0") as caught:
        reproduce(tmp_path, ["experiment1"])
    assert "\n" not in str(caught.value)


@pytest.mark.usefixtures("small")
def test_sensitivity_lists_every_case(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chosen = [case for case in cases(0) if case.quick]
    small_cases = [
        chosen[0],
        replace(chosen[1], session=Session(seed=0)),
        replace(next(c for c in chosen if c.cause == "resolution"), look=Look(size_px=(640, 360))),
    ]
    monkeypatch.setattr(sensitivity, "cases", lambda seed: small_cases)
    monkeypatch.setattr(sensitivity, "_QUICK_POSES", ((70.0, 1.0, 60.0),))
    monkeypatch.setattr("tubesight.apps.reproduce.distortion._BENDING_DEG", (10, 70))
    monkeypatch.setattr("tubesight.apps.reproduce.distortion._QUICK_STEP_DEG", 180)
    made = reproduce(tmp_path, ["sensitivity"], quick=True)
    entry = made.results["sensitivity"]
    assert len(entry.summary) == len(METHODS) * len(small_cases)
    # A third of the pixels: errors in millimetres grow at least as the pixels do.
    coarse, fine = (entry.summary[f"silhouette/{name}"]["tip_max_mm"] for name in ("resolution 640 x 360", "nothing"))
    assert coarse > 1.5 * fine
    _, rows = read(tmp_path / "data" / "sensitivity_distortion.csv")
    assert {row["rig"] for row in rows} == {"corrected", "nine tenths corrected", "not corrected"}
    # The simulated lens has 0.3 mm of distortion at the tip of a tube bent by 70 degrees.
    spread = {
        rig: max(abs(float(r["tip_x_error_mm"])) for r in rows if r["rig"] == rig and r["method"] == "silhouette")
        for rig in ("corrected", "not corrected")
    }
    assert spread["not corrected"] > 0.1 > spread["corrected"]


def test_figures_that_measure_nothing(tmp_path: Path) -> None:
    made = reproduce(tmp_path, ["figure2", "figure4"])
    assert list(made.results) == ["figure2", "figure4"]
    assert json.loads(made.summary.read_text()) == {}
    assert made.report.read_text().count("data:image/png") == 3


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["experiment3"], "did you mean 'experiment"),
        (["figure2", "-o", "file"], "file"),
        (["figure2", "--scheduler", "nowhere"], "nowhere"),
    ],
)
def test_bad_input_is_one_line(
    arguments: list[str],
    message: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("tubesight.apps.pool._CONNECT_S", 0.2)
    (tmp_path / "file").write_text("")
    with pytest.raises(SystemExit) as caught:
        main(["reproduce", *arguments])
    assert caught.value.code == 1
    error = capsys.readouterr().err
    assert error.startswith("error: ")
    assert message in error
    assert error.count("\n") == 1


def test_every_study_is_there_and_documented() -> None:
    page = (ROOT / "docs" / "reproduce.md").read_text()
    for name in STUDIES:
        assert callable(study(name))
        assert f"`{name}`" in page
