"""``tubesight soak``: its figures, on a session of seconds."""

import json
import math
from collections.abc import Callable

import numpy as np
import pytest

from tubesight.apps.live.fault_trial import KINDS, Outcome, fault_trial, summed
from tubesight.apps.live.soak import growth
from tubesight.apps.live.stats import Stats
from tubesight.cli.main import main
from tubesight.core import Status
from tubesight.sensor import Reconstruction
from tubesight.tracking.states import State
from tubesight.tracking.tracker import Tracked


def test_soak_reports_pairing_alarms_and_memory(capsys: pytest.CaptureFixture[str]) -> None:
    args = ["soak", "--seconds", "2", "--hz", "10", "--size", "640x360", "--instants", "2000", "--hours", "0.02"]
    with pytest.raises(SystemExit) as left:
        main([*args, "--json"])
    figures = json.loads(capsys.readouterr().out)
    assert not left.value.code
    assert figures["pairing"]["mixed"] == 0 and figures["pairing"]["pairs"] > 1000
    assert figures["figures"]["pairs"] > 5 and figures["false_alarms"] == 0


def test_recordings_of_sessions_that_are_killed_or_fill_their_disk_are_readable() -> None:
    for kind in KINDS:
        trial = fault_trial(kind, 3)
        assert trial.good and trial.sessions == 3 and not trial.problems, trial
        assert 0 < trial.mean_lost_s <= trial.worst_lost_s


def test_what_goes_wrong_in_a_trial_is_counted_and_told() -> None:
    trial = summed("disk_full", [Outcome(0.2, True), Outcome(math.nan, True, "no file"), Outcome(0.4, False, "ended")])
    assert (trial.unreadable, trial.stopped, trial.worst_lost_s) == (1, 1, 0.4) and not trial.good
    assert trial.mean_lost_s == pytest.approx(0.3) and trial.problems == ("no file", "ended")
    assert not summed("killed", [Outcome(1.2, True)]).good and summed("killed", [Outcome(0.9, True)]).good
    assert "3 sessions with a full disk, 2 went on measuring: 2 recordings readable" in trial.line()


def looks(seconds: float, mb: Callable[[np.ndarray], np.ndarray]) -> list[tuple[float, float]]:
    """Two looks a second, beginning at an arbitrary time."""
    t = np.arange(0.0, seconds, 0.5)
    return list(zip((t + 1234.5).tolist(), mb(t).tolist(), strict=True))


def test_growth_is_that_after_the_warm_up() -> None:
    # 40 MB while caches fill, in 20 s, then 3 MB per hour.
    found = growth(looks(600, lambda t: 400 + 40 * np.minimum(t / 20, 1) + 3 * t / 3600))
    assert found.warm_up_s == pytest.approx(60) and found.seconds == pytest.approx(540, abs=1)
    assert found.mb_per_hour == pytest.approx(3) and found.sd_mb_per_hour == pytest.approx(0, abs=1e-6)


def test_a_step_is_in_the_standard_error() -> None:
    """One step of 2 MB: a slope, but not a sure one."""
    found = growth(looks(600, lambda t: 400 + 2.0 * (t > 400)))
    # Least squares over a unit step at 63 % of the span: 6 x 0.63 x 0.37 = 1.4 spans^-1 (over 540 s), and off the line
    # by up to half of it; ten means leave a third of the slope as its error.
    assert found.mb_per_hour == pytest.approx(1.4 * 2 / 540 * 3600, rel=0.1)
    assert 0.1 < found.sd_mb_per_hour / found.mb_per_hour < 0.4


def test_the_standard_error_covers_the_truth() -> None:
    """Noise that lasts 5 s, as that of memory does: nine of ten slopes lie within two standard errors."""
    rng = np.random.default_rng(0)
    within = 0
    for _ in range(200):
        noise = np.convolve(rng.normal(0, 1, 1209), np.ones(10) / 10, "valid")
        found = growth(looks(600, lambda t, noise=noise: 400 + noise))  # type: ignore[misc]
        within += abs(found.mb_per_hour) < 2 * found.sd_mb_per_hour
    # Student's t with 8 degrees of freedom: 92 %, and three deviations of 200 draws (1.9 %) below that.
    assert within / 200 > 0.86


def test_a_session_too_short_to_tell_has_no_growth() -> None:
    assert math.isnan(growth([(0.0, 1.0), (1.0, 2.0)]).mb_per_hour) and math.isnan(growth([]).mb_per_hour)


def test_the_percentile_of_latencies_is_good_to_a_percent() -> None:
    rng = np.random.default_rng(1)
    latencies_ms = rng.lognormal(1.5, 1.0, 20000)
    stats = Stats()
    for ms in latencies_ms:
        result = Reconstruction("", Status.OK, (), None, None, {}, "")
        stats.add(Tracked(result, State.TRACKING, 0.0, latency_s=ms / 1e3))
    told = stats.figures({}, {}).latency_p99_ms
    # The class it is in is 1 % wide.
    assert np.percentile(latencies_ms, 99) <= told * 1.0001 and told <= 1.011 * np.percentile(latencies_ms, 99)
