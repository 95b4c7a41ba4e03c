"""Loaders and writers: round trips, and one line of remedy for what cannot be used."""

import dataclasses
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from shared_data import shared
from tubesight.core import Board, InputError, Tip, Tube
from tubesight.files.board import load_board
from tubesight.files.dataset import backgrounds, camera_folders, list_pairs
from tubesight.files.nested import dump_yaml, parse_yaml
from tubesight.files.registration import load_points, load_registration
from tubesight.files.rig import load_rig, rig_hash, save_rig
from tubesight.files.safe import write_atomic
from tubesight.files.tables import (
    COLUMNS,
    Curves,
    ShapeRow,
    read_curves,
    read_shapes,
    to_json,
    write_curves,
    write_json,
    write_shapes,
)
from tubesight.files.truth import load_truth
from tubesight.files.tube import load_tube
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig, RigCovariance

RIG = """\
format: tubesight-rig/1
units: mm
cameras:
  left:
    size_px: [640, 480]
    matrix: [[500.0, 0.5, 320.0], [0.0, 510.0, 240.0], [0.0, 0.0, 1.0]]
    distortion: [0.1, -0.2, 1e-3, 0.0, 0.0]
    camera_from_base: [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 300], [0, 0, 0, 1]]
  right:
    size_px: [640, 480]
    matrix: [[500.0, 0.0, 320.0], [0.0, 500.0, 240.0], [0.0, 0.0, 1.0]]
    camera_from_base: [[0, 0, 1, 0], [0, 1, 0, 0], [-1, 0, 0, 300], [0, 0, 0, 1]]
"""
BOARD = "type: chessboard\nsquares: [10, 7]\nsquare_mm: 13\n"
TUBE = "diameter_mm: 12\ntip: {shape: ball, diameter_mm: 16}\nclamped: true\n"


def written(path: Path, text: str) -> Path:
    path.write_text(text, encoding="utf-8")
    return path


def one_line(error: pytest.ExceptionInfo[InputError], path: Path) -> str:
    """The message, checked to be one line that names the file."""
    message = str(error.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def test_rig_reads_as_documented(tmp_path: Path) -> None:
    rig = load_rig(written(tmp_path / "rig.yaml", RIG)).rig
    assert rig.names == ("left", "right")
    assert rig.registered and rig.covariance is None
    assert rig.cameras["left"].matrix[0, 1] == 0.5
    assert rig.cameras["left"].distortion[2] == 1e-3
    assert not rig.cameras["right"].distortion.any()
    assert rig.camera_from_base["right"].apply([0.0, 0.0, 0.0]).tolist() == [0, 0, 300]


numbers = st.floats(-1e3, 1e3, allow_nan=False)


@settings(max_examples=25, deadline=None)
@given(
    focal=st.floats(1e-3, 1e5),
    distortion=st.lists(numbers, min_size=8, max_size=8),
    rotation=st.lists(st.floats(-3, 3), min_size=3, max_size=3),
    translation=st.lists(numbers, min_size=3, max_size=3),
    base_frame=st.sampled_from(["clamp", "left 1"]),
    variances=st.lists(st.floats(0, 1e6), min_size=2, max_size=2),
)
def test_rig_survives_saving_exactly(
    tmp_path_factory: pytest.TempPathFactory,
    focal: float,
    distortion: list[float],
    rotation: list[float],
    translation: list[float],
    base_frame: str,
    variances: list[float],
) -> None:
    path = tmp_path_factory.mktemp("rig") / "new" / "rig.yaml"
    matrix = np.array([[focal, 1 / 3, 320.1], [0, focal * 0.9, 240.2], [0, 0, 1]])
    cameras = {
        "left 1": Camera(matrix, (640, 480), np.array(distortion), "rational"),
        "2": Camera(matrix, (800, 600)),
    }
    poses = {"left 1": Pose.from_rotvec(rotation, translation)}
    covariance = RigCovariance(("left 1.f", "2.cx"), np.diag(variances) + 1e-9 * np.eye(2)[::-1])
    saved = Rig(cameras, poses, base_frame, covariance)
    save_rig(path, saved, {"rms_px": 0.1, "date": "2026-01-02", "observations": {"left 1": np.eye(2)}})
    file = load_rig(path)
    for name, camera in cameras.items():
        got = file.rig.cameras[name]
        assert got.size_px == camera.size_px and got.lens == camera.lens
        assert np.array_equal(got.matrix, camera.matrix) and np.array_equal(got.distortion, camera.distortion)
    # A pose is projected onto the rotations again: a few roundings of 1e-16.
    assert np.abs(file.rig.camera_from_base["left 1"].matrix - poses["left 1"].matrix).max() < 1e-14 * 1e3
    assert file.rig.base_frame == base_frame
    assert file.rig.covariance is not None and file.calibration is not None
    assert file.rig.covariance.names == covariance.names
    assert np.array_equal(file.rig.covariance.matrix, covariance.matrix)
    assert file.calibration["date"] == "2026-01-02"
    assert file.calibration["observations"] == {"left 1": [[1.0, 0.0], [0.0, 1.0]]}
    again = path.with_name("again.yaml")
    save_rig(again, file.rig, file.calibration)
    assert np.array_equal(load_rig(again).rig.covariance.matrix, covariance.matrix)  # type: ignore[union-attr]


def test_lens_only_rig_has_no_clamp_frame(tmp_path: Path) -> None:
    text = "\n".join(line for line in RIG.splitlines() if "camera_from_base" not in line)
    rig = load_rig(written(tmp_path / "rig.yaml", text)).rig
    assert not rig.camera_from_base and rig.base_frame == "left"


def test_saving_refuses_what_could_not_be_read_again(tmp_path: Path) -> None:
    rig = load_rig(written(tmp_path / "rig.yaml", RIG)).rig
    for bad in (math.nan, math.inf, -math.inf):
        with pytest.raises(ValueError, match="not finite"):
            save_rig(tmp_path / "bad.yaml", rig, {"rms_px": bad})
    assert not (tmp_path / "bad.yaml").exists()


def test_rig_hash_tells_files_apart(tmp_path: Path) -> None:
    one, other = written(tmp_path / "a.yaml", RIG), written(tmp_path / "b.yaml", RIG + "\n")
    assert rig_hash(one) != rig_hash(other)
    assert len(rig_hash(one)) == 64


@pytest.mark.parametrize(
    ("loader", "text", "old", "new", "expected"),
    [
        (load_rig, RIG, "distortion", "distorsion", "did you mean 'distortion'?"),
        (load_rig, RIG, "cameras:", "camera:", "did you mean 'cameras'?"),
        (load_rig, RIG, "500.0, 0.5", ".nan, 0.5", "finite number, got nan"),
        (load_rig, RIG, "500.0, 0.5", ".inf, 0.5", "finite number, got inf"),
        (load_rig, RIG, "0, 1, 300", "0, .nan, 300", "finite number, got nan"),
        (load_rig, RIG, "1e-3, 0.0, 0.0]", "1e-3]", "expected shape (5)"),
        (load_rig, RIG, "[1, 0, 0, 0]", "[-1, 0, 0, 0]", "mirrored"),
        (load_rig, RIG, "[1, 0, 0, 0]", "[2, 0, 0, 0]", "not orthonormal"),
        (load_rig, RIG, "  right:", "  ../right:", "cannot be a camera's name"),
        (load_rig, RIG, "  right:", "  clamp:", "cannot be a camera's name"),
        (load_rig, RIG, "  right:", "  left:", "'left' is there twice"),
        (load_rig, RIG, "units: mm", "units: m", "expected 'mm', got 'm'"),
        (load_rig, RIG, "units: mm", "base_frame: table\nunits: mm", "expected 'clamp' or a camera's name"),
        (load_rig, RIG, "rig/1", "rig/2", "expected 'tubesight-rig/1'"),
        (load_rig, RIG, "[640, 480]", "[640, -480]", "greater than 0"),
        (load_rig, RIG, "units: mm", "units: mm\ncalibration: {rms_px: .nan}", "calibration.rms_px: expected a finite"),
        (
            load_rig,
            RIG,
            "units: mm",
            "units: mm\ncalibration: {parameters: [left.f], covariance: [1, 2]}",
            "1 parameters need 1 numbers, got 2",
        ),
        (
            load_rig,
            RIG,
            "units: mm",
            "units: mm\ncalibration: {parameters: [top.f], covariance: [1]}",
            "'top.f' is of no camera",
        ),
        (
            load_rig,
            RIG,
            "units: mm",
            "units: mm\ncalibration: {parameters: [left.f], covariance: [-1]}",
            "variance is negative",
        ),
        (load_board, BOARD, "square_mm", "squares_mm", "did you mean 'square"),
        (load_board, BOARD, "square_mm: 13", "", "square_mm: this key is missing"),
        (load_board, BOARD, "chessboard", "charuco", "marker_mm"),
        (load_board, BOARD, "[10, 7]", "[2, 7]", "at least 3 columns"),
        (load_board, BOARD, "13", "thirteen", "expected a valid number"),
        (load_tube, TUBE, "clamped", "clampd", "did you mean 'clamped'?"),
        (load_tube, TUBE, "shape: ball, ", "shap: ball, ", "tip: unknown key 'shap'; did you mean 'shape'?"),
        (load_tube, TUBE, "ball", "sphere", "expected 'ball', 'round', 'flat' or 'open', got 'sphere'"),
        (load_tube, TUBE, "shape: ball", "shape: round", "a round end has the tube's own diameter"),
        (load_tube, TUBE, ", diameter_mm: 16", "", "ball tip needs a positive diameter_mm"),
        (load_tube, TUBE, "12", ".nan", "finite number"),
    ],
)
def test_mistakes_are_named(
    tmp_path: Path, loader: Callable[[Path], Any], text: str, old: str, new: str, expected: str
) -> None:
    assert old in text
    path = written(tmp_path / "file.yaml", text.replace(old, new, 1))
    with pytest.raises(InputError) as error:
        loader(path)
    assert expected in one_line(error, path)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("", "the file is empty"),
        ("just words", "expected keys and values"),
        ("[" * 200_000, "nested more than"),
        ("{a: " * 200_000, "nested more than"),
        ("- " * 200_000, "nested more than"),
        ("\n".join(" " * n + "a:" for n in range(1000)), "nested more than"),
        ("a: &a [x]\n" + "\n".join(f"b{n}: &b{n} [*a, *a]" for n in range(30)), "aliases (*a) are not allowed"),
        ("a: &a {b: 1}\n<<: *a\n", "aliases (*a) are not allowed"),
        ('!!python/object/apply:os.system ["true"]', "could not determine a constructor"),
        ("type: chessboard\ntype: charuco\n", "line 2: the key 'type' is there twice"),
        ("? [a, b]\n: 1\n", "a key has to be plain text"),
        ("type: chessboard\n\tsquares: 1", "line 2: "),
        ("a: 1\n---\nb: 2\n", "line 2: "),
        ("a: " + "9" * 5000, "not YAML"),
        ("a: \x00", "not YAML"),
        ("x" * (1 << 20) + "x", "bytes is more than such a file can have"),
    ],
)
def test_hostile_yaml_is_refused(tmp_path: Path, text: str, expected: str) -> None:
    path = written(tmp_path / "board.yaml", text)
    with pytest.raises(InputError) as error:
        load_board(path)
    message = one_line(error, path)
    assert expected in message
    assert len(message) < len(str(path)) + 300


REGISTRATION = "units: mm\nviews:\n- image: a.png\n  base_from_board: [[1,0,0,5],[0,1,0,6],[0,0,1,7],[0,0,0,1]]\n"
POINTS = "name, x_mm, y_mm, z_mm, left_x_px, left_y_px\np1,1,2,3,10,20\n"
SPLICES = [
    "",
    "null",
    "-1",
    "1e999",
    "[]",
    "{}",
    "[1, 2]",
    "true",
    ".nan",
    "'",
    '"',
    "\t",
    ": ",
    "- ",
    "\n",
    "&a *a",
    "!!int x",
    "\u2028",
]


@settings(max_examples=300, deadline=None)
@given(
    case=st.sampled_from(
        [
            (load_rig, RIG),
            (load_board, BOARD),
            (load_tube, TUBE),
            (load_registration, REGISTRATION),
            (load_points, POINTS),
        ]
    ),
    at=st.floats(0, 1),
    length=st.integers(0, 12),
    splice=st.sampled_from(SPLICES) | st.text(max_size=8),
)
def test_spoilt_files_load_or_are_refused_in_one_line(
    tmp_path_factory: pytest.TempPathFactory,
    case: tuple[Callable[[Path], Any], str],
    at: float,
    length: int,
    splice: str,
) -> None:
    loader, text = case
    start = int(at * len(text))
    path = tmp_path_factory.getbasetemp() / "spoilt"
    path.write_text(text[:start] + splice + text[start + length :], encoding="utf-8", errors="ignore")
    try:
        loader(path)
    except InputError as error:
        assert "\n" not in str(error) and str(path) in str(error)


def test_missing_files_come_with_a_suggestion(tmp_path: Path) -> None:
    written(tmp_path / "board.yaml", BOARD)
    for name, expected in (
        ("bord.yaml", "did you mean 'board.yaml'?"),
        ("no/board.yaml", "no folder"),
        (".", "a folder"),
    ):
        with pytest.raises(InputError) as error:
            load_board(tmp_path / name)
        assert expected in one_line(error, tmp_path)
    (tmp_path / "latin.yaml").write_bytes("größe".encode("latin-1"))
    with pytest.raises(InputError, match="not UTF-8"):
        load_board(tmp_path / "latin.yaml")


@given(st.recursive(st.none() | st.booleans() | st.floats(allow_nan=False) | st.text(), st.lists, max_leaves=20))
def test_written_yaml_reads_back(data: object) -> None:
    text = dump_yaml({"data": data, "again": data})
    assert parse_yaml(text, Path("file")) == {"data": data, "again": data}


def test_yaml_scalars_are_plain() -> None:
    text = "a: 1e-3\nb: 010\nc: 2026-01-02\nd: no\ne: 12:30\nf: ~\ng: true\nh: 1_0\n"
    expected = {"a": 1e-3, "b": 10, "c": "2026-01-02", "d": "no", "e": "12:30", "f": None, "g": True, "h": "1_0"}
    assert parse_yaml(text, Path("file")) == expected


def test_board_and_tube_read_as_documented(tmp_path: Path) -> None:
    assert load_board(written(tmp_path / "b.yaml", BOARD)) == Board("chessboard", (10, 7), 13.0)
    charuco = "type: charuco\nsquares: [9, 6]\nsquare_mm: 14\nmarker_mm: 10\ndictionary: DICT_4X4_50\n"
    assert load_board(written(tmp_path / "c.yaml", charuco)) == Board("charuco", (9, 6), 14.0, 10.0, "DICT_4X4_50")
    assert load_tube(written(tmp_path / "t.yaml", TUBE)) == Tube(12.0, Tip("ball", 16.0), True)
    repeated = "diameter_mm: 5\ntip: {shape: flat, diameter_mm: 5.0}\n"
    assert load_tube(written(tmp_path / "f.yaml", repeated)) == Tube(5.0, Tip("flat"), False)


def test_failed_writing_leaves_nothing_half_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = written(tmp_path / "file.txt", "old")

    def fail(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(InputError, match="No space left"):
        write_atomic(path, "new")
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["file.txt"]


def test_writing_below_a_file_names_it(tmp_path: Path) -> None:
    written(tmp_path / "file", "text")
    with pytest.raises(InputError, match="cannot be written"):
        write_atomic(tmp_path / "file" / "below", "text")


def test_registration_reads_as_documented(tmp_path: Path) -> None:
    text = "units: mm\nviews:\n- image: a.png\n  base_from_board: [[1,0,0,5],[0,1,0,6],[0,0,1,7],[0,0,0,1]]\n"
    ((image, pose),) = load_registration(written(tmp_path / "r.yaml", text))
    assert image == "a.png" and pose.translation_mm.tolist() == [5, 6, 7]
    for old, new, expected in (
        ("a.png", "../a.png", "without a folder"),
        ("[1,0,0,5]", "[1,1,0,5]", "not orthonormal"),
        ("image", "images", "did you mean 'image'?"),
        ("units: mm", "unit: mm", "did you mean 'units'?"),
    ):
        path = written(tmp_path / "bad.yaml", text.replace(old, new))
        with pytest.raises(InputError) as error:
            load_registration(path)
        assert expected in one_line(error, path)


def test_points_read_as_documented(tmp_path: Path) -> None:
    text = (
        "name, x_mm, y_mm, z_mm, left_x_px, left_y_px, right_x_px, right_y_px\np1,1,2,3,10,20,,\n\np2,4,5,6,,,30,40\n"
    )
    points = load_points(written(tmp_path / "p.csv", "\ufeff" + text))
    assert points.names == ("p1", "p2")
    assert points.xyz_mm.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert np.array_equal(points.px["left"], [[10, 20], [np.nan, np.nan]], equal_nan=True)
    assert np.array_equal(points.px["right"], [[np.nan, np.nan], [30, 40]], equal_nan=True)
    for old, new, expected in (
        ("x_mm, y_mm", "x_m, y_mm", "did you mean 'x_mm'?"),
        ("10,20,,", "10,,,", "half a position in left"),
        ("p1,1,", "p1,,", "'p1' has no position"),
        ("10,20", "10,abc", "left_y_px: expected a number or an empty cell, got 'abc'"),
        ("10,20", "10,nan", "expected a number or an empty cell, got 'nan'"),
        ("10,20,,", "10,20", "row 2 has 6 cells where the header has 8"),
        ("right_x_px", "left_x_px", "'left_x_px' is there twice"),
        (", right_y_px", ", top_y_px", "'right_y_px' is missing"),
    ):
        path = written(tmp_path / "bad.csv", text.replace(old, new, 1))
        with pytest.raises(InputError) as error:
            load_points(path)
        assert expected in one_line(error, path)


def touched(folder: Path, *names: str) -> None:
    for name in names:
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).touch()


def test_pairs_share_their_stem(tmp_path: Path) -> None:
    touched(tmp_path, *(f"left/{n}.PNG" for n in (10, 9, 1)), *(f"right/{n}.jpg" for n in (1, 9, 10)), "left/notes.txt")
    touched(tmp_path, "left/.hidden.png", "background/left/b.png", "background/right/b.png", "empty/readme.txt")
    pairs = list_pairs(tmp_path, ("left", "right"))
    assert [stem for stem, _ in pairs] == ["1", "9", "10"]
    assert pairs[0][1] == {"left": tmp_path / "left/1.PNG", "right": tmp_path / "right/1.jpg"}
    assert camera_folders(tmp_path) == ["left", "right"]
    assert backgrounds(tmp_path / "background", ("left", "right"))["left"].name == "b.png"
    assert backgrounds(tmp_path / "nothing", ("left",)) == {}


def test_folders_that_are_no_data_set_are_refused(tmp_path: Path) -> None:
    touched(tmp_path, "mate/left/1.png", "mate/left/2.png", "mate/right/1.png")
    touched(tmp_path, "twice/left/1.png", "twice/left/1.jpg", "twice/right/1.png")
    touched(tmp_path, "one/left/1.png", "bare/left/readme.txt", "bare/right/1.png", "background/top/1.png")
    (tmp_path / "nothing").mkdir()
    for name, expected in (
        ("mate", "left/2.png: this picture has no mate right/2;"),
        ("twice", "1.jpg and 1.png have one stem"),
        ("one", "no subfolder 'right'"),
        ("bare", "no pictures here"),
        ("nothing", "no folder of pictures"),
        ("absent", "no such folder"),
    ):
        with pytest.raises(InputError) as error:
            list_pairs(tmp_path / name, ("left", "right"))
        assert expected in one_line(error, tmp_path / name)
    with pytest.raises(InputError, match="no background picture"):
        backgrounds(tmp_path / "background", ("left", "right"))


def test_shapes_survive_writing(tmp_path: Path) -> None:
    path = tmp_path / "out" / "shapes.csv"
    full = ShapeRow("a,b", 1, 0.25, "ok", 'note; "quoted"', *(0.1 * n for n in range(1, 16)), "circle", "cone_ray", 7.5)
    empty = ShapeRow("0001", status="tip_not_found", notes="x")
    write_shapes(path, [full, empty])
    header = path.read_text().splitlines()[0]
    assert header == (
        "frame,tube,time_s,status,notes,tip_x_mm,tip_y_mm,tip_z_mm,bending_deg,orientation_deg,length_mm,"
        "curvature_per_mm,tip_x_sd_mm,tip_y_sd_mm,tip_z_sd_mm,bending_sd_deg,orientation_sd_deg,length_sd_mm,"
        "curvature_sd_per_mm,fit_rms_px,model,method,total_ms"
    )
    got = read_shapes(path)
    for name in COLUMNS:
        for want, have in ((full, got[0]), (empty, got[1])):
            a, b = getattr(want, name), getattr(have, name)
            # Seven significant digits are written.
            assert a == b if isinstance(a, str) else np.isclose(a, b, rtol=5e-7, atol=0, equal_nan=True)
    assert path.read_text().splitlines()[2].startswith("0001,0,,tip_not_found,x,,,")


def test_shapes_with_foreign_columns_are_refused(tmp_path: Path) -> None:
    write_shapes(tmp_path / "s.csv", [ShapeRow("1")])
    text = (tmp_path / "s.csv").read_text()
    for old, new, expected in (
        ("tip_x_mm", "tipx_mm", "did you mean 'tip_x_mm'?"),
        (",total_ms", "", "'total_ms' is missing"),
        ("1,0,", "1,zero,", "expected a number"),
    ):
        path = written(
            tmp_path / "bad.csv", text.replace(old, new, 1) if new else text.replace(old, new).replace(",\n", "\n")
        )
        with pytest.raises(InputError) as error:
            read_shapes(path)
        assert expected in one_line(error, path)


def test_curves_survive_writing(tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    curves = Curves(("a", "bcd"), rng.random((2, 5)), rng.random((2, 5, 3)), np.full((2, 5), np.nan))
    for some in (curves, Curves((), np.zeros((0, 5)), np.zeros((0, 5, 3)), np.zeros((0, 5)))):
        write_curves(tmp_path / "c.npz", some)
        got = read_curves(tmp_path / "c.npz")
        assert got.frame == some.frame
        for field in dataclasses.fields(Curves)[1:]:
            assert np.array_equal(getattr(got, field.name), getattr(some, field.name), equal_nan=True)


def test_hostile_curves_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "c.npz"
    good = {"s_mm": np.zeros((1, 5)), "xyz_mm": np.zeros((1, 5, 3)), "sd_mm": np.zeros((1, 5))}
    np.savez(path, frame=np.array(["a"], object), **good)
    with pytest.raises(InputError, match="not a table of curves"):
        read_curves(path)
    np.savez(path, frame=np.array(["a", "b"]), **good)
    with pytest.raises(InputError, match="frame has the wrong shape"):
        read_curves(path)
    # 8 GiB of zeros in 8 MB would pass a cap on the file alone; 600 MB in 0.6 MB are enough to tell.
    np.savez_compressed(path, frame=np.array(["a"]), s_mm=np.zeros((1, 75_000_000)), xyz_mm=0, sd_mm=0)
    with pytest.raises(InputError, match="larger unpacked"):
        read_curves(path)
    path.write_bytes(b"PK\x03\x04 and nothing more")
    with pytest.raises(InputError, match="not a table of curves"):
        read_curves(path)
    # A header that declares more than there is.
    np.savez(path, frame=np.array(["a"]), **good)
    path.write_bytes(path.read_bytes().replace(b"(1, 5)", b"(9, 5)"))
    with pytest.raises(InputError, match="not a table of curves"):
        read_curves(path)


def test_json_has_null_where_a_number_is_not_known(tmp_path: Path) -> None:
    write_json(tmp_path / "r.json", {"a": math.nan, "b": [np.float64(1.5), math.inf], "c": (Path("x"), np.int64(3))})
    assert json.loads((tmp_path / "r.json").read_text()) == {"a": None, "b": [1.5, None], "c": ["x", 3]}
    assert json.loads(to_json({"ü": 1})) == {"ü": 1}


def test_truth_reads_as_documented(tmp_path: Path) -> None:
    frame = {
        "frame": "0",
        "kind": "circle",
        "tip": [1, 2, 3],
        "length": 4,
        "theta": 5,
        "phi": 6,
        "centreline": [[0, 0, 0], [1, 2, 3]],
    }
    straight = frame | {"frame": "1", "kind": "straight", "theta": 0, "phi": 0}
    path = written(tmp_path / "t.json", json.dumps({"units": "mm, deg", "frames": [frame, straight]}))
    truth = load_truth(path)
    assert truth["0"].tip_mm.tolist() == [1, 2, 3] and truth["0"].orientation_deg == 6
    assert math.isnan(truth["1"].orientation_deg)
    for bad, expected in (
        ([frame, frame], "is there twice"),
        ([frame | {"lenght": 4}], "did you mean 'length'?"),
        ([frame | {"length": math.nan}], "finite"),
        ([frame | {"centreline": [[0, 0, 0]]}], "centreline"),
        ([], "frames"),
    ):
        written(path, json.dumps({"units": "mm, deg", "frames": bad}))
        with pytest.raises(InputError) as error:
            load_truth(path)
        assert expected in one_line(error, path)
    for text in ("[" * 200_000, '{"units": ', '{"a": ' * 200_000):
        with pytest.raises(InputError):
            load_truth(written(path, text))


def test_shared_mockup_loads() -> None:
    folder = shared("mockup")
    rig = load_rig(folder / "rig_true.yaml").rig
    assert len(list_pairs(folder, rig.names)) == len(load_truth(folder / "truth.json")) == 12
    assert len(load_registration(folder / "registration.yaml")) == 2
    assert load_tube(folder / "tube.yaml").tip.shape == "ball"
    assert load_board(folder / "board.yaml").inner_corners == (9, 6)
