"""States, prediction, doubt and filter; the watch over the rig."""

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import product
from types import MappingProxyType

import numpy as np
import pytest

from live_scenes import frame
from tubesight.core import Status
from tubesight.geometry.curve import Arc
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.geometry.shape import SD_NAMES, Shape
from tubesight.sensor import Reconstruction, ShapeSensor
from tubesight.simulate import Arc as Bent
from tubesight.simulate import rig_around
from tubesight.tracking.health import Health, Mean, blind_spots, epipolar_px, observe, verdict
from tubesight.tracking.kalman import begin, correct, distance_squared, predict
from tubesight.tracking.offset import estimate_offset
from tubesight.tracking.pairing import Matched
from tubesight.tracking.states import TRANSITIONS, Event, State
from tubesight.tracking.tracker import FILTER_SHARES, Tracker
from tubesight.tracking.watch import CameraFault


def test_the_table_of_transitions_is_complete() -> None:
    assert set(TRANSITIONS) == set(product(State, Event))


@pytest.mark.parametrize("state", State)
def test_what_holds_in_every_state(state: State) -> None:
    assert TRANSITIONS[state, Event.CAMERA_FAULT] is State.FAULT
    # Only the cameras being back ends a fault, and then all begins anew.
    for event in set(Event) - {Event.CAMERAS_BACK}:
        assert (TRANSITIONS[state, event] is State.FAULT) == (state is State.FAULT or event is Event.CAMERA_FAULT)
    assert TRANSITIONS[State.FAULT, Event.CAMERAS_BACK] is State.SEARCHING
    if state is not State.FAULT:
        assert TRANSITIONS[state, Event.GOOD] is State.TRACKING
        assert TRANSITIONS[state, Event.CAMERAS_BACK] is state
    # A doubtful or missed pair never leads to tracking.
    for event in (Event.DOUBTFUL, Event.MISSED, Event.MISSED_LONG):
        assert TRANSITIONS[state, event] is not State.TRACKING
    assert state.meaning


def measured(tip: tuple[float, float, float], sd: float = 0.05) -> Reconstruction:
    shape = Shape(np.array(tip), 0.5, 1.0, 150.0, 0.003, dict.fromkeys(SD_NAMES, sd))
    return Reconstruction("", Status.OK, (), shape, Arc(np.array([0.003, 0.0]), 150.0), {}, "silhouette")


FAILED = Reconstruction("", Status.TUBE_NOT_FOUND, ("not there",), None, None, {}, "silhouette")


def pair(time_s: float, skew_s: float = 0.0) -> Matched:
    return Matched(MappingProxyType({"left": frame("left", time_s)}), time_s, skew_s)


def test_a_steady_tube_is_tracked_and_predicted() -> None:
    tracker = Tracker()
    for k in range(30):
        # 100 mm/s along x.
        tracked = tracker.step(measured((100 * k / 30, 0.0, 120.0)), pair(k / 30))
    assert tracked.state is State.TRACKING and not tracked.notes
    assert tracked.predicted_tip_mm is not None
    # Constant velocity after 29 exact measurements: the prediction is off by what the first guess of rest left.
    assert tracked.predicted_tip_mm == pytest.approx([100 * 29 / 30, 0.0, 120.0], abs=0.2)


def test_the_family_is_that_of_the_last_good_pair_while_the_tube_is_followed() -> None:
    tracker = Tracker()
    assert tracker.family == ""
    result = measured((0.0, 0.0, 100.0))
    tracker.step(result, pair(0.0))
    assert result.curve is not None and tracker.family == result.curve.model
    tracker.begin_anew()
    assert tracker.family == ""


def test_pictures_that_come_at_once_are_of_the_same_tube() -> None:
    """A tip at 300 mm/s, 30 pictures a second, of which some come late and bear the time at which they came."""
    tracker, came = Tracker(), 0.0
    for k in range(90):
        held_up = 0.1 if k % 30 > 26 else 0.0
        came = max(came + 0.001, k / 30 + held_up)
        told = tracker.step(measured((10.0 * k, 0.0, 100.0)), pair(came))
        assert told.result, k


def test_a_jump_is_doubted_and_not_measured() -> None:
    tracker = Tracker()
    for k in range(10):
        tracker.step(measured((0.0, 0.0, 120.0)), pair(k / 30))
    jumped = tracker.step(measured((60.0, 0.0, 120.0)), pair(10 / 30))
    assert jumped.state is State.DEGRADED and "60.0 mm from where it was expected" in jumped.notes[0]
    assert jumped.result is not None and jumped.result.shape is None
    assert jumped.result.status is Status.OTHER_DEVICE
    back = tracker.step(measured((0.0, 0.0, 120.0)), pair(11 / 30))
    assert back.state is State.TRACKING


def test_three_doubtful_tips_that_agree_are_the_tube() -> None:
    tracker = Tracker()
    for k in range(10):
        tracker.step(measured((0.0, 0.0, 120.0)), pair(k / 200))
    # At 200 Hz 60 mm are out of reach for all three: 5 m/s^2 for 15 ms are 0.6 mm.
    states = [tracker.step(measured((60.0, 0.0, 120.0)), pair((10 + k) / 200)).state for k in range(4)]
    assert states == [State.DEGRADED, State.DEGRADED, State.TRACKING, State.TRACKING]


def test_a_tube_that_is_not_found_degrades_and_after_half_a_second_is_lost() -> None:
    tracker = Tracker()
    assert tracker.step(FAILED, pair(0.0)).state is State.SEARCHING
    tracker.step(measured((0.0, 0.0, 120.0)), pair(0.1))
    states = [tracker.step(FAILED, pair(0.1 + k / 30)).state for k in range(1, 18)]
    assert states[0] is State.DEGRADED and states[14] is State.DEGRADED and states[15] is State.LOST
    found = tracker.step(measured((50.0, 0.0, 120.0)), pair(1.0))
    # What was known before the loss says nothing of where the tube is now.
    assert found.state is State.TRACKING and found.predicted_tip_mm is None


def test_a_fault_of_a_camera_stops_everything_until_all_are_back() -> None:
    tracker = Tracker()
    tracker.step(measured((0.0, 0.0, 120.0)), pair(0.0))
    told = tracker.watch({"left": CameraFault.FROZEN}, 0.1)
    assert told is not None and told.state is State.FAULT and told.result is None and "left" in told.notes[0]
    assert tracker.step(measured((0.0, 0.0, 120.0)), pair(0.11)).state is State.FAULT
    back = tracker.watch({}, 0.2)
    assert back is not None and back.state is State.SEARCHING
    assert tracker.watch({}, 0.3) is None


@pytest.mark.parametrize(("silent_s", "refused"), [(0.2, 0), (1.0, 2)])
def test_a_tube_is_doubted_after_a_long_silence_of_a_camera_only(silent_s: float, refused: int) -> None:
    tracker = Tracker()
    for k in range(30):
        tracker.step(measured((0.5 * k, 0.0, 100.0)), pair(k / 30))
    tracker.watch({"left": CameraFault.SILENT}, 1.1)
    tracker.watch({}, 1.0 + silent_s)
    told = [tracker.step(measured((16.0, 0.0, 100.0)), pair(1.0 + silent_s + k / 30)) for k in range(5)]
    assert [bool(each.result) for each in told] == [False] * refused + [True] * (5 - refused)


def test_the_skew_adds_to_the_deviations_by_the_motion() -> None:
    tracker = Tracker()
    tracker.step(measured((0.0, 0.0, 120.0)), pair(0.0, 0.008))
    moved = tracker.step(measured((4.0, 0.0, 120.0)), pair(0.04, 0.008))
    assert moved.result is not None and moved.result.shape is not None
    sd = moved.result.shape.sd
    # 100 mm/s over half of 8 ms: 0.4 mm beside 0.05.
    assert sd["tip_x"] == pytest.approx(math.hypot(0.4, 0.05)) and sd["tip_y"] == pytest.approx(0.05)


def test_the_filter_follows_and_reports_less_noise_than_it_gets() -> None:
    rng = np.random.default_rng(0)
    tracker = Tracker(filtered=True, acceleration_mm_per_s2=50.0)
    raw, smooth = [], []
    for k in range(200):
        curve = Arc(np.array([0.003, 0.0]) + rng.normal(0, 2e-5, 2), 150.0)
        tip = curve.at([150.0])[0]
        shape = Shape(tip, 0.5, 1.0, 150.0, 0.003, dict.fromkeys(SD_NAMES, 0.2))
        result = Reconstruction("", Status.OK, (), shape, curve, {}, "silhouette")
        tracked = tracker.step(result, pair(k / 200))
        if k > 50 and tracked.filtered is not None:
            raw.append(tip)
            smooth.append(tracked.filtered.position_mm[-3:])
    assert len(smooth) == 149
    assert np.std(smooth, axis=0)[0] < 0.5 * np.std(raw, axis=0)[0]
    assert tracked.filtered is not None and len(tracked.filtered.position_mm) == 3 * len(FILTER_SHARES)
    # The unfiltered value is there, and is what was measured.
    assert tracked.result is not None and tracked.result.shape is not None
    assert np.array_equal(tracked.result.shape.tip_mm, tip)


def test_the_filter_is_consistent_with_its_own_model() -> None:
    """Errors of a simulated motion of the model's own kind are chi squared with the covariance stated."""
    rng = np.random.default_rng(2)
    a, h, noise = 1000.0, 0.01, 0.1 * np.eye(3)
    squares = []
    for _ in range(60):
        x, v = np.zeros(3), rng.normal(0, 50, 3)
        state = begin(0.0, x + rng.normal(0, math.sqrt(0.1), 3), noise, 50.0)
        for k in range(1, 40):
            push = rng.normal(0, a, 3)
            x, v = x + h * v + h * h / 2 * push, v + h * push
            state = correct(predict(state, k * h, a), x + rng.normal(0, math.sqrt(0.1), 3), noise)
        squares.append(distance_squared(state, x, np.zeros((3, 3))))
    # The mean of 60 draws of chi squared with 3 degrees of freedom: 3 +- sqrt(2 * 3 / 60) = 0.32; four of these.
    assert np.mean(squares) == pytest.approx(3.0, abs=1.3)


def test_prediction_composes() -> None:
    state = begin(0.0, np.array([1.0, 2.0, 3.0]), np.eye(3), 5.0)
    once, twice = predict(state, 0.2, 0.0), predict(predict(state, 0.1, 0.0), 0.2, 0.0)
    assert np.allclose(once.covariance, twice.covariance, atol=1e-12)


@pytest.fixture(scope="module")
def seen(simulated_pair: Callable[..., object]) -> tuple[list[object], Rig]:
    """Pictures of one tube in six shapes at 720p."""
    shapes = [Bent(0.7 + 0.4 * math.cos(k), 1.0 + 0.8 * math.sin(k), 150.0) for k in range(6)]
    return [simulated_pair(shape) for shape in shapes], rig_around(90.0, size_px=(1280, 720))


def moved(rig: Rig, name: str, turn_deg: tuple[float, ...], shift_mm: tuple[float, ...]) -> Rig:
    pose = Pose.from_rotvec(np.radians(turn_deg), np.array(shift_mm)) @ rig.camera_from_base[name]
    return Rig(rig.cameras, {**rig.camera_from_base, name: pose}, rig.base_frame)


@pytest.mark.parametrize(
    ("camera", "turn", "shift"),
    [
        ("left", (0.2, 0.0, 0.0), (0.0, 0.0, 0.0)),
        ("left", (0.0, -0.2, 0.0), (0.0, 0.0, 0.0)),
        ("right", (0.0, 0.0, 0.2), (0.0, 0.0, 0.0)),
        ("right", (0.0, 0.0, 0.0), (2.0, 0.0, 0.0)),
        ("right", (0.0, 0.0, 0.0), (0.0, 2.0, 0.0)),
    ],
)
def test_a_camera_that_moves_is_flagged_and_named(
    seen: tuple[list[object], Rig], camera: str, turn: tuple[float, ...], shift: tuple[float, ...]
) -> None:
    pictures, rig = seen
    wrong = moved(rig, camera, turn, shift)
    # Pictures of cameras that moved, read with the rig of before, are those of cameras that did not, read with a rig
    # that is off by as much.
    before = [ShapeSensor(rig, p.tube)(p.pair) for p in pictures]  # type: ignore[attr-defined]
    after = [ShapeSensor(wrong, p.tube)(p.pair) for p in pictures]  # type: ignore[attr-defined]
    health = Health()
    for k in range(90):
        health = observe(health, before[k % 6], rig, clamped=True)
    assert verdict(health, rig) == ""
    flagged = 0
    for k in range(300):
        health = observe(health, after[k % 6], wrong, clamped=True)
        flagged = flagged or (k if verdict(health, wrong) else 0)
    assert 0 < flagged < 300
    said = verdict(health, wrong)
    assert said.startswith(camera) and "moved" in said, said


def test_the_watch_over_the_rig_says_what_it_cannot_see(seen: tuple[list[object], Rig]) -> None:
    _, rig = seen
    tip = Bent(0.7, 1.0, 150.0).at(150.0)
    assert blind_spots(rig, tip, clamped=True) == ()
    free = blind_spots(rig, tip, clamped=False)
    # Without the clamp, a turn about the optical axis moves the tip along its epipolar line nearly.
    assert any(spot.startswith("left: a turn about its z axis") for spot in free)


def test_a_shift_along_the_optical_axis_that_the_tip_does_not_show_is_told() -> None:
    rig = rig_around(90.0, size_px=(1280, 720))
    # Bent so far that the tip is as high in the pictures as the cameras are.
    high, low = (Bent(theta, 5.0, 150.0).at(150.0) for theta in (1.3, 0.6))
    said = blind_spots(rig, high, clamped=True)
    assert [spot.partition(" below")[0] for spot in said] == [
        "left: a shift along its z axis", "right: a shift along its z axis"
    ]  # fmt: skip
    assert blind_spots(rig, low, clamped=True) == ()
    # Told also where the tip was there a part of the time alone.
    assert blind_spots(rig, np.stack([low, high]), clamped=True) == said


def test_a_rig_that_was_off_at_the_start_is_told() -> None:
    health = Health(side_px={"left": replace(Mean(), value=3.0, reference=3.0, count=200)})
    assert "not as calibrated" in verdict(health, rig_around(90.0))


def test_a_tube_that_is_clamped_anew_is_not_blamed_on_one_camera() -> None:
    mean = Mean(value=2.0, reference=0.0, count=200)
    said = verdict(Health(side_px={"left": mean, "right": mean}), rig_around(90.0))
    assert "the clamp moved, or several cameras did" in said


def test_one_misread_frame_is_no_motion() -> None:
    mean = Mean()
    for _ in range(100):
        mean = mean.add(0.0, 1.5)
    # A fiftieth of what one frame may count at most: 0.03 px.
    assert abs(mean.add(500.0, 1.5).change) <= 0.031
    assert mean.add(math.nan, 1.5) is mean


def test_the_epipolar_residual_is_a_distance_in_pixels() -> None:
    rig = rig_around(90.0, distortion=(0.0,) * 5)
    point = np.array([10.0, 5.0, 100.0])
    px = {name: rig.project(name, point) for name in rig.names}
    rays = {name: rig.cameras[name].unproject(px[name]) for name in rig.names}
    assert epipolar_px(rig, "left", "right", rays["left"], rays["right"]) == pytest.approx(0.0, abs=1e-9)
    # One pixel down in one picture: the tip is lifted off the lines of both, half in each, 1/sqrt(2) px to first order
    # for cameras whose lines are nearly horizontal (a few per mille of tilt and of focal length).
    off = rig.cameras["left"].unproject(px["left"] + [0.0, 1.0])
    assert abs(epipolar_px(rig, "left", "right", off, rays["right"])) == pytest.approx(math.sqrt(0.5), rel=0.05)


@pytest.mark.parametrize("delay_s", [0.0, 0.012, -0.03])
def test_a_delay_between_cameras_is_estimated_from_the_motion(delay_s: float) -> None:
    rig, rng = rig_around(90.0, size_px=(1280, 720)), np.random.default_rng(3)
    times = np.arange(300) / 30

    def rays(name: str, at_s: np.ndarray) -> np.ndarray:
        shapes = [Bent(0.8 + 0.4 * math.sin(4.4 * t), 0.3 + 0.3 * math.sin(3.1 * t), 150.0) for t in at_s]
        px = np.array([rig.project(name, shape.at(150.0)) for shape in shapes]) + rng.normal(0, 0.05, (len(at_s), 2))
        return rig.cameras[name].unproject(px)

    found = estimate_offset(rig, "left", "right", times, rays("left", times), rays("right", times - delay_s))
    assert found is not None
    # Four deviations, and the curvature of the motion over the delay (0.2 %).
    assert found.offset_s == pytest.approx(delay_s, abs=4 * found.sd_s + 0.002 * abs(delay_s))
    assert found.sd_s < 0.5e-3


def test_a_tube_at_rest_tells_no_delay() -> None:
    rig = rig_around(90.0)
    ray = {n: np.tile(rig.cameras[n].unproject(rig.project(n, [0.0, 0.0, 120.0])), (100, 1)) for n in rig.names}
    assert estimate_offset(rig, "left", "right", np.arange(100) / 30, ray["left"], ray["right"]) is None
