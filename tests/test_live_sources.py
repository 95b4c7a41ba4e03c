"""Sources behind one protocol: what a text means, damaged pictures, faults by script, all cameras at once."""

import math
import sys
import time
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler
from importlib.metadata import EntryPoint
from itertools import pairwise
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from http_cameras import jpeg, serve, stream
from live_scenes import SIZE, Listed, listed, picture, wanted
from tubesight.core import InputError
from tubesight.sources import opening
from tubesight.sources.buffers import PictureBuffers
from tubesight.sources.clock import ArrivalClock
from tubesight.sources.fault import parse_script
from tubesight.sources.integrity import Wholeness, sampled, wholeness
from tubesight.sources.jpeg import decode_picture
from tubesight.sources.live import LiveCameras
from tubesight.sources.opening import open_source
from tubesight.sources.reader import BrokenPictureError, Picture, Source
from tubesight.sources.usb import UsbSettings, is_device, parse_settings, usb_source
from tubesight.tracking.pairing import PairingRule, Refusal
from tubesight.tracking.watch import CameraFault

RULE = PairingRule(("left", "right"), 0.01)


def numbered(count: int) -> list[Picture | Exception]:
    """Pictures that all differ, a hundredth of a second apart."""
    rng = np.random.default_rng(0)
    return [Picture(rng.integers(0, 255, (64, 64), np.uint8), k / 100) for k in range(count)]


def until(condition: Callable[[], bool], seconds: float = 10.0) -> bool:
    end = time.monotonic() + seconds
    while not condition() and time.monotonic() < end:
        time.sleep(0.005)
    return condition()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("nothing-here", "no such file or folder"),
        ("sim:fast", "expected sim: or sim:HZ"),
        ("sim:0", "expected sim: or sim:HZ"),
        ("fault:drop=0.1", "expected fault:SCRIPT:SOURCE"),
        ("fault:melt=0.1:sim:", "'melt=0.1' is none of"),
        ("fault:drop=2:sim:", "at most 1"),
        ("fault:drop=0.1.2:sim:", "is none of"),
        ("http://", "not an address"),
        ("/dev/video999", "there is no such camera"),
        ("usb:no such thing", "no camera has that name"),
        ("0?shutter=3", "no setting of a camera"),
        ("0?exposure=dark", "settings are numbers"),
        ("0?format=H264", "use MJPG or YUYV"),
    ],
)
def test_what_means_nothing_is_refused_in_one_line(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said) as error:
        open_source(text, wanted("left"))
    assert "\n" not in str(error.value)


def test_settings_of_a_camera_follow_its_name() -> None:
    assert parse_settings("/dev/video2?format=yuyv&fps=60&exposure=100&focus=30") == (
        "/dev/video2",
        UsbSettings("YUYV", 60.0, 100.0, None, 30.0),
    )
    assert is_device("0") and is_device("usb:See3?fps=60") and not is_device("photos") and not is_device("sim:")


def test_a_camera_is_found_by_name_or_serial_number(monkeypatch: pytest.MonkeyPatch) -> None:
    from tubesight.sources import usb
    from tubesight.sources.devices import Device

    node = "/dev/null"
    there = (
        Device(node, "Acme See3", "A17", None, None, True),
        Device("/dev/zero", "Acme See3", None, None, None, True),
    )
    monkeypatch.setattr(usb, "list_devices", lambda: there)
    assert usb_source("usb:A17", wanted("left")).name == node
    with pytest.raises(InputError, match="2 cameras have that name"):
        usb_source("usb:see3", wanted("left"))


def test_other_packages_add_cameras_by_entry_point(monkeypatch: pytest.MonkeyPatch) -> None:
    package = SimpleNamespace(source=lambda text, want: Source(text, lambda: Listed(iter([]))))
    monkeypatch.setitem(sys.modules, "acme_cameras", package)
    points = [
        EntryPoint("acme", "acme_cameras:source", opening.ENTRY_POINTS),
        EntryPoint("gone", "not_installed:source", opening.ENTRY_POINTS),
    ]
    monkeypatch.setattr(opening, "entry_points", lambda group: points)
    assert open_source("acme:17", wanted("left")).name == "acme:17"
    with pytest.raises(InputError, match=r"not_installed .* cannot be loaded"):
        open_source("gone:1", wanted("left"))


def test_a_clock_is_followed_without_the_networks_jitter() -> None:
    rng, clock = np.random.default_rng(0), ArrivalClock()
    # A foreign clock 1000 s off; ways of 5 ms and up to 20 ms more.
    times = [clock.time_s(k / 30, 1000 + k / 30 + 0.005 + 0.02 * rng.random()) for k in range(300)]
    late = np.array([t - 1000 - k / 30 for k, t in enumerate(times)])[30:]
    # The shortest way stays in; it is forgotten by 2e-4 per second at most, 2 ms over ten seconds.
    assert late.min() > 0.0049 and late.max() < 0.0085
    assert clock.time_s(math.nan, 5.0) == 5.0


def test_whole_torn_and_repeated_pixels_are_told_apart() -> None:
    before, after = picture("left", 3), picture("left", 4)
    torn, unfilled = after.copy(), after.copy()
    torn[150:] = before[150:]
    unfilled[150:] = 0
    earlier = [sampled(picture("left", 2)), sampled(before)]
    assert wholeness(sampled(after), earlier) is Wholeness.NEW
    assert wholeness(sampled(before), earlier) is Wholeness.REPEATED
    assert wholeness(sampled(torn), earlier) is Wholeness.TORN
    assert wholeness(sampled(unfilled), earlier) is Wholeness.TORN
    # A buffer that was torn before and is torn again still holds what it held then.
    again = picture("left", 5).copy()
    again[100:] = torn[100:]
    assert wholeness(sampled(again), [*earlier, sampled(torn), sampled(picture("left", 6))]) is Wholeness.TORN
    assert wholeness(sampled(after), []) is Wholeness.NEW
    # A camera whose picture is black or saturated throughout tells nothing.
    black = sampled(np.zeros_like(after))
    assert wholeness(black, [black]) is Wholeness.NEW


@pytest.mark.parametrize("gray", [True, False])
def test_a_picture_stays_while_anybody_looks_at_a_part_of_it(gray: bool) -> None:
    buffers = PictureBuffers()
    data = [cv2.imencode(".jpg", picture("left", k))[1].tobytes() for k in range(4)]
    alone = [decode_picture(each, "left", gray) for each in data]
    kept = decode_picture(data[0], "left", gray, buffers)[10:20, 30:]
    places = set()
    for _ in range(3):
        for k in (1, 2, 3):
            now = decode_picture(data[k], "left", gray, buffers)
            np.testing.assert_array_equal(now, alone[k])
            places.add(now.__array_interface__["data"][0])
    np.testing.assert_array_equal(kept, alone[0][10:20, 30:])
    # The last picture is held until the next one is there: two places beside the one that is kept.
    assert len(places) == 2
    other = buffers.take((7, 5, 3))
    assert other.shape == (7, 5, 3) and buffers.take((7, 5, 3)) is not other


def test_damage_anywhere_in_a_jpeg_is_refused() -> None:
    pytest.importorskip("simplejpeg")
    data = jpeg(picture("left", 0))
    whole = decode_picture(data, "left", gray=True)
    assert whole.shape == SIZE[::-1]
    assert decode_picture(data, "left", gray=False).ndim == 3
    for place in np.linspace(0.1, 0.95, 18):
        at = int(place * len(data))
        for broken in (data[:at], data[:at] + data[at + 400 :]):
            with pytest.raises(BrokenPictureError):
                decode_picture(broken, "left", gray=True)
    with pytest.raises(BrokenPictureError):
        decode_picture(b"", "left", gray=True)


def test_a_script_of_faults_is_read() -> None:
    script = parse_script("drop=0.1,unplug@5+1.5,seed=7")
    assert script.probability == (("drop", 0.1),) and script.spans_s == (("unplug", 5.0, 1.5),) and script.seed == 7


def spoiled(script: str, pictures: list[Picture | Exception]) -> list[Picture]:
    from tubesight.sources.fault import fault_source

    source = fault_source(f"fault:{script}:x", wanted("left"), lambda text, want: listed(pictures))
    reader, got = source.open(), []
    while (one := reader.read()) is not None:
        got.append(one)
    return got


def test_drops_duplicates_and_swaps_happen_as_often_as_said_and_alike_for_a_seed() -> None:
    pictures = numbered(1000)
    kept = spoiled("drop=0.2,seed=1", pictures)
    # Binomial: 800 +- 12.6; five of these.
    assert abs(len(kept) - 800) < 63
    assert [p.time_s for p in kept] == [p.time_s for p in spoiled("drop=0.2,seed=1", pictures)]
    assert [p.time_s for p in kept] != [p.time_s for p in spoiled("drop=0.2,seed=2", pictures)]
    assert abs(len(spoiled("duplicate=0.1", pictures)) - 1100) < 48
    swapped = [p.time_s for p in spoiled("swap=0.1", pictures)]
    assert len(swapped) == 1000 and swapped != sorted(swapped)


@pytest.mark.parametrize(("kind", "state"), [("tear", Wholeness.TORN), ("truncate", Wholeness.TORN)])
def test_torn_and_truncated_pixels_are_told_from_whole_ones(kind: str, state: Wholeness) -> None:
    pictures = numbered(40)
    got = spoiled(f"{kind}=1", pictures)
    assert isinstance(pictures[39], Picture)
    whole = sampled(pictures[39].image)
    for before, shown in pairwise(got[:39]):
        assert wholeness(sampled(shown.image), [sampled(before.image), whole]) is state


def test_blur_and_freeze_change_the_picture() -> None:
    pictures = numbered(10)
    assert isinstance(pictures[0], Picture)
    assert np.std(spoiled("blur=1", pictures)[0].image) < 0.2 * np.std(pictures[0].image)
    frozen = spoiled("freeze=1", pictures)
    assert all(np.array_equal(p.image, frozen[0].image) for p in frozen)


def test_all_cameras_are_read_paired_and_counted() -> None:
    pictures = numbered(50)
    sources = {name: listed(pictures, live=False) for name in ("left", "right")}
    taken = 0
    with LiveCameras(sources, RULE) as cameras:
        while not (cameras.ended and cameras.idle):
            pair = cameras.take(0.05)
            if pair is not None:
                taken += 1
                assert pair.frames["left"].number == pair.frames["right"].number
        counts = cameras.counts()
    for count in counts.values():
        assert count.arrived == 50
        # Every picture was measured or is counted with its reason; the newest counts, so some may be superseded.
        assert taken + sum(count.refused.values()) == 50
        assert set(count.refused) <= {Refusal.SUPERSEDED, Refusal.ALONE}


def test_broken_torn_and_frozen_pictures_are_counted_and_never_paired() -> None:
    pictures = numbered(6)
    first = pictures[0]
    assert isinstance(first, Picture)
    torn = Picture(np.vstack([pictures[1].image[:32], first.image[32:]]), 0.5)  # type: ignore[union-attr]
    given = [first, BrokenPictureError("x"), torn, Picture(first.image, 0.6), pictures[2]]
    with LiveCameras({"left": listed(given)}, PairingRule(("left",), 0.0)) as cameras:
        assert until(lambda: cameras.ended)
        assert cameras.counts()["left"].refused == {
            Refusal.SUPERSEDED: 1,
            Refusal.BROKEN: 1,
            Refusal.TORN: 1,
            Refusal.FROZEN: 1,
        }


def test_a_camera_that_fails_is_flagged_and_opened_anew() -> None:
    failure = InputError("the cable is out")
    pictures = [*numbered(3), failure, *numbered(6)[3:]]
    with LiveCameras({"left": listed(pictures)}, PairingRule(("left",), 0.0)) as cameras:
        assert until(lambda: cameras.watched()["left"].failure == "the cable is out")
        assert cameras.watched()["left"].fault(time.monotonic()) is CameraFault.UNPLUGGED
        # It is tried again after a quarter of a second.
        assert until(lambda: cameras.ended)
        assert cameras.watched()["left"].failure == "" and cameras.counts()["left"].arrived == 6


def test_an_error_of_another_packages_camera_does_not_end_the_session() -> None:
    with LiveCameras({"left": listed([RuntimeError("odd"), *numbered(2)])}, PairingRule(("left",), 0.0)) as cameras:
        assert until(lambda: "RuntimeError: odd" in cameras.watched()["left"].failure)
        assert until(lambda: cameras.ended)


def test_a_network_camera_keeps_its_code_and_its_stamps() -> None:
    data = jpeg(picture("left", 0))

    def respond(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", "multipart/x-mixed-replace; boundary=b")
        handler.end_headers()
        for k in range(3):
            head = (
                f"--b\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\nX-Timestamp: {7 + k / 50}\r\n\r\n"
            )
            handler.wfile.write(head.encode() + data + b"\r\n")
            time.sleep(0.05)

    with serve(respond) as address:
        reader = open_source(f"{address}/x", wanted("left")).open()
        first, second = reader.read(), reader.read()
        reader.close()
    assert first is not None and second is not None
    assert first.coded == data and first.image.shape == SIZE[::-1]
    # The camera says 20 ms, whatever the network took (50 ms here).
    assert second.time_s - first.time_s == pytest.approx(0.02, abs=1e-3)


def test_a_reader_that_falls_behind_takes_the_newest_picture() -> None:
    coded = [jpeg(picture("left", k)) for k in range(6)]
    numbers = iter(range(6))

    def following() -> bytes | None:
        k = next(numbers, None)
        return coded[k] if k is not None else None

    with serve(stream(following, 50.0)) as address:
        reader = open_source(f"{address}/x", wanted("left")).open()
        reader.read()
        time.sleep(0.5)
        after, newest = reader.read(), reader.read()
        reader.close()
    # Five wait: two are passed over each time.
    assert after is not None and after.skipped == 2 and after.coded == coded[3]
    assert newest is not None and newest.skipped == 1 and newest.coded == coded[5]


def test_videos_and_folders_are_cameras(tmp_path: Path) -> None:
    (tmp_path / "stills").mkdir()
    writer = cv2.VideoWriter(str(tmp_path / "v.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 25.0, SIZE)
    for k in range(4):
        shown = cv2.cvtColor(picture("left", k), cv2.COLOR_GRAY2BGR)
        writer.write(shown)
        cv2.imwrite(str(tmp_path / "stills" / f"{k}.png"), shown)
    writer.release()
    for place in ("v.avi", "stills"):
        source = open_source(str(tmp_path / place), wanted("left"))
        reader, got = source.open(), []
        while (one := reader.read()) is not None:
            got.append(one)
        reader.close()
        assert not source.live and len(got) == 4 and got[0].image.shape == SIZE[::-1]
        assert [p.time_s for p in got] == pytest.approx([0.0, 0.04, 0.08, 0.12], abs=1e-6) or place == "stills"


def test_a_file_that_is_no_video_is_refused(tmp_path: Path) -> None:
    (tmp_path / "v.mp4").write_bytes(b"nothing")
    with pytest.raises(InputError, match=r"v\.mp4"):
        open_source(str(tmp_path / "v.mp4"), wanted("left")).open().read()
    (tmp_path / "notes.txt").write_text("x")
    with pytest.raises(InputError, match="neither a video nor a folder"):
        open_source(str(tmp_path / "notes.txt"), wanted("left"))
