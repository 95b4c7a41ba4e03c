"""The data set written is one that the loaders read, and its pictures are those of its truth."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tubesight.apps.simulate import DatasetPlan, mockup_phantoms, write_dataset
from tubesight.core import Board, InputError, Tip, Tube
from tubesight.files.board import load_board
from tubesight.files.dataset import backgrounds, list_pairs
from tubesight.files.images import read_image
from tubesight.files.registration import load_registration
from tubesight.files.rig import load_rig
from tubesight.files.truth import load_truth
from tubesight.files.tube import load_tube
from tubesight.simulate import Scene, rig_around, truth

PLAN = DatasetPlan(
    {name: mockup_phantoms()[name] for name in ("arc_50", "straight")},
    rig_around(size_px=(640, 360)),
    scene=Scene(clutter=12),
    board_views=3,
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("set")
    seen: list[tuple[int, int]] = []
    write_dataset(path, PLAN, lambda done, total: seen.append((done, total)))
    # Three views of the board, two to register, two tubes, one background.
    assert seen == [(i, 8) for i in range(1, 9)]
    return path


def test_layout_is_that_of_a_real_set(folder: Path) -> None:
    assert {path.name for path in folder.iterdir()} == {
        *("left", "right", "calibration", "registration", "background"),
        *("board.yaml", "registration.yaml", "tube.yaml", "rig_true.yaml", "truth.json"),
    }
    assert [stem for stem, _ in list_pairs(folder, ("left", "right"))] == ["arc_50", "straight"]
    assert len(list_pairs(folder / "calibration", ("left", "right"))) == 3
    assert set(backgrounds(folder / "background", ("left", "right"))) == {"left", "right"}
    for pair in list_pairs(folder, ("left", "right")):
        for path in pair[1].values():
            assert read_image(path, (640, 360)).shape == (360, 640, 3)


def test_files_hold_the_plan(folder: Path) -> None:
    assert load_board(folder / "board.yaml") == PLAN.board
    assert load_tube(folder / "tube.yaml") == PLAN.tube
    rig = load_rig(folder / "rig_true.yaml").rig
    for name in PLAN.rig.names:
        np.testing.assert_array_equal(rig.cameras[name].matrix, PLAN.rig.cameras[name].matrix)
        np.testing.assert_allclose(
            rig.camera_from_base[name].matrix, PLAN.rig.camera_from_base[name].matrix, rtol=0, atol=1e-12
        )
    shapes = load_truth(folder / "truth.json")
    for name, phantom in PLAN.phantoms.items():
        np.testing.assert_allclose(shapes[name].tip_mm, truth(phantom)["tip"], rtol=0, atol=1e-12)


def test_registered_boards_are_where_the_file_says(folder: Path) -> None:
    """Corners of the written picture at the corners projected with the written pose and rig."""
    rig = load_rig(folder / "rig_true.yaml").rig
    board = load_board(folder / "board.yaml")
    views = load_registration(folder / "registration.yaml")
    assert len(views) == 2
    for image, pose in views:
        for name in rig.names:
            picture = cv2.imread(str(folder / "registration" / name / image), cv2.IMREAD_GRAYSCALE)
            expected = rig.project(name, pose.apply(board.corners_mm))
            start = np.array(expected, np.float32, order="C").reshape(-1, 1, 2)
            found = cv2.cornerSubPix(picture, start, (2, 2), (-1, -1), (3, 50, 1e-4)).reshape(-1, 2)
            # Noisy corners of squares of 10 px; another pose or corner would be a square away.
            assert np.sqrt(((found - expected) ** 2).mean()) < 0.3


def test_plain_cloth_needs_no_background_and_no_board(tmp_path: Path) -> None:
    plan = replace(
        PLAN,
        scene=Scene(),
        board_views=0,
        tube=Tube(6.0, Tip("flat")),
        board=Board("charuco", (9, 6), 14.0, 10.0, "DICT_4X4_50"),
    )
    write_dataset(tmp_path, plan)
    names = {path.name for path in tmp_path.iterdir()}
    assert names == {"left", "right", "tube.yaml", "rig_true.yaml", "truth.json"}
    assert load_tube(tmp_path / "tube.yaml") == plan.tube


def test_charuco_board_file_loads(tmp_path: Path) -> None:
    board = Board("charuco", (6, 5), 14.0, 10.0, "DICT_4X4_50")
    write_dataset(tmp_path, replace(PLAN, scene=Scene(), board_views=1, board=board))
    assert load_board(tmp_path / "board.yaml") == board


def test_truth_has_the_schema_of_the_format(folder: Path) -> None:
    data = json.loads((folder / "truth.json").read_text())
    assert data["units"] == "mm, deg"
    for frame in data["frames"]:
        assert set(frame) == {"frame", "kind", "shape", "tip", "length", "theta", "phi", "centreline"}
        assert np.shape(frame["centreline"]) == (101, 3)


def test_impossible_plans_and_places_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="at least one phantom"):
        DatasetPlan({})
    with pytest.raises(ValueError, match="file names"):
        DatasetPlan({"a/b": mockup_phantoms()["straight"]})
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="cannot be written"):
        write_dataset(tmp_path / "file" / "set", PLAN)
