"""The live loop from the cameras to the subscribers, and the commands."""

import gc
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from live_scenes import SIZE
from tubesight.apps.live.loop import Moment, quiet_collector
from tubesight.apps.live.options import LiveOptions, set_up, simulated
from tubesight.apps.live.replay import replay_file
from tubesight.apps.live.session import run_session
from tubesight.apps.live.stats import Figures
from tubesight.cli.live import view_lines
from tubesight.cli.main import app
from tubesight.core import InputError, Status
from tubesight.outputs.publish import Mailbox
from tubesight.tracking.states import State

SIM = {"left": "sim:", "right": "sim:"}
SMALL = ["--size", f"{SIZE[0]}x{SIZE[1]}", "--gray"]
TWO = ["--source", "left=sim:", "--source", "right=sim:", *SMALL]


def options(sources: dict[str, str] = SIM, **more: object) -> LiveOptions:
    return LiveOptions(sources, size_px=SIZE, gray=True, **more)  # type: ignore[arg-type]


def test_simulated_cameras_are_measured_and_published() -> None:
    moments: list[Moment] = []
    box = Mailbox()
    given = options(seconds=1.5)
    figures = run_session(given, set_up(given), moments.append, (box,))
    assert figures.ok > 5 and figures.status == {"ok": figures.ok}
    newest = box.take(0.0)
    assert newest is not None and newest.result is not None and newest.result.status is Status.OK
    assert newest.state is State.TRACKING and newest.latency_s > 0
    # Every picture was measured, waits, or is counted with its reason.
    for counts in figures.cameras.values():
        lost = sum(n for key, n in counts.items() if key != "arrived")
        assert counts["arrived"] - lost - figures.pairs in (0, 1, 2)
    lines = view_lines(moments[-1].tracked, moments[-1].figures())
    assert any(line.startswith("tip [mm]") for line in lines) and "not a medical device" in lines[-1]
    assert gc.isenabled()


def test_faults_are_flagged_and_end_and_bad_pictures_are_never_ok() -> None:
    script = "fault:tear=0.1,truncate=0.1,drop=0.05,unplug@0.6+0.5,freeze@1.8+0.5:sim:"
    given = options({"left": script, "right": "sim:"}, seconds=3.5)
    moments: list[Moment] = []
    figures = run_session(given, set_up(given), moments.append)
    states = [m.tracked.state for m in moments]
    faults = {(name, str(fault)) for m in moments for name, fault in m.tracked.faults.items()}
    assert ("left", "unplugged") in faults and ("left", "frozen") in faults
    assert State.FAULT in states and states[-1] in (State.TRACKING, State.DEGRADED)
    left = figures.cameras["left"]
    assert left.get("torn", 0) > 0 and left.get("frozen", 0) > 0
    assert figures.ok > 5
    # The motion is smooth: a torn picture that was measured as ok would be off by millimetres.
    tips = [m.tracked.result.shape.tip_mm for m in moments if m.tracked.result and m.tracked.result.shape]
    assert all(abs(tip[2] - 118) < 30 for tip in tips)


def test_a_rig_file_is_needed_for_real_cameras(tmp_path: Path) -> None:
    assert simulated("fault:drop=0.1:sim:") and not simulated("http://a/sim:")
    with pytest.raises(InputError, match="a rig file is needed"):
        set_up(options({"left": "sim:", "right": str(tmp_path)}))
    with pytest.raises(InputError, match="a rig file is needed"):
        set_up(options({"left": "sim:"}))
    with pytest.raises(InputError, match="--base names camera 'up'"):
        set_up(options(base_px={"up": (1.0, 2.0)}))
    with pytest.raises(InputError, match="--tip names camera 'up'"):
        set_up(options(tip_px={"up": (1.0, 2.0)}))


def test_nothing_is_measured_but_the_tip_that_was_marked(tmp_path: Path) -> None:
    """Marked in corners of both pictures, where no tip is: as recorded, and as measured again."""
    pytest.importorskip("mcap")
    path = tmp_path / "marked.mcap"
    marks = ["--tip", "left:5,5", "right:470,5"]
    runner = CliRunner()
    done = runner.invoke(app, ["live", *TWO, *marks, "--seconds", "0.6", "--record", str(path), "--json"])
    assert done.exit_code == 1, done.output
    status = json.loads(done.stdout)["status"]
    assert set(status) == {"other_device"}
    again = replay_file(path)
    assert again.compared == status["other_device"] == again.equal


def test_a_camera_that_is_not_there_ends_the_session_with_its_reason() -> None:
    given = options({"left": "fault:unplug@0+60:sim:", "right": "sim:"})
    with pytest.raises(InputError, match=r"left: .* unplugged by the script"):
        run_session(given, set_up(given))


def test_the_collector_runs_between_frames_only() -> None:
    with quiet_collector() as collect:
        assert not gc.isenabled() and gc.get_freeze_count() > 0
        collect()
    assert gc.isenabled()


def test_live_record_replay_export_as_commands(tmp_path: Path) -> None:
    pytest.importorskip("mcap")
    path = tmp_path / "session.mcap"
    runner = CliRunner()
    done = runner.invoke(app, ["live", *TWO, "--seconds", "1", "--record", str(path), "--json"])
    assert done.exit_code == 0, done.output
    figures = json.loads(done.stdout)
    assert figures["recorded"]["results"] >= figures["ok"] > 0
    again = runner.invoke(app, ["replay", str(path), "--json"])
    assert again.exit_code == 0 and json.loads(again.stdout)["equal"] == figures["pairs"]
    assert runner.invoke(app, ["export", str(path), "-o", str(tmp_path / "a.csv")]).exit_code == 0
    assert runner.invoke(app, ["export", str(path), "-o", "x", "--format", "xls"]).exit_code == 2
    assert runner.invoke(app, ["recover", str(path), "-o", str(tmp_path / "b.mcap")]).exit_code == 0
    raw = tmp_path / "raw.mcap"
    assert runner.invoke(app, ["record", *TWO, "--seconds", "0.5", "-o", str(raw)]).exit_code == 0
    assert replay_file(raw).pairs > 0


@pytest.mark.parametrize(
    "wrong",
    [
        ["live", "--source", "left"],
        ["live", *TWO, "--offset", "right=x"],
        ["live", *TWO, "--record", "x.mcap", "--pictures", "all"],
        ["live", *TWO, "--method", "guess"],
        ["live", "--source", "left=sim:", "--source", "left=sim:"],
    ],
)
def test_wrong_usage_is_refused(wrong: list[str]) -> None:
    assert CliRunner().invoke(app, wrong).exit_code == 2


@pytest.mark.parametrize("sent", [signal.SIGINT])
def test_an_interrupt_ends_it_with_the_file_closed(tmp_path: Path, sent: signal.Signals) -> None:
    pytest.importorskip("mcap")
    path = tmp_path / "session.mcap"
    command = [sys.executable, "-m", "tubesight.cli.main", "live", *TWO, "--record", str(path)]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=os.environ)
    assert process.stderr is not None
    for line in process.stderr:
        if line.startswith(b"tracking"):
            break
    time.sleep(0.5)
    process.send_signal(sent)
    process.communicate(timeout=20)
    assert process.returncode == 0
    # Closed: it ends with the magic of a whole file.
    assert path.read_bytes().endswith(b"\x89MCAP0\r\n")


def test_the_figures_are_one_line_for_a_log() -> None:
    figures = Figures(1.0, 2, 2, 0, 2.0, 3.0, 2.0, 4.0, 0.1, 100.0, {"ok": 2}, {"left": {"arrived": 3, "torn": 1}})
    assert "pairs=2 ok=2" in figures.line() and "refused=1" in figures.line() and "\n" not in figures.line()
