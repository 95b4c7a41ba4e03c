"""What people change while a session runs, and recordings looked at again."""

from __future__ import annotations

import json
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from live_scenes import SIZE
from tubesight.apps.live.loop import Moment
from tubesight.apps.live.options import LiveOptions, RecordOptions, set_up
from tubesight.apps.live.replay import replay_file, sensor_of
from tubesight.apps.live.session import run_session
from tubesight.apps.live.steering import Steering, steering_of
from tubesight.apps.switch import SensorSwitch
from tubesight.cli.main import main
from tubesight.core import InputError, Status
from tubesight.files.recording import RecordedResult, Recording
from tubesight.geometry.curve import Arc, NodeCurve
from tubesight.geometry.shape import shape_of
from tubesight.outputs.moments import moment_data
from tubesight.outputs.rows import CURVE_POINTS, deviation_mm
from tubesight.sensor import Reconstruction
from tubesight.tracking.states import State
from tubesight.tracking.tracker import Tracked

pytest.importorskip("mcap")
pytest.importorskip("viser")

from tubesight.apps.viewer.controls import RecordingFolder
from tubesight.apps.viewer.guard import open_server
from tubesight.apps.viewer.play import AS_RECORDED, Player
from tubesight.apps.viewer.reels import RecordingReel, recorded_result

SIM = {"left": "sim:", "right": "sim:"}
Act = Callable[[Steering], object]


def session(count: int, acts: dict[int, Act], record: RecordOptions | None = None, measuring: bool = True) -> Any:
    """Run simulated cameras for so many moments, and do something after the n-th; figures and moments."""
    given = LiveOptions(SIM, size_px=SIZE, gray=True, seconds=60.0, record=record)
    setup = set_up(given)
    steering = steering_of(given, setup)
    moments: list[Moment] = []

    def tell(moment: Moment) -> None:
        moments.append(moment)
        if len(moments) in acts:
            acts[len(moments)](steering)
        if len(moments) == count:
            # As Ctrl-C does.
            raise KeyboardInterrupt

    return run_session(given, setup, tell, measuring=measuring, steering=steering), moments


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "session.mcap"
    session(20, {}, RecordOptions(path))
    return path


def test_another_method_measures_from_the_next_pair_on_and_is_replayed_to_the_last_bit(tmp_path: Path) -> None:
    path = tmp_path / "switched.mcap"
    mark = np.array([SIZE[0] / 2, 40.0])
    acts: dict[int, Act] = {5: lambda s: s.switch.use("cone_ray"), 10: lambda s: s.switch.mark("left", mark)}
    _, moments = session(15, acts, RecordOptions(path))
    methods = [m.tracked.result.method for m in moments if m.tracked.result is not None]
    assert methods == ["silhouette"] * 5 + ["cone_ray"] * 10
    done = replay_file(path)
    assert done.equal == done.compared == len(methods), done.differences
    # Another method than the recorded ones replaces them all.
    assert replay_file(path, None, "triangulate").equal == 0


def test_what_was_marked_is_in_the_recording(tmp_path: Path) -> None:
    path = tmp_path / "marked.mcap"
    place = {name: np.array([SIZE[0] / 2, 30.0]) for name in ("left", "right")}
    acts: dict[int, Act] = {3: lambda s: [s.switch.mark(name, px) for name, px in place.items()]}
    session(8, acts, RecordOptions(path))
    assert replay_file(path).differences == ()


def test_a_switch_hands_over_between_two_pairs_only() -> None:
    prepared, changed = [], []
    given = LiveOptions(SIM, size_px=SIZE)
    sensor = set_up(given).sensor()
    switch = SensorSwitch(sensor, prepared.append, lambda: changed.append(1))
    switch.use("cone_ray")
    assert switch.current is sensor and [s.method for s in prepared] == ["cone_ray"]
    assert switch.adopt() and switch.current.method == "cone_ray" and not switch.adopt()
    switch.mark("left", np.zeros(2))
    switch.use("silhouette")
    assert switch.adopt() and set(switch.current.base_px) == {"left"} and changed == [1, 1, 1]
    with pytest.raises(ValueError, match="expected one of"):
        switch.use("guess")


def test_recordings_begin_and_end_while_cameras_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    said: list[str] = []

    def again(steering: Steering) -> None:
        assert not steering.recording.running
        with pytest.raises(InputError, match="is there already"):
            steering.recording.start_named("first", "none")
        steering.recording.start_named("second.mcap", "none")
        with pytest.raises(InputError, match="is running already"):
            steering.recording.start_named("third", "none")

    acts: dict[int, Act] = {
        3: lambda s: s.recording.start_named("first", "lossless"),
        9: lambda s: (s.recording.stop(), said.append(s.recording.words())),
        12: again,
    }
    figures, _ = session(20, acts)
    results = [e for e in Recording(Path("first.mcap")).entries() if isinstance(e, RecordedResult)]
    assert len(results) == 6 and replay_file(Path("first.mcap")).equal == 6
    assert said[0].startswith(f"recorded: {tmp_path / 'first.mcap'}: 6 results, 12 pictures")
    # The session's figures are those of the last recording, which its end ended.
    assert figures.recorded["results"] == 8 and not Path("third.mcap").exists()


@pytest.mark.parametrize("name", ["", " ", "..", "../out", "a/b", "/tmp/x", "a\\b", ".", "x\0y"])
def test_a_name_from_the_page_is_no_place(tmp_path: Path, name: str) -> None:
    given = LiveOptions(SIM, size_px=SIZE, record=RecordOptions(tmp_path / "in" / "a.mcap"))
    recording = steering_of(given, set_up(given)).recording
    with pytest.raises(InputError):
        recording.start_named(name, "none")
    assert list(tmp_path.iterdir()) == [] and not recording.running and recording.state() == {}


def test_the_page_says_what_is_recorded_and_what_went_wrong(tmp_path: Path) -> None:
    given = LiveOptions(SIM, size_px=SIZE, record=RecordOptions(tmp_path / "a.mcap"))
    recording = steering_of(given, set_up(given)).recording
    server = open_server(0)
    try:
        folder = RecordingFolder(server.gui, recording, 0.0)
        assert str(tmp_path) in folder._said.content and folder._button.label == "start recording"
        folder._name.value = "<b>.mcap"
        folder._pressed()
        assert recording.running and folder._button.label == "stop recording" and folder._name.disabled
        assert folder._name.value == "<b>.mcap"
        assert "&lt;b&gt;.mcap" in folder._said.content
        folder._pressed()
        assert not recording.running and "recorded: " in folder._said.content and not folder._name.disabled
        folder._name.value = "<b>.mcap"
        folder._pressed()
        assert (
            not recording.running and "is there already" in folder._said.content and "#d0463b" in folder._said.content
        )
    finally:
        server.stop()


# Recordings, looked at again


@given(st.floats(0.0005, 0.02), st.floats(-3, 3), st.floats(30, 200), st.floats(0, 2))
def test_a_recorded_result_is_the_result(bend: float, way: float, length: float, sd: float) -> None:
    arc = Arc(bend * np.array([np.cos(way), np.sin(way)]), length)
    s = np.linspace(0, length, 65)
    points, tangents = arc.at(s), arc.tangent(s)
    aside = NodeCurve("circle", s, points + np.array([0.0, sd, 0.0]), tangents)
    curve = NodeCurve("circle", s, points, tangents, (aside,))
    shape = shape_of(curve, 0.1)
    result = Reconstruction("7", Status.OK, ("a note", "another"), shape, curve, {}, "silhouette", 0.05, {"solve": 0.3})
    data = json.loads(json.dumps(moment_data(Tracked(result, State.TRACKING, 1.0))))
    again = recorded_result(data)
    assert again.shape is not None and again.curve is not None
    assert (again.frame, again.status, again.notes, again.method) == ("7", Status.OK, result.notes, "silhouette")
    np.testing.assert_array_equal(again.shape.tip_mm, shape.tip_mm)
    # Through degrees and back: a few roundings.
    for name in ("bending_rad", "length_mm", "curvature_per_mm"):
        assert getattr(again.shape, name) == pytest.approx(getattr(shape, name), rel=1e-14)
    assert dict(again.shape.sd) == pytest.approx(dict(shape.sd), rel=1e-12, nan_ok=True)
    share = np.linspace(0, 1, CURVE_POINTS)
    np.testing.assert_allclose(again.curve.at(share * length), curve.at(share * length), atol=1e-9)
    # Unit vectors across, at the very nodes: rounding of places of 200 mm alone.
    np.testing.assert_allclose(deviation_mm(again.curve, share), deviation_mm(curve, share), atol=1e-9)


def test_a_recorded_failure_has_no_numbers() -> None:
    failed = Reconstruction("7", Status.TIP_NOT_FOUND, ("left: nothing round",), None, None, {}, "cone_ray")
    again = recorded_result(moment_data(Tracked(failed, State.LOST, 1.0)))
    assert not again and again.status is Status.TIP_NOT_FOUND and again.shape is None and again.notes == failed.notes
    silent = recorded_result(moment_data(Tracked(None, State.FAULT, 1.0, notes=("left sends nothing",))))
    assert silent.shape is None and silent.notes == ("left sends nothing",)


def test_a_recording_is_shown_as_it_was_and_measured_again(recorded: Path) -> None:
    recording = Recording(recorded)
    reel, sensor = RecordingReel(recording), sensor_of(recording)
    entries = [e.data for e in recording.entries() if isinstance(e, RecordedResult)]
    assert len(reel) == len(entries) and reel.measured and reel.hz == pytest.approx(30, rel=0.5)
    with closing(reel):
        for k in (len(reel) - 1, 0, 3):
            then, now = reel.show(k, sensor, False), reel.show(k, sensor, True)
            assert then.result.shape is not None and now.result.shape is not None and then.pair is not None
            assert then.time_s == entries[k]["time_s"] and then.remarks.startswith("as recorded")
            np.testing.assert_array_equal(then.result.shape.tip_mm, now.result.shape.tip_mm)
            assert {name: image.shape for name, image in then.pair.images.items()} == dict.fromkeys(
                ("left", "right"), SIZE[::-1]
            )


def test_results_alone_and_pictures_alone_are_shown(tmp_path: Path) -> None:
    session(5, {}, RecordOptions(tmp_path / "results.mcap", "none"))
    recording = Recording(tmp_path / "results.mcap")
    sensor = sensor_of(recording)
    with closing(RecordingReel(recording)) as reel:
        then, now = reel.show(0, sensor, False), reel.show(0, sensor, True)
    assert then.result and then.pair is None and "no pictures" in then.remarks
    assert now.result.status is Status.BAD_IMAGE and "no pictures" in now.result.notes[0]
    session(5, {}, RecordOptions(tmp_path / "pictures.mcap"), measuring=False)
    with closing(RecordingReel(Recording(tmp_path / "pictures.mcap"))) as reel:
        assert not reel.measured and reel.show(1, sensor, True).result


def test_the_player_goes_through_a_recording_and_back_to_what_was_recorded(recorded: Path) -> None:
    recording = Recording(recorded)
    sensor = sensor_of(recording)
    player = Player(RecordingReel(recording), sensor, 0, again=False)
    told: list[tuple[str, float]] = []
    publish = player.viewer.publish

    def keep(result: Reconstruction, pair: Any, time_s: float, remarks: str) -> None:
        told.append((remarks, time_s))
        if len(told) == 2:
            player._use("cone_ray")
        if len(told) == 4:
            player._use(AS_RECORDED)
        publish(result, pair, time_s, remarks)

    player.viewer.publish = keep  # type: ignore[method-assign, assignment]
    player.run(6)
    assert ["as recorded" in remarks for remarks, _ in told] == [True, True, False, False, True, True]
    assert "cone_ray" in told[2][0] and [t for _, t in told] == sorted(t for _, t in told)


def leave(args: list[str]) -> int:
    with pytest.raises(SystemExit) as left:
        main(args)
    return int(left.value.code or 0)


def test_view_takes_recordings(recorded: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shown = ["--port", "0", "--pairs", "2"]
    assert leave(["view", str(recorded), *shown]) == 0
    assert leave(["view", str(recorded), *shown, "--method", "cone_ray"]) == 0
    assert "open http://127.0.0.1:" in capsys.readouterr().err
    assert leave(["view", str(recorded), *shown, "--rig", "rig.yaml"]) == 2
    assert leave(["view", str(tmp_path), *shown]) == 2
    capsys.readouterr()
    assert leave(["view", str(tmp_path / "missing.mcap"), *shown]) == 1
    assert leave(["view", str(tmp_path / "missing"), *shown, "--rig", str(tmp_path / "rig.yaml")]) == 1
    assert capsys.readouterr().err.count("error: ") == 2
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(recorded.read_bytes()[:-50_000])
    capsys.readouterr()
    assert leave(["view", str(cut), *shown]) == 1
    assert "tubesight recover" in capsys.readouterr().err
    assert leave(["recover", str(cut), "-o", str(tmp_path / "whole.mcap")]) == 0
    assert leave(["view", str(tmp_path / "whole.mcap"), *shown]) == 0


def test_a_damaged_recording_is_one_line(recorded: Path, tmp_path: Path) -> None:
    """Bytes in the middle of the file are turned over: what cannot be read is said, whatever it is."""
    data = bytearray(recorded.read_bytes())
    for place in range(len(data) // 3, len(data) // 3 + 200_000, 997):
        data[place] ^= 0x5A
    path = tmp_path / "damaged.mcap"
    path.write_bytes(data)
    recording = Recording(path)
    with pytest.raises(InputError, match="tubesight recover"):
        RecordingReel(recording)
