"""Capture: pairs that are worth keeping, from every kind of source, and cameras that fail."""

import json
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from http.server import BaseHTTPRequestHandler
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from http_cameras import jpeg, serve, stream
from tubesight.apps import capture as app
from tubesight.apps.capture import CaptureOptions, State, capture
from tubesight.calibration.look import Collection, Look, is_still, look_at
from tubesight.cli.main import main
from tubesight.core import Board, FramePair, InputError
from tubesight.files.dataset import list_pairs
from tubesight.files.images import read_image
from tubesight.simulate import board_views, render_board_pair, rig_around
from tubesight.simulate.scene import Scene
from tubesight.sources.camera import LiveFeed, close_feeds, instants, open_feeds
from tubesight.sources.http import HttpPictures

BOARD = Board("chessboard", (10, 7), 13.0)
SIZE = (640, 360)


@pytest.fixture(scope="module")
def board_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("board") / "board.yaml"
    path.write_text("type: chessboard\nsquares: [10, 7]\nsquare_mm: 13.0\n", encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def boards() -> list[FramePair]:
    """A board at eight places before two cameras."""
    rig = rig_around(90.0, size_px=SIZE)
    poses = board_views(rig, BOARD, 8, np.random.default_rng(1))
    return [render_board_pair(rig, BOARD, pose, name=str(i)) for i, pose in enumerate(poses)]


def run(*args: str | Path) -> int:
    with pytest.raises(SystemExit) as left:
        main([str(arg) for arg in args])
    return int(left.value.code or 0)


# --- what a picture shows ---


@pytest.mark.parametrize("sigma", [0.6, 1.0, 2.0])
def test_blur_is_measured(sigma: float) -> None:
    rig = rig_around(90.0, size_px=(1280, 720))
    (pose,) = board_views(rig, BOARD, 1, np.random.default_rng(1))
    scene = Scene(blur_px=sigma, noise_levels=0.0)
    image = render_board_pair(rig, BOARD, pose, scene).images["left"]
    look = look_at(image, BOARD)
    # A square pixel blurs by sqrt(1 / 12) and bilinear sampling by up to as much; gray levels rise with the root of the
    # light, which makes edges seem up to a quarter narrower or wider.
    expected = np.hypot(sigma, np.sqrt(2 / 12))
    assert look.blur_px == pytest.approx(expected, rel=0.3)
    assert look.sharp == (sigma < 2)


def test_no_board_is_no_look() -> None:
    look = look_at(np.full((360, 640, 3), 90, np.uint8), BOARD)
    assert look.corners is None and not look.sharp


def test_stillness_scales_with_time_and_picture() -> None:
    # 10 px a second in a picture 1920 wide.
    assert is_still(1.9, 0.2, 1920) and not is_still(2.1, 0.2, 1920)
    assert not is_still(1.9, 0.2, 960)
    assert is_still(1.1, float("nan"), 1920) and not is_still(1.3, float("nan"), 1920)


def test_a_pair_has_to_add_something(boards: list[FramePair]) -> None:
    looks = [{n: look_at(image, BOARD) for n, image in pair.images.items()} for pair in boards[:2]]
    collection = Collection(("left", "right"), 4)
    assert collection.adds(looks[0])
    collection.add(looks[0])
    assert not collection.adds(looks[0]), "the same pair again"
    assert collection.adds(looks[1])
    assert "tilt the board" in collection.lacking()[0]
    nothing = Look(None, SIZE)
    assert nothing.cells.sum() == 0


# --- sources ---


def test_simulated_cameras_fill_a_data_set(
    board_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    sources = ("--source", "left=sim:", "--source", "right=sim:", "--size", "640x360")
    code = run("capture", *sources, "--board", board_file, "-o", tmp_path / "set", "--pairs", "6", "--json")
    result = json.loads(capsys.readouterr().out)
    assert code == 0 and result["verdict"]["level"] in ("enough", "usable")
    pairs = list_pairs(tmp_path / "set", ("left", "right"))
    assert 6 <= len(pairs) == result["pairs"] <= 12
    for name in ("left", "right"):
        assert 0.1 < result["cameras"][name]["covered"] <= 1 and result["cameras"][name]["turned_deg"] > 25
    assert read_image(pairs[0][1]["left"]).shape == (360, 640, 3)


def test_two_cameras_over_http(board_file: Path, boards: list[FramePair], tmp_path: Path) -> None:
    """The board rests for half a second at each place; between them the cameras show nothing of it."""
    encoded = [{n: jpeg(image) for n, image in pair.images.items()} for pair in boards]
    empty = jpeg(np.full((SIZE[1], SIZE[0], 3), 90, np.uint8))
    started = time.monotonic()

    def shown(camera: str) -> Callable[[], bytes | None]:
        def picture() -> bytes | None:
            step, part = divmod(time.monotonic() - started, 1.0)
            return encoded[int(step) % len(encoded)][camera] if part < 0.8 else empty

        return picture

    states: list[State] = []
    with ExitStack() as stack:
        left = stack.enter_context(serve(stream(shown("left"), 25.0)))
        right = stack.enter_context(serve(stream(shown("right"), 20.0, with_length=False)))
        sources = {"left": f"{left}/left.mjpg", "right": f"{right}/right.mjpg"}
        options = CaptureOptions(sources, board_file, tmp_path / "set", pairs=4, seconds=8.0)
        captured = capture(options, states.append)
    pairs = list_pairs(tmp_path / "set", ("left", "right"))
    assert len(pairs) == len(captured.collection) >= 3
    assert {"no board" in s.word for s in states} == {True, False}
    for _, paths in pairs:
        # Both pictures are of one of the eight instants: JPEG at quality 95 leaves less than 3 gray levels on average,
        # another place of the board over 10.
        off = [
            max(float(np.abs(read_image(paths[n]).astype(float) - pair.images[n]).mean()) for n in paths)
            for pair in boards
        ]
        assert min(off) < 3


def test_camera_that_gives_single_pictures(boards: list[FramePair]) -> None:
    data = jpeg(boards[0].images["left"])

    def respond(handler: BaseHTTPRequestHandler) -> None:
        handler.send_response(200)
        handler.send_header("Content-Type", "image/jpeg")
        handler.end_headers()
        handler.wfile.write(data)

    with serve(respond) as address:
        pictures = HttpPictures(address, 5.0)
        assert pictures.read() == data and pictures.read() == data
        pictures.close()


def test_videos_and_folders(board_file: Path, boards: list[FramePair], tmp_path: Path) -> None:
    for name in ("left", "right"):
        video = cv2.VideoWriter(str(tmp_path / f"{name}.avi"), cv2.VideoWriter.fourcc(*"MJPG"), 16.0, SIZE)
        for pair in boards:
            for _ in range(6):
                video.write(pair.images[name])
        video.release()
    sources = {n: str(tmp_path / f"{n}.avi") for n in ("left", "right")}
    captured = capture(CaptureOptions(sources, board_file, tmp_path / "set", pairs=4))
    # Of 16 pictures a second 8 are looked at: three at each place, of which the first follows another place.
    assert len(captured.collection) >= 4
    again = {n: str(tmp_path / "set" / n) for n in ("left", "right")}
    copied = capture(CaptureOptions(again, board_file, tmp_path / "copy", pairs=4))
    assert len(copied.collection) == len(captured.collection)


def test_capture_goes_on_where_pairs_are(board_file: Path, boards: list[FramePair], tmp_path: Path) -> None:
    for name in ("left", "right"):
        (tmp_path / "pictures" / name).mkdir(parents=True)
        for i, pair in enumerate(boards[:5]):
            cv2.imwrite(str(tmp_path / "pictures" / name / f"{i}.png"), pair.images[name])
    sources = {n: str(tmp_path / "pictures" / n) for n in ("left", "right")}
    first = capture(CaptureOptions(sources, board_file, tmp_path / "set", pairs=20))
    assert first.level == "too few" and "capture more into the same folder" in first.next_step
    second = capture(CaptureOptions(sources, board_file, tmp_path / "set", pairs=20))
    assert len(second.collection) == len(first.collection), "the same pictures add nothing"
    assert len(list_pairs(tmp_path / "set", sources)) == len(first.collection)


# --- what goes wrong ---


def broken(kind: str) -> Callable[[BaseHTTPRequestHandler], None]:
    def respond(handler: BaseHTTPRequestHandler) -> None:
        if kind == "silent":
            time.sleep(2.0)
            return
        if kind == "missing":
            handler.send_error(404)
            return
        if kind == "login":
            handler.send_error(401)
            return
        types = {"page": "text/html", "no boundary": "multipart/x-mixed-replace"}
        handler.send_response(200)
        handler.send_header("Content-Type", types.get(kind, "multipart/x-mixed-replace; boundary=frame"))
        handler.end_headers()
        if kind == "huge":
            handler.wfile.write(b"--frame\r\nContent-Length: 999999999999\r\n\r\n")
        elif kind == "endless headers":
            handler.wfile.write(b"--frame\r\n" + b"X: y\r\n" * 20000)
        elif kind == "junk":
            for _ in range(30):
                handler.wfile.write(b"--frame\r\nContent-Length: 9\r\n\r\nnopicture\r\n")
        elif kind == "cut":
            handler.wfile.write(b"--frame\r\nContent-Length: 900\r\n\r\n\xff\xd8")
        elif kind == "dripping":
            for _ in range(40):
                handler.wfile.write(b"-")
                handler.wfile.flush()
                time.sleep(0.1)

    return respond


@pytest.mark.parametrize(
    ("kind", "said"),
    [
        ("silent", "no answer for 0.5 s"),
        ("dripping", "no answer for 0.5 s"),
        ("missing", "the camera answers 404"),
        ("login", "http://user:password@"),
        ("page", "not motion JPEG"),
        ("no boundary", "no boundary"),
        ("huge", "999999999999 bytes"),
        ("endless headers", "no motion JPEG"),
        ("junk", "cannot be used"),
        ("cut", "broke off"),
    ],
)
def test_broken_cameras_are_named_at_once(kind: str, said: str) -> None:
    with serve(broken(kind)) as address:
        started = time.monotonic()
        feeds = open_feeds({"left": f"{address}/x"}, BOARD, timeout_s=0.5)
        try:
            with pytest.raises(InputError, match=said) as error:
                next(instants(feeds))
        finally:
            close_feeds(feeds)
        assert str(error.value).startswith(address) and "\n" not in str(error.value)
        # Half a second to connect and half a second for a picture, twice over for a loaded machine.
        assert time.monotonic() - started < 4


def test_a_password_is_sent_but_not_shown() -> None:
    seen: list[str] = []

    def respond(handler: BaseHTTPRequestHandler) -> None:
        seen.append(handler.headers.get("Authorization", ""))
        handler.send_error(500)

    with serve(respond) as address, pytest.raises(InputError) as error:
        HttpPictures(address.replace("//", "//me:secret@"), 1.0).read()
    assert seen == ["Basic bWU6c2VjcmV0"] and "secret" not in str(error.value)


@pytest.mark.parametrize(
    ("source", "said"),
    [
        ("/dev/video97", "there is no such camera"),
        ("nowhere.mp4", "no such file or folder"),
        ("http://127.0.0.1:9/left.mjpg", "is the camera on"),
        ("ftp://somewhere", "a source is an index"),
        ("http://", "not an address of a camera"),
    ],
)
def test_missing_cameras_give_one_line(
    source: str, said: str, board_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code = run("capture", "--source", f"left={source}", "--source", "right=sim:", "--size", "640x360",
               "--board", board_file, "-o", tmp_path / "set")  # fmt: skip
    err = capsys.readouterr().err
    assert code == 1 and said in err and "Traceback" not in err
    assert len([line for line in err.splitlines() if line.startswith("error: ")]) == 1


def test_camera_that_dies_keeps_the_pairs(board_file: Path, boards: list[FramePair], tmp_path: Path) -> None:
    sent = iter([jpeg(pair.images["left"]) for pair in boards[:2] for _ in range(40)])
    with serve(stream(lambda: next(sent, None), 40.0)) as address:
        options = CaptureOptions({"left": f"{address}/x"}, board_file, tmp_path / "set", pairs=4, timeout_s=1.0)
        with pytest.raises(InputError, match=r"the stream ended.* \([12] pairs are kept in"):
            capture(options)
    assert 1 <= len(list_pairs(tmp_path / "set", ("left",))) <= 2


def test_driver_that_hangs_does_not_hang_the_program() -> None:
    release = threading.Event()

    def hang() -> np.ndarray:
        release.wait()
        raise InputError("late")

    feed = LiveFeed("camera", lambda: SimpleNamespace(read=hang, close=lambda: None), 0.2)
    with pytest.raises(InputError, match=r"camera: no picture for 0.2 s"):
        feed.next()
    release.set()
    feed.close()


def test_ctrl_c_leaves_whole_pairs(
    board_file: Path, boards: list[FramePair], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("left", "right"):
        (tmp_path / "pictures" / name).mkdir(parents=True)
        for i, pair in enumerate(boards[:4]):
            cv2.imwrite(str(tmp_path / "pictures" / name / f"{i}.png"), pair.images[name])
    write = app.write_atomic
    written: list[Path] = []

    def interrupted(path: Path, data: bytes) -> None:
        write(path, data)
        written.append(path)
        if len(written) == 5:
            raise KeyboardInterrupt

    monkeypatch.setattr(app, "write_atomic", interrupted)
    sources = {n: str(tmp_path / "pictures" / n) for n in ("left", "right")}
    captured = capture(CaptureOptions(sources, board_file, tmp_path / "set"))
    assert len(list_pairs(tmp_path / "set", sources)) == 2 == len(captured.collection)
    assert "stopped" in captured.sentence


def test_wrong_usage(board_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ("--board", board_file, "-o", tmp_path / "set")
    assert run("capture", "--source", "left", *common) == 2
    assert run("capture", "--source", "left=0", "--source", "left=1", *common) == 2
    assert run("capture", "--source", "left=0", "--size", "big", *common) == 2
    assert run("capture", "--source", "a/b=sim:", *common) == 1
    assert "cannot be a camera's name" in capsys.readouterr().err
