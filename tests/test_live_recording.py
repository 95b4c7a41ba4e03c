"""Recording, replay to the last bit, recovery and export; what a full disk and a kill leave behind."""

import csv
import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import MappingProxyType
from typing import Any

import cv2
import numpy as np
import pytest

from http_cameras import jpeg
from live_scenes import SIZE, configuration, measured_moments, picture, record, wanted
from tubesight.apps.live.export import FORMATS, export
from tubesight.apps.live.recover import recover
from tubesight.apps.live.replay import replay, replay_file, sensor_of
from tubesight.core import Frame, InputError
from tubesight.files.recording import (
    RecordedPicture,
    RecordedResult,
    Recording,
    coded_image,
    decoded_image,
    read_messages,
)
from tubesight.files.tables import read_curves, read_shapes
from tubesight.outputs import mcap_file
from tubesight.outputs.mcap_file import McapFile
from tubesight.outputs.publish import Mailbox
from tubesight.outputs.recorder import Recorder
from tubesight.sources.opening import open_source
from tubesight.tracking.pairing import Matched
from tubesight.tracking.tracker import Tracked, Tracker
from tubesight.tracking.watch import CameraFault

pytest.importorskip("mcap")
PAIRS = 6


@pytest.fixture(scope="module")
def session() -> list[Tracked]:
    """Six pairs measured, a fault, and its end."""
    tracker = Tracker(filtered=True)
    moments = measured_moments(PAIRS, tracker)
    fault = tracker.watch({"left": CameraFault.FROZEN}, 101.0)
    back = tracker.watch({}, 102.0)
    assert fault is not None and back is not None
    return [*moments, fault, back]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory, session: list[Tracked]) -> Path:
    path = tmp_path_factory.mktemp("recording") / "session.mcap"
    with pytest.MonkeyPatch.context() as patch:
        # A chunk a message, as in a long session, where each takes a third of a second.
        patch.setattr(mcap_file, "FLUSH_S", 0.0)
        state = record(path, session)
    assert state["results"] == PAIRS + 2 and state["pictures"] == 2 * PAIRS and "stopped" not in state
    return path


def test_replay_gives_the_same_numbers_to_their_last_bit(recorded: Path, tmp_path: Path) -> None:
    done = replay_file(recorded, tmp_path / "out")
    assert (done.pairs, done.compared, done.equal, done.without_pictures, done.exact) == (PAIRS, PAIRS, PAIRS, 0, True)
    assert len(read_shapes(tmp_path / "out" / "shapes.csv")) == PAIRS


def test_replay_finds_a_difference_of_one_bit(recorded: Path, tmp_path: Path) -> None:
    changed = tmp_path / "changed.mcap"
    with McapFile(changed) as file:
        for message in read_messages(recorded):
            data = message.data
            if message.topic.endswith("result") and b'"frame":"3"' in data:
                moment = json.loads(data)
                moment["row"]["tip_x_mm"] = math.nextafter(moment["row"]["tip_x_mm"], math.inf)
                data = json.dumps(moment).encode()
            file.write(message.topic, message.time_ns, message.number, data)
    done = replay_file(changed)
    assert done.equal == PAIRS - 1 and "pair 3: tip_x_mm was" in done.differences[0]


def test_thinned_and_coded_recordings_say_what_they_are(session: list[Tracked], tmp_path: Path) -> None:
    record(tmp_path / "thin.mcap", session, every=2)
    thin = replay_file(tmp_path / "thin.mcap")
    assert (thin.pairs, thin.equal, thin.without_pictures) == (3, 3, 3)
    record(tmp_path / "jpeg.mcap", session, "jpeg")
    assert not replay_file(tmp_path / "jpeg.mcap").exact
    record(tmp_path / "none.mcap", session, "none")
    with pytest.raises(InputError, match="holds no pictures"):
        replay_file(tmp_path / "none.mcap")
    record(tmp_path / "crop.mcap", session, "crop")
    with pytest.raises(InputError, match="crops"):
        replay_file(tmp_path / "crop.mcap")
    sizes = [(tmp_path / f"{name}.mcap").stat().st_size for name in ("none", "jpeg", "crop")]
    assert sizes[0] < min(sizes[1:]) and max(sizes) < 6 * 2 * SIZE[0] * SIZE[1] / 2


def test_pictures_keep_the_code_of_their_camera(session: list[Tracked], tmp_path: Path) -> None:
    data = jpeg(picture("left", 0))
    frames = {n: Frame(n, picture(n, 0), 1.0, 5, data) for n in ("left", "right")}
    pair = Matched(MappingProxyType(frames), 1.0, 0.0)
    record(tmp_path / "coded.mcap", [Tracked(None, session[0].state, 1.0, pair=pair)])
    pictures = [e for e in Recording(tmp_path / "coded.mcap").entries() if isinstance(e, RecordedPicture)]
    assert [(p.camera, p.number, p.format, p.data) for p in pictures] == [
        ("left", 5, "jpeg", data),
        ("right", 5, "jpeg", data),
    ]


def test_a_recording_is_an_mcap_file_that_others_read(recorded: Path) -> None:
    from mcap.reader import make_reader

    with recorded.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert summary is not None and summary.statistics is not None
        assert summary.statistics.message_count == 1 + 2 * PAIRS + PAIRS + 2
        topics = {channel.topic: channel.message_encoding for channel in summary.channels.values()}
    assert topics == {
        "/tubesight/configuration": "json",
        "/tubesight/result": "json",
        "/camera/left": "cdr",
        "/camera/right": "cdr",
    }


def test_pictures_are_the_messages_of_ros_2() -> None:
    decoder = pytest.importorskip("mcap_ros2.decoder").DecoderFactory()
    from mcap.records import Schema

    from tubesight.files.recording import IMAGE_SCHEMA

    schema = Schema(id=1, name="sensor_msgs/msg/CompressedImage", encoding="ros2msg", data=IMAGE_SCHEMA.encode())
    decode = decoder.decoder_for("cdr", schema)
    for name in ("a", "left", "camera 3"):
        message = coded_image(1_700_000_000_123_456_789, name, "jpeg", b"\x01\x02\x03")
        image = decode(message)
        assert (image.header.stamp.sec, image.header.stamp.nanosec) == (1_700_000_000, 123_456_789)
        assert (image.header.frame_id, image.format, bytes(image.data)) == (name, "jpeg", b"\x01\x02\x03")
        assert decoded_image(message) == ("jpeg", b"\x01\x02\x03")


@pytest.mark.parametrize("share", [0.999, 0.7, 0.31])
def test_a_file_that_is_cut_off_is_read_to_its_last_whole_chunk(recorded: Path, tmp_path: Path, share: float) -> None:
    data = recorded.read_bytes()
    cut, whole = tmp_path / "cut.mcap", tmp_path / "whole.mcap"
    cut.write_bytes(data[: int(len(data) * share)])
    found = recover(cut, whole)
    kept = [e for e in Recording(cut).entries() if isinstance(e, RecordedResult)]
    assert len(kept) == found.results > 0
    assert list(read_messages(whole)) and replay_file(whole).equal == sum("row" in e.data for e in kept)


def test_a_damaged_chunk_ends_the_reading_and_is_not_believed(recorded: Path, tmp_path: Path) -> None:
    data = bytearray(recorded.read_bytes())
    data[len(data) // 2] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(data)
    results = [e for e in Recording(tmp_path / "damaged.mcap").entries() if isinstance(e, RecordedResult)]
    assert 0 < len(results) < PAIRS + 2


def test_what_is_no_recording_is_refused(tmp_path: Path, recorded: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"no")
    (tmp_path / "b.mcap").write_bytes(recorded.read_bytes()[:60])
    for name, said in (("a", "not a recording"), ("b", "cut off before"), ("c", "no such file")):
        with pytest.raises(InputError, match=said):
            Recording(tmp_path / f"{name}.mcap")
    with pytest.raises(InputError, match="is there already"):
        McapFile(recorded)
    with pytest.raises(InputError, match="is the recording itself"):
        recover(recorded, recorded)
    with McapFile(tmp_path / "other.mcap") as file:
        file.write("/tubesight/configuration", 0, 0, b'{"format": "tubesight-recording/9"}')
    with pytest.raises(InputError, match="read it with the version"):
        Recording(tmp_path / "other.mcap")


def test_a_configuration_that_is_damaged_is_refused(tmp_path: Path) -> None:
    for name, broken in (
        ("rig", "x: ["),
        ("tube", 3),
        ("base_px", None),
        ("method", "none"),
        ("backgrounds", {"u": 1}),
    ):
        path = tmp_path / f"{name}.mcap"
        with McapFile(path) as file:
            data = json.dumps({**configuration(), name: broken}).encode()
            file.write("/tubesight/configuration", 0, 0, data)
        with pytest.raises(InputError, match=name):
            sensor_of(Recording(path))


def test_a_full_disk_stops_the_recording_alone(
    session: list[Tracked], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A disk with 300 kB left: the recorder says so, and what is on it is whole."""
    resource = pytest.importorskip("resource")
    monkeypatch.setattr(mcap_file, "FLUSH_S", 0.0)
    file = McapFile(tmp_path / "full.mcap")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (300_000, before[1]))
    try:
        recorder = Recorder(file, configuration(), "lossless")
        for _ in range(4):
            for moment in session:
                recorder.publish(moment)
        recorder.close()
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)
    state = recorder.state()
    assert "the disk takes no more" in state["stopped"]
    recorder.publish(session[0])
    assert recorder.state()["results_left_out"] > 0
    assert os.path.getsize(tmp_path / "full.mcap") <= 300_000
    assert any(isinstance(e, RecordedResult) for e in Recording(tmp_path / "full.mcap").entries())


def test_a_disk_that_is_full_from_the_start_is_refused_in_one_line(tmp_path: Path) -> None:
    resource = pytest.importorskip("resource")
    file = McapFile(tmp_path / "full.mcap")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    ignored = signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
    resource.setrlimit(resource.RLIMIT_FSIZE, (200, before[1]))
    try:
        with pytest.raises(InputError, match=r"full\.mcap: cannot be written"):
            Recorder(file, configuration(), "lossless")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
        signal.signal(signal.SIGXFSZ, ignored)


def test_a_process_that_is_killed_loses_a_second_at_most(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    script = f"""
import sys, time
sys.path[:0] = {sys.path!r}
from pathlib import Path
from tubesight.outputs.mcap_file import McapFile
from tubesight.outputs.recorder import Recorder
from tubesight.tracking.states import State
from tubesight.tracking.tracker import Tracked
recorder = Recorder(McapFile(Path({str(path)!r})), {{"format": "tubesight-recording/1"}}, "none")
print("ready", flush=True)
while True:
    recorder.publish(Tracked(None, State.SEARCHING, time.monotonic()))
    time.sleep(0.005)
"""
    process = subprocess.Popen([sys.executable, "-c", script], stdout=subprocess.PIPE)
    assert process.stdout is not None and process.stdout.readline() == b"ready\n"
    time.sleep(1.5)
    killed_s = time.monotonic()
    process.kill()
    process.wait()
    process.stdout.close()
    times = [e.data["time_s"] for e in Recording(path).entries() if isinstance(e, RecordedResult)]
    # Both processes read the same monotonic clock.
    assert len(times) > 20 and killed_s - times[-1] < 1.0


def test_every_format_is_exported(recorded: Path, tmp_path: Path) -> None:
    for form in FORMATS:
        export(recorded, form, tmp_path / form)
    rows = read_shapes(tmp_path / "csv")
    assert len(rows) == PAIRS and rows[0].time_s == 0.0 and rows[5].time_s == pytest.approx(5 / 30, rel=1e-5)
    curves = read_curves(tmp_path / "npz")
    assert curves.xyz_mm.shape == (PAIRS, 101, 3)
    tip = [rows[2].tip_x_mm, rows[2].tip_y_mm, rows[2].tip_z_mm]
    assert curves.xyz_mm[2, -1] == pytest.approx(tip, abs=1e-4)
    parquet = pytest.importorskip("pyarrow.parquet").read_table(tmp_path / "parquet").to_pydict()
    assert parquet["tip_x_mm"][2] == pytest.approx(tip[0], rel=1e-6) and parquet["state"][0] == "tracking"
    lines = (tmp_path / "vtk" / "curve_2.vtk").read_text().splitlines()
    assert lines[4] == "POINTS 101 double" and np.fromstring(lines[105], sep=" ") == pytest.approx(tip, abs=1e-4)
    assert len(json.loads((tmp_path / "vtk" / "curves.vtk.series").read_text())["files"]) == PAIRS
    with (tmp_path / "csv").open() as stream:
        assert next(csv.reader(stream))[0] == "frame"


def test_a_ros_bag_holds_standard_messages_in_metres(recorded: Path, tmp_path: Path) -> None:
    read = pytest.importorskip("mcap_ros2.reader").read_ros2_messages
    export(recorded, "ros2", tmp_path / "bag")
    messages: dict[str, list[Any]] = {}
    for message in read(str(tmp_path / "bag" / "bag_0.mcap")):
        messages.setdefault(message.channel.topic, []).append(message.ros_msg)
    assert {topic: len(found) for topic, found in messages.items()} == {
        "/camera/left/compressed": PAIRS,
        "/camera/right/compressed": PAIRS,
        "/tubesight/status": PAIRS + 2,
        "/tubesight/tip": PAIRS,
        "/tubesight/centreline": PAIRS,
    }
    image = cv2.imdecode(np.frombuffer(messages["/camera/left/compressed"][0].data, np.uint8), cv2.IMREAD_UNCHANGED)
    assert np.array_equal(image, picture("left", 0))
    pose = messages["/tubesight/tip"][3].pose.pose
    first = messages["/tubesight/centreline"][3].poses[0].pose
    export(recorded, "npz", tmp_path / "npz")
    curve = read_curves(tmp_path / "npz").xyz_mm[3]
    assert [pose.position.x, pose.position.y, pose.position.z] == pytest.approx(curve[-1] / 1e3, abs=1e-9)
    # At the clamp the tube runs along +z: no turn; the first chord of 1.5 mm is off by half its bend.
    assert first.orientation.w == pytest.approx(1.0, abs=1e-4)
    # Turned by the pose, +z is the tube's direction.
    x, y, w = pose.orientation.x, pose.orientation.y, pose.orientation.w
    along = np.array([2 * x * 0 + 2 * y * w, 2 * y * 0 - 2 * x * w, 1 - 2 * (x * x + y * y)])
    chord = (curve[-1] - curve[-2]) / np.linalg.norm(curve[-1] - curve[-2])
    assert along == pytest.approx(chord, abs=1e-6)
    assert "storage_identifier: mcap" in (tmp_path / "bag" / "metadata.yaml").read_text()


def test_a_recording_is_a_source_of_pictures(recorded: Path, session: list[Tracked], tmp_path: Path) -> None:
    source = open_source(str(recorded), wanted("right"))
    reader, got = source.open(), []
    while (one := reader.read()) is not None:
        got.append(one)
    reader.close()
    assert not source.live and all(np.array_equal(p.image, picture("right", k)) for k, p in enumerate(got))
    # The right camera's pictures were taken 1 ms after the left one's; times in the file are whole nanoseconds.
    assert [p.time_s for p in got] == pytest.approx([0.001 + k / 30 for k in range(PAIRS)], abs=2e-9)
    record(tmp_path / "none.mcap", session, "none")
    with pytest.raises(InputError, match="holds no pictures"):
        open_source(str(tmp_path / "none.mcap"), wanted("right"))


def test_a_mailbox_keeps_the_newest_and_never_blocks(session: list[Tracked]) -> None:
    box = Mailbox()
    for moment in session:
        box.publish(moment)
    assert box.take(0.0) is session[-1] and box.take(0.0) is None
    box.close()
    assert box.take(5.0) is None


def test_another_method_can_be_tried_on_a_recording(recorded: Path) -> None:
    done = replay(Recording(recorded), sensor_of(Recording(recorded)))
    assert done.equal == PAIRS
    assert replay_file(recorded, method="cone_ray").equal < PAIRS
