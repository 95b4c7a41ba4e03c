"""The page of `capture` and of calibration folders."""

from __future__ import annotations

import threading
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tubesight.calibration.coverage import draw_coverage
from tubesight.calibration.quality import CELLS
from tubesight.cli.main import main
from tubesight.core import Board
from tubesight.simulate import board_views, render_board_pair, rig_around

pytest.importorskip("viser")

from browser import open_page
from tubesight.apps.viewer.boards import BoardFolder, arranged

BOARD = Board("chessboard", (10, 7), 13.0)
SIZE = (640, 360)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A calibration folder of three pairs, one without a board on the right, beside its board file."""
    root = tmp_path_factory.mktemp("boards")
    rig = rig_around(90.0, size_px=SIZE)
    for k, pose in enumerate(board_views(rig, BOARD, 3, np.random.default_rng(1))):
        for name, image in render_board_pair(rig, BOARD, pose, name=str(k)).images.items():
            path = root / "set" / name / f"{k}.png"
            path.parent.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(path), np.full_like(image, 90) if (k, name) == (1, "right") else image)
    (root / "board.yaml").write_text("type: chessboard\nsquares: [10, 7]\nsquare_mm: 13.0\n", encoding="utf-8")
    return root


@given(st.integers(1, 7), st.floats(0.2, 5), st.integers(1, 60), st.integers(1, 60))
def test_pictures_are_arranged_whole_in_the_shape_of_the_window(n: int, aspect: float, width: int, height: int) -> None:
    pictures = [np.full((height, width, 3), 100 + k, np.uint8) for k in range(n)]
    ground = arranged(pictures, aspect)
    # Rounding of both sides to whole pixels.
    assert abs(ground.shape[1] - aspect * ground.shape[0]) <= 1 + aspect
    for k, picture in enumerate(pictures):
        assert (ground[..., 0] == 100 + k).sum() == picture.shape[0] * picture.shape[1]


def test_cells_without_a_corner_are_tinted_and_those_with_one_are_not() -> None:
    gray = np.full((60, 80), 100, np.uint8)
    columns, rows = CELLS
    corner = np.array([[80 / columns * 2.5, 60 / rows * 1.5]])
    drawn = draw_coverage(gray, (80, 60), corner, np.zeros((0, 2)), 800)
    middles = drawn[50::100, 20::100]
    tinted = (middles != 100).any(-1)
    assert tinted.shape == (rows, columns) and not tinted[1, 2] and tinted.sum() == columns * rows - 1
    assert draw_coverage(None, (80, 60), corner, corner, 200).shape == (150, 200, 3)


def test_a_folder_is_shown_with_what_is_lacking(folder: Path, tmp_path: Path) -> None:
    boards = BoardFolder(folder / "set", folder / "board.yaml", 0)
    thread = threading.Thread(target=boards.run)
    thread.start()
    try:
        with open_page(boards.page.address, tmp_path) as page:
            assert page.until("document.body.innerText.includes('2: board in all cameras')")
            assert page.until("document.querySelector('canvas')")
            page.wait(1.0)
    finally:
        boards.stop()
        thread.join()
    text = boards.page._cameras.content
    assert "left" in text and "board, sharp" in text and "tilts span" in text
    assert "2 of 3 pairs" in boards.page._state.content, "one camera of the second pair saw none"
    assert "<li>" in boards.page._todo.content and page.problems == []


def leave(args: list[str]) -> int:
    with pytest.raises(SystemExit) as left:
        main(args)
    return int(left.value.code or 0)


def test_the_commands(folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shown = ["view", str(folder / "set"), "--board", str(folder / "board.yaml"), "--port", "0", "--pairs", "1"]
    assert leave(shown) == 0
    assert "open http://127.0.0.1:" in capsys.readouterr().err
    assert leave([*shown, "--rig", "rig.yaml"]) == 2
    assert leave(["view", str(folder), "--board", str(folder / "board.yaml"), "--port", "0"]) == 1
    assert "no subfolder of pictures" in capsys.readouterr().err
    sources = ["--source", "left=sim:", "--source", "right=sim:", "--size", "640x360", "--seconds", "2", "--view", "0"]
    leave(["capture", *sources, "--board", str(folder / "board.yaml"), "-o", str(tmp_path / "out"), "--pairs", "4"])
    assert "open http://127.0.0.1:" in capsys.readouterr().err
