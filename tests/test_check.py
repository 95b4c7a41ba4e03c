"""Check: a rig that is still right, and one in which something moved."""

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from tubesight.apps.check import Checked, check_board, check_tube
from tubesight.calibration.drift import Drift, Motion, explain
from tubesight.calibration.quality import PairQuality
from tubesight.cli.main import main
from tubesight.core import Board, FramePair, Image, Tip, Tube
from tubesight.files.rig import save_rig
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.simulate import Arc, board_views, render_board_pair, render_pair, rig_around

BOARD = Board("chessboard", (10, 7), 13.0)
RIG = rig_around(90.0, size_px=(960, 540))
# RMS of the calibration as the rig files here state it; renders fit within 0.02 px.
OWN_PX = 0.05


def write(folder: Path, pairs: list[Mapping[str, Image]]) -> Path:
    for number, images in enumerate(pairs):
        for name, image in images.items():
            (folder / name).mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(folder / name / f"{number:03d}.png"), image)
    return folder


def moved(camera: str, turn_deg: tuple[float, float, float], shift_mm: tuple[float, float, float] = (0, 0, 0)) -> Rig:
    """The rig with one camera turned about its own centre, then shifted along its own axes."""
    poses = dict(RIG.camera_from_base)
    poses[camera] = Pose.from_rotvec(np.radians(turn_deg), np.array(shift_mm, float)) @ poses[camera]
    return Rig(RIG.cameras, poses)


def refocused(camera: str, by_px: float) -> Rig:
    return RIG.perturbed(f"{camera}.f", by_px)


@pytest.fixture(scope="module")
def photographs(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Rig], Path]:
    poses = board_views(RIG, BOARD, 3, np.random.default_rng(5))

    def take(rig: Rig) -> Path:
        folder = tmp_path_factory.mktemp("today")
        pairs: list[FramePair] = [render_board_pair(rig, BOARD, pose, name=str(i)) for i, pose in enumerate(poses)]
        return write(folder, [pair.images for pair in pairs])

    return take


@pytest.fixture(scope="module")
def files(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """rig.yaml and board.yaml."""
    folder = tmp_path_factory.mktemp("files")
    save_rig(folder / "rig.yaml", RIG, {"rms_px": OWN_PX})
    (folder / "board.yaml").write_text("type: chessboard\nsquares: [10, 7]\nsquare_mm: 13.0\n", encoding="utf-8")
    return folder / "rig.yaml", folder / "board.yaml"


def test_rig_that_is_right(
    photographs: Callable[[Rig], Path], files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    rig, board = files
    with pytest.raises(SystemExit) as left:
        main(["check", str(photographs(RIG)), "--rig", str(rig), "--board", str(board)])
    assert left.value.code == 0
    assert "the rig is still right: boards fit within" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("rig", "said"),
    [
        # 0.05 degrees are 0.49 px here; across and along the baseline.
        (moved("left", (0.05, 0.0, 0.0)), "left probably moved: it is turned by 0.05 degrees and shifted by 0.0 mm"),
        (moved("right", (0.1, 0.25, 0.1)), "right probably moved: it is turned by 0.29 degrees and shifted by 0.0 mm"),
        (refocused("left", 6.0), "the focal length of left changed"),
    ],
)
def test_what_moved_is_named(
    rig: Rig,
    said: str,
    photographs: Callable[[Rig], Path],
    files: tuple[Path, Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as left:
        main(["check", str(photographs(rig)), "--rig", str(files[0]), "--board", str(files[1])])
    out = capsys.readouterr().out
    assert left.value.code == 1
    assert "the rig is no longer right" in out and said in out


def test_third_camera_tells_which_one(tmp_path: Path) -> None:
    """Of three cameras two agree: the motion of the third is certain, also a mere shift."""
    rig = rig_around(45.0, size_px=(960, 540), names=("a", "b", "c"))
    poses = dict(rig.camera_from_base)
    poses["b"] = Pose(np.eye(3), np.array([0.0, 1.0, 0.0])) @ poses["b"]
    views = board_views(rig, BOARD, 3, np.random.default_rng(2))
    taken = [
        render_board_pair(Rig(rig.cameras, poses), BOARD, view, name=str(i)).images for i, view in enumerate(views)
    ]
    save_rig(tmp_path / "rig.yaml", rig, {"rms_px": OWN_PX})
    (tmp_path / "board.yaml").write_text("type: chessboard\nsquares: [10, 7]\nsquare_mm: 13.0\n", encoding="utf-8")
    checked = check_board(write(tmp_path / "today", taken), tmp_path / "rig.yaml", tmp_path / "board.yaml")
    assert not checked.right
    assert checked.reason == "b moved: it is turned by 0.00 degrees and shifted by 1.0 mm"


def test_board_of_another_size(photographs: Callable[[Rig], Path], files: tuple[Path, Path], tmp_path: Path) -> None:
    (tmp_path / "board.yaml").write_text("type: chessboard\nsquares: [10, 7]\nsquare_mm: 13.1\n", encoding="utf-8")
    checked = check_board(photographs(RIG), files[0], tmp_path / "board.yaml")
    assert not checked.right
    # 13.0 / 13.1
    assert "sizes come out -0.76 %" in checked.reason


def test_board_that_moved_between_the_cameras(photographs: Callable[[Rig], Path], files: tuple[Path, Path]) -> None:
    """One bad pair of three does not condemn the rig, and is named."""
    folder = photographs(RIG)
    (pose,) = board_views(RIG, BOARD, 1, np.random.default_rng(9))
    for name, shift in (("left", 0.0), ("right", 2.0)):
        image = render_board_pair(RIG, BOARD, Pose(pose.rotation, pose.translation_mm + shift)).images[name]
        cv2.imwrite(str(folder / name / "002.png"), image)
    checked = check_board(folder, *files)
    assert checked.right
    assert "pair 002 alone does not fit: the board moved between its pictures" in checked.remarks


def test_json(photographs: Callable[[Rig], Path], files: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["check", str(photographs(RIG)), "--rig", str(files[0]), "--board", str(files[1]), "--json"])
    result = json.loads(capsys.readouterr().out)
    assert result["right"] is True and result["calibration_rms_px"] == OWN_PX
    assert result["rms_px"] < 0.05 < result["limit_px"] and result["pairs"][0]["epipolar_px"] < 0.05
    assert abs(result["scale"] - 1) < 1e-4 and set(result["views"]) == {"000", "001", "002"}


def test_inputs_that_cannot_be_used(
    photographs: Callable[[Rig], Path], files: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = photographs(RIG)
    blank = np.full((540, 960, 3), 120, np.uint8)
    empty = write(tmp_path / "empty", [{"left": blank, "right": blank}])
    lens_only = tmp_path / "lens.yaml"
    save_rig(lens_only, Rig(RIG.cameras, {}, "left"))
    for args, said in (
        ([folder, "--rig", files[0]], "does not say with which board it was calibrated"),
        ([empty, "--rig", files[0], "--board", files[1]], "none of"),
        ([folder, "--rig", lens_only, "--board", files[1]], "there is nothing to check yet"),
        ([tmp_path / "nowhere", "--rig", files[0], "--board", files[1]], "no such folder"),
    ):
        with pytest.raises(SystemExit) as left:
            main(["check", *map(str, args)])
        err = capsys.readouterr().err
        assert left.value.code == 1 and said in err and err.count("error: ") == 1, said
    with pytest.raises(SystemExit) as left:
        main(["check", str(folder), "--rig", str(files[0]), "--board", "b.yaml", "--tube", "t.yaml"])
    assert left.value.code == 2


@pytest.fixture(scope="module")
def tube_pictures(tmp_path_factory: pytest.TempPathFactory) -> Callable[[Rig], Path]:
    tube = Tube(12.0, Tip("ball", 16.0), clamped=True)
    shapes = [Arc(np.radians(30), phi, 140.0) for phi in (0.3, 2.0, 4.0)]

    def take(rig: Rig) -> Path:
        folder = tmp_path_factory.mktemp("tube")
        text = "diameter_mm: 12.0\ntip: {shape: ball, diameter_mm: 16.0}\nclamped: true\n"
        (folder / "tube.yaml").write_text(text, encoding="utf-8")
        return write(folder, [render_pair(rig, shape, tube, name=str(i)).images for i, shape in enumerate(shapes)])

    return take


def test_tips_alone(tube_pictures: Callable[[Rig], Path], files: tuple[Path, Path]) -> None:
    def checked(rig: Rig) -> Checked:
        folder = tube_pictures(rig)
        return check_tube(folder, files[0], folder / "tube.yaml")

    assert checked(RIG).right
    # Turned about its x axis by 0.2 degrees: 2 px across the epipolar lines, half of them in each picture.
    assert not checked(moved("right", (0.2, 0.0, 0.0))).right


def test_words_for_what_cannot_be_told() -> None:
    pair = PairQuality(("left", "right"), 3, 400.0, 90.0, 90.0, 2.0, 1.0)
    base = Drift({("left", "0"): 1.0}, {"left": 0.05, "right": 0.05}, (pair,), 1.0, 0.2, 1.0, (), {}, (), ())
    slid = (Motion("left", 0.0, 1.0, 0.05), Motion("right", 0.0, 1.0, 0.05))
    assert "left or right moved" in explain(replace(base, motions=slid))
    several = (Motion("left", 0.0, 1.0, 0.9), Motion("right", 0.0, 1.0, 0.8))
    assert "several moved" in explain(replace(base, motions=several))
    assert "no longer fit its own lens" in explain(replace(base, alone_px={"left": 0.9, "right": 0.05}))
    assert explain(replace(base, rms_px=0.1)) == ""
