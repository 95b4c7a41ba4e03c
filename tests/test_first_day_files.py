"""A lab's first day: the board to print, the files to fill in, and a run from a file."""

import json
import re
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest

from small_set import write_small_set
from tubesight.apps.board import BoardOptions, black_mm, make_board
from tubesight.apps.init import start_folder, templates
from tubesight.apps.run import RunOptions
from tubesight.apps.run_config import load_run_config
from tubesight.calibration.find import ambiguity, find_corners
from tubesight.cli.main import main
from tubesight.core import Board, InputError
from tubesight.files.board import load_board
from tubesight.files.registration import load_registration
from tubesight.files.tables import read_shapes
from tubesight.files.tube import load_tube
from tubesight.outputs.board_pdf import SHEETS

BOARDS = [("chessboard", "a4"), ("charuco", "letter"), ("chessboard", "a3"), ("charuco", "a4")]


def leave(*args: str | Path) -> int:
    """Exit code of the command line."""
    with pytest.raises(SystemExit) as left:
        main([str(arg) for arg in args])
    return int(left.value.code or 0)


def painted(board: Board, px_per_mm: int) -> np.ndarray:
    """Paint the rectangles on white, a margin of 20 mm around them."""
    margin = 20 * px_per_mm
    size = [round(n * board.square_mm) * px_per_mm + 2 * margin for n in board.squares]
    image = np.full((size[1], size[0]), 255, np.uint8)
    for x, y, w, h in np.rint(black_mm(board) * px_per_mm).astype(int):
        image[margin + y : margin + y + h, margin + x : margin + x + w] = 0
    return image


# Rectangles end at whole pixels: squares are whole millimetres; marker cells of 3 mm = 12 pixels.
@pytest.mark.parametrize(
    "board", [Board("chessboard", (10, 7), 24.0), Board("charuco", (10, 7), 24.0, 18.0, "DICT_4X4_50")]
)
def test_drawn_board_is_found_in_its_frame(board: Board) -> None:
    image = painted(board, 4)
    corners = find_corners(image, board)
    assert corners is not None
    assert len(corners.ids) == 54
    first = 0.0 if board.type == "charuco" else board.square_mm
    # Pixel edges at integers there, pixel centres in OpenCV: half a pixel.
    there = (corners.px + 0.5) / 4 - 20 - first
    # The finder is good to 0.1 px on sharp pictures: 0.025 mm.
    assert np.abs(there - board.corners_mm[corners.ids, :2]).max() < 0.025


@pytest.mark.parametrize(("kind", "sheet"), BOARDS)
def test_pdf_is_whole_and_in_exact_millimetres(kind: str, sheet: str, tmp_path: Path) -> None:
    made = make_board(BoardOptions(tmp_path / "b.pdf", kind, sheet=sheet))  # type: ignore[arg-type]
    data = made.pdf.read_bytes()
    assert data.startswith(b"%PDF-1.7\n")
    assert data.endswith(b"%%EOF\n")
    start = int(re.search(rb"startxref\n(\d+)", data)[1])  # type: ignore[index]
    assert data[start:].startswith(b"xref")
    for number, offset in enumerate(re.findall(rb"(\d{10}) 00000 n ", data), start=1):
        assert data[int(offset) :].startswith(b"%d 0 obj" % number)
    stream = re.search(rb"/Length (\d+) >>\nstream\n(.*)\nendstream", data, re.DOTALL)
    assert stream is not None
    assert len(stream[2]) == int(stream[1])
    box = [float(v) for v in re.search(rb"MediaBox \[0 0 ([\d.]+) ([\d.]+)\]", data).groups()]  # type: ignore[union-attr]
    short, long = SHEETS[sheet]
    # Six decimals are written.
    np.testing.assert_allclose(box, [long * 72 / 25.4, short * 72 / 25.4], atol=1e-6)
    scale = float(stream[2].split()[0])
    rectangles = np.array(re.findall(rb"([\d.]+) ([\d.]+) ([\d.]+) ([\d.]+) re", stream[2]), dtype=float)
    # A square in points is 72/25.4 of its millimetres; 1e-6 mm are written.
    assert scale * rectangles[0, 2] == pytest.approx(made.board.square_mm * 72 / 25.4, abs=1e-5)
    assert rectangles.min() >= 0
    assert (rectangles[:, 0] + rectangles[:, 2]).max() <= long - 8
    assert (rectangles[:, 1] + rectangles[:, 3]).max() <= short - 28 + 1e-6
    black = black_mm(made.board)
    np.testing.assert_allclose(
        rectangles - black, np.tile([*(rectangles[0] - black[0])[:2], 0, 0], (len(black), 1)), atol=2e-6
    )
    assert load_board(made.yaml) == made.board
    assert not ambiguity(made.board)


@pytest.mark.skipif(shutil.which("pdftoppm") is None, reason="no pdftoppm (poppler-utils)")
@pytest.mark.parametrize(("kind", "sheet"), BOARDS[:2])
def test_printed_board_is_found_at_its_size(kind: str, sheet: str, tmp_path: Path) -> None:
    made = make_board(BoardOptions(tmp_path / "b.pdf", kind, sheet=sheet))  # type: ignore[arg-type]
    subprocess.run(["pdftoppm", "-r", "150", "-gray", "-png", made.pdf, tmp_path / "page"], check=True)
    (page,) = tmp_path.glob("page*.png")
    image = cv2.imread(str(page), cv2.IMREAD_GRAYSCALE)
    assert image is not None
    corners = find_corners(image, made.board)
    assert corners is not None
    assert len(corners.ids) == 54
    there = corners.px / 150 * 25.4
    offset = there - made.board.corners_mm[corners.ids, :2]
    # The page is rounded up to whole pixels (0.17 mm each) over its length, and so are the edges of filled shapes.
    assert np.ptp(offset, axis=0).max() < 0.17
    # The ruler across: its first and last millimetre mark, in the row where only long marks reach.
    row = round((min(SHEETS[sheet]) - 22 + 3.6) / 25.4 * 150)
    marks = np.flatnonzero(image[row] < 200) / 150 * 25.4
    marks = marks[marks < 130]
    assert marks[-1] - marks[0] == pytest.approx(100, abs=0.34)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--squares", "9x6"], "look alike"),
        (["--squares", "8x5", "--square-mm", "60"], "--square-mm 33.3 at most"),
        (["--squares", "2x5"], "at least 3 columns"),
        (["--squares", "400x301"], "too many"),
        (["--square-mm", "0"], "square_mm: expected a positive number"),
        (["--square-mm", "nan"], "square_mm"),
        (["--marker-mm", "5"], "--type charuco"),
        (["--type", "charuco", "--marker-mm", "50"], "marker_mm"),
        (["--type", "charuco", "--dictionary", "DICT_9"], "DICT_9"),
        (["--type", "charuco", "--squares", "20x15"], "150"),
    ],
)
def test_impossible_boards_are_refused_in_one_line(
    options: list[str], words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert leave("board", "-o", tmp_path / "b.pdf", *options) == 1
    error = capsys.readouterr().err
    assert words in error
    assert error.count("\n") == 1
    assert not list(tmp_path.iterdir())


def test_board_keeps_what_is_there(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "b.yaml").write_text("mine", encoding="utf-8")
    assert leave("board", "-o", tmp_path / "b.pdf") == 1
    assert "--force" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["b.yaml"]
    assert leave("board", "-o", tmp_path / "b.pdf", "--force") == 0
    assert load_board(tmp_path / "b.yaml") == Board("chessboard", (10, 7), 24.0)
    assert leave("board", "-o", tmp_path / "b.png") == 1
    assert leave("board", "-o", tmp_path / "c.pdf", "--squares", "ten") == 2


def test_started_files_load_and_are_kept(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lab = tmp_path / "lab"
    assert leave("init", lab) == 0
    assert sorted(path.name for path in lab.iterdir()) == sorted(templates())
    assert load_tube(lab / "tube.yaml").clamped
    assert load_board(lab / "board.yaml").type == "chessboard"
    ((image, pose),) = load_registration(lab / "registration.yaml")
    assert image == "000.jpg"
    # What the comment says: the board's y runs down the tube.
    assert pose.rotation[:, 1].tolist() == [0, 0, 1]
    assert load_run_config(lab / "run.yaml")["rig_path"] == lab / "rig.yaml"
    (lab / "tube.yaml").write_text("diameter_mm: 3\n", encoding="utf-8")
    (lab / "run.yaml").unlink()
    capsys.readouterr()
    assert leave("init", lab) == 0
    assert "tube.yaml: is there already, kept" in capsys.readouterr().out
    assert load_tube(lab / "tube.yaml").diameter_mm == 3
    assert (lab / "run.yaml").is_file()
    assert start_folder(lab, force=True).kept == ()
    assert load_tube(lab / "tube.yaml").diameter_mm == 12
    with pytest.raises(InputError, match="this is a file"):
        start_folder(lab / "tube.yaml")


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_small_set(tmp_path_factory.mktemp("config"))
    for path in folder.glob("photos/*/*.png"):
        if path.stem != "1":
            path.unlink()
    return folder


def test_run_from_a_file_and_again_from_its_record(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Paths start at the YAML file; the command line counts more; ``run.json`` gives the same numbers again."""
    text = "folder: photos\nrig_path: rig.yaml\ntube_path: tube.yaml\nout: results\noverlay: true\nmethod: cone_ray\n"
    (data / "run.yaml").write_text(text, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    first, again = tmp_path / "first", tmp_path / "again"
    assert leave("run", "--config", data / "run.yaml", "-o", first, "--no-overlay") == 0
    assert not (data / "results").exists()
    assert not (first / "overlay").exists()
    record = json.loads((first / "run.json").read_text(encoding="utf-8"))["configuration"]
    assert (record["method"], record["overlay"]) == ("cone_ray", False)
    assert leave("run", "--config", first / "run.json", "--out", again) == 0
    rows = [read_shapes(out / "shapes.csv")[0] for out in (first, again)]
    assert rows[0].tip_x_mm == rows[1].tip_x_mm
    assert rows[1].method == "cone_ray"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("tube_paht: tube.yaml\n", "did you mean 'tube_path'?"),
        ("overlay: perhaps\n", "overlay"),
        ("method: silhouete\n", "did you mean 'silhouette'?"),
        ("base_px: {left: [1]}\n", "base_px.left"),
        ("- folder\n", "expected keys and values"),
    ],
)
def test_bad_config_is_refused_in_one_line(
    text: str, words: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "run.yaml"
    path.write_text(text, encoding="utf-8")
    assert leave("run", "--config", path) == 1
    error = capsys.readouterr().err
    assert error.startswith(f"error: {path}: ")
    assert words in error
    assert error.count("\n") == 1


def test_config_knows_every_option_of_a_run(tmp_path: Path) -> None:
    path = tmp_path / "run.json"
    values = {"folder": "a", "rig_path": "b", "out": "c", "tube_path": None, "base_px": {"left": [1.5, 2]}}
    record = {"format": "tubesight-run/1", "configuration": values | {"tube": {"diameter_mm": 3}}, "seed": None}
    path.write_text(json.dumps(record), encoding="utf-8")
    given = load_run_config(path)
    assert RunOptions(**given) == RunOptions(Path("a"), Path("b"), Path("c"), base_px={"left": (1.5, 2.0)})
    path.write_text(json.dumps(record | {"format": "other"}), encoding="utf-8")
    with pytest.raises(InputError, match="format"):
        load_run_config(path)


def test_run_without_what_it_needs_is_wrong_usage(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert leave("run", tmp_path, "-o", tmp_path) == 2
    assert "--rig" in capsys.readouterr().err
    assert leave("run") == 2
    assert "FOLDER" in capsys.readouterr().err
