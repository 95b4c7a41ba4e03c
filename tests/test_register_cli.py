"""`tubesight calibrate` and `tubesight register` as a user runs them: files, messages, exit codes."""

import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from calibration_scenes import CHESSBOARD, eye, stage, volume_mm
from tubesight.cli.main import app
from tubesight.core import InputError
from tubesight.files.rig import load_rig, save_rig
from tubesight.geometry.rig import Rig

SHOWN = stage(CHESSBOARD, [-40, 40], [eye(), eye(650.0, 650.0)], 8, seed=31)
CALIBRATION, REGISTRATION = list(SHOWN.poses)[:6], list(SHOWN.poses)[6:]
REMEDY = r"check|mend|add|put|name|take|write|count|use |calibrate|needs"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with board, calibration and registration pictures, and the rigs made of them."""
    folder = tmp_path_factory.mktemp("cli")
    pictures = SHOWN.pictures()
    for part, views in (("calibration", CALIBRATION), ("registration", REGISTRATION)):
        for camera, own in pictures.items():
            (folder / part / camera).mkdir(parents=True)
            for view in views:
                cv2.imwrite(str(folder / part / camera / f"{view}.png"), own[view]())
    (folder / "board.yaml").write_text("type: chessboard\nsquares: [10, 7]\nsquare_mm: 13.0\n")
    listed = [{"image": f"{v}.png", "base_from_board": SHOWN.poses[v].matrix.tolist()} for v in REGISTRATION]
    (folder / "registration.yaml").write_text(yaml.safe_dump({"units": "mm", "views": listed}))
    assert run(folder, "calibrate", "calibration", "--board", "board.yaml", "-o", "rig.yaml")[0] == 0
    return folder


def run(folder: Path, *args: str) -> tuple[int, str, str]:
    """Exit code, stdout and stderr; paths are relative to the folder."""
    paths = [str(folder / a) if "." in a or (folder / a).is_dir() else a for a in args]
    result = CliRunner().invoke(app, paths, prog_name="tubesight")
    if isinstance(result.exception, InputError):
        return 1, result.stdout, f"error: {result.exception}"
    assert result.exception is None or isinstance(result.exception, SystemExit), result.exception
    return result.exit_code, result.stdout, result.stderr


def register(folder: Path, *more: str, rig: str = "rig.yaml", out: str = "out.yaml") -> tuple[int, str, str]:
    return run(folder, "register", "registration", "--rig", rig, "--board", "board.yaml", "-o", out, *more)


def test_calibrate_and_register_end_with_a_verdict_and_the_next_step(made: Path) -> None:
    code, out, _ = run(
        made, "calibrate", "calibration", "--board", "board.yaml", "-o", "new/rig.yaml", "--report", "report.d"
    )
    assert code == 0
    for text in ("baseline", "epipolar", "corners cover", "usable: ", "good: ", "next: place the base frame"):
        assert text in out or text in ("usable: ", "good: ")
    assert (made / "report.d" / "report.html").is_file()
    rig = load_rig(made / "new" / "rig.yaml").rig
    assert rig.base_frame == "left"
    code, out, _ = register(made, rig="new/rig.yaml")
    assert code == 0
    assert "next: measure with `tubesight run`" in out
    rig = load_rig(made / "out.yaml").rig
    assert rig.registered
    # Six views of 800 x 600 pixels: the boards' own region is good to 0.02 mm, the volume reaches twice as far.
    assert np.median(volume_mm(rig, SHOWN.rig)) < 0.03


def test_json_is_alone_on_stdout(made: Path) -> None:
    code, out, _ = run(made, "calibrate", "calibration", "--board", "board.yaml", "-o", "j.yaml", "--json")
    assert code == 0
    data = json.loads(out)
    assert data["cameras"]["left"]["views"] == 6
    assert data["pairs"][0]["baseline_mm"] == pytest.approx(2 * 300 * np.sin(np.radians(40)), rel=0.01)
    assert data["verdict"]["next_step"]
    code, out, _ = register(made, "--json")
    assert code == 0
    assert set(json.loads(out)["registration"]["deviation_mm"]) == set(REGISTRATION)


def test_registering_again_starts_from_the_calibration(made: Path) -> None:
    register(made, out="once.yaml")
    code, _, _ = register(made, rig="once.yaml", out="twice.yaml")
    assert code == 0
    once, twice = (load_rig(made / f"{n}.yaml").rig for n in ("once", "twice"))
    # Two starts of one problem: the solver stops a hundredth of a deviation (0.1 px) from the minimum.
    assert once.cameras["left"].matrix == pytest.approx(twice.cameras["left"].matrix, abs=0.01)
    assert once.covariance is not None
    assert twice.covariance is not None
    assert once.covariance.matrix == pytest.approx(twice.covariance.matrix, rel=0.05, abs=1e-9)


@pytest.mark.parametrize("place", ["beside", "inside", "named", "outer"])
def test_registration_yaml_is_found(made: Path, tmp_path: Path, place: str) -> None:
    shutil.copytree(made, tmp_path / "set")
    folder = tmp_path / "set"
    more: tuple[str, ...] = ()
    if place == "inside":
        (folder / "registration.yaml").rename(folder / "registration" / "registration.yaml")
    elif place == "named":
        (folder / "registration.yaml").rename(folder / "poses.yaml")
        more = ("--registration", "poses.yaml")
    if place == "outer":
        code, _, err = run(folder, "register", ".", "--rig", "rig.yaml", "--board", "board.yaml", "-o", "out.yaml")
    else:
        code, _, err = register(folder, *more)
    assert code == 0, err


def test_points_need_no_board_and_no_folder(made: Path) -> None:
    points = np.array([0.0, 0, 80]) + np.random.default_rng(0).uniform(-40, 40, (8, 3))
    px = np.concatenate([SHOWN.rig.project(c, points) for c in ("left", "right")], 1)
    rows = [f"p{i}," + ",".join(f"{v:.4f}" for v in [*points[i], *px[i]]) for i in range(8)]
    rows[0] = rows[0].rsplit(",", 2)[0] + ",,"
    head = "name,x_mm,y_mm,z_mm,left_x_px,left_y_px,right_x_px,right_y_px"
    (made / "points.csv").write_text("\n".join([head, *rows]))
    code, _, err = run(made, "register", "--points", "points.csv", "--rig", "rig.yaml", "-o", "by_points.yaml")
    assert code == 0, err
    assert np.median(volume_mm(load_rig(made / "by_points.yaml").rig, SHOWN.rig)) < 0.03


def lens_only(folder: Path) -> None:
    save_rig(folder / "rig.yaml", Rig(SHOWN.rig.cameras, {}, "left"))


def test_a_rig_of_lenses_only_is_placed(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made, tmp_path / "set")
    lens_only(tmp_path / "set")
    code, _, err = register(tmp_path / "set")
    assert code == 0
    assert "no observations" in err
    assert load_rig(tmp_path / "set" / "out.yaml").rig.registered


def rewrite(name: str, change: Callable[[dict], None]) -> Callable[[Path], None]:  # type: ignore[type-arg]
    def apply(folder: Path) -> None:
        data = yaml.safe_load((folder / name).read_text())
        change(data)
        (folder / name).write_text(yaml.safe_dump(data))

    return apply


def blank_all(folder: Path) -> None:
    for path in folder.glob("*/*/*.png"):
        cv2.imwrite(str(path), np.full((600, 800), 90, np.uint8))


def drop(*names: str) -> Callable[[Path], None]:
    def apply(folder: Path) -> None:
        for name in names:
            path = folder / name
            shutil.rmtree(path) if path.is_dir() else path.unlink()

    return apply


def few_views(folder: Path) -> None:
    for view in CALIBRATION[2:]:
        drop(f"calibration/left/{view}.png", f"calibration/right/{view}.png")(folder)


def other_size(folder: Path) -> None:
    cv2.imwrite(str(folder / "calibration" / "left" / f"{CALIBRATION[3]}.png"), np.full((500, 800), 90, np.uint8))


CALIBRATE = {
    "no board": (blank_all, "none of the 6 pictures"),
    "larger board": (rewrite("board.yaml", lambda d: d.update(squares=[12, 9])), "squares"),
    "smaller board": (rewrite("board.yaml", lambda d: d.update(squares=[8, 5])), "squares"),
    "charuco": (
        rewrite("board.yaml", lambda d: d.update(type="charuco", marker_mm=9.0, dictionary="DICT_4X4_50")),
        "ChArUco board of 10 x 7",
    ),
    "dictionary": (
        rewrite("board.yaml", lambda d: d.update(type="charuco", marker_mm=9.0, dictionary="DICT_4X5")),
        "board.yaml: dictionary: OpenCV has no 'DICT_4X5'",
    ),
    "too few views": (few_views, "found in 2 pictures, 4 are needed"),
    "sizes": (other_size, "800 x 500 pixels"),
    "no mate": (drop(f"calibration/right/{CALIBRATION[0]}.png"), "this picture has no mate right/"),
    "no cameras": (drop("calibration/left", "calibration/right"), "no subfolder with pictures"),
    "no folder": (drop("calibration"), "no such folder"),
    "no board file": (drop("board.yaml"), "no such file"),
    "tiny board": (rewrite("board.yaml", lambda d: d.update(squares=[3, 3])), "at least 4 columns"),
}


@pytest.mark.parametrize("case", CALIBRATE)
def test_bad_input_of_calibrate_is_one_line_with_a_remedy(made: Path, tmp_path: Path, case: str) -> None:
    shutil.copytree(made, tmp_path / "set")
    folder = tmp_path / "set"
    spoil, text = CALIBRATE[case]
    spoil(folder)
    code, out, err = run(folder, "calibrate", str(folder / "calibration"), "--board", "board.yaml", "-o", "x/rig.yaml")
    one_line(code, out, err, text)
    assert not (folder / "x").exists()


def one_line(code: int, out: str, err: str, text: str) -> None:
    assert code == 1
    assert out == ""
    assert text in err
    assert "\n" not in err.strip()
    assert str(Path("/")) in err, "the message names the file"
    assert re.search(REMEDY, err), err


def wrong_image(data: dict) -> None:  # type: ignore[type-arg]
    data["views"][1]["image"] = "nine.png"


REGISTER = {
    "no board": (blank_all, "none of the 4 pictures"),
    "picture not there": (rewrite("registration.yaml", wrong_image), "'nine.png' is not in"),
    "listed twice": (
        rewrite("registration.yaml", lambda d: d["views"].append(json.loads(json.dumps(d["views"][0])))),
        "is listed twice",
    ),
    "no poses": (drop("registration.yaml"), "no registration.yaml here or in the folder above"),
    "no pictures": (drop("registration/left", "registration/right"), "no subfolder with pictures for left, right"),
    "no rig": (drop("rig.yaml"), "no such file"),
    "smaller board": (rewrite("board.yaml", lambda d: d.update(squares=[8, 5])), "squares"),
    "torn observations": (
        rewrite("rig.yaml", lambda d: d["calibration"]["observations"][0].update(px="1 2 3")),
        "cannot read the observations",
    ),
    "strange observations": (
        rewrite("rig.yaml", lambda d: d["calibration"]["observations"][0].update(picture="top/1.png")),
        "not of the file's cameras",
    ),
}


@pytest.mark.parametrize("case", REGISTER)
def test_bad_input_of_register_is_one_line_with_a_remedy(made: Path, tmp_path: Path, case: str) -> None:
    shutil.copytree(made, tmp_path / "set")
    folder = tmp_path / "set"
    spoil, text = REGISTER[case]
    spoil(folder)
    one_line(*register(folder, out="x/rig.yaml"), text)
    assert not (folder / "x").exists()


def test_pictures_of_another_size_than_the_rig_are_refused(made: Path, tmp_path: Path) -> None:
    shutil.copytree(made, tmp_path / "set")
    folder = tmp_path / "set"
    cv2.imwrite(str(folder / "registration" / "left" / f"{REGISTRATION[0]}.png"), np.full((500, 800), 90, np.uint8))
    one_line(*register(folder), "calibrated with 800 x 600")


@pytest.mark.parametrize(
    ("rows", "text"),
    [
        (["a,0,0,0,400,300,400,300", "b,10,0,0,420,300,400,320", "c,0,10,0,400,330,410,300"], "3 are seen by two"),
        ([f"p{i},0,0,{10 * i},400,{300 + 10 * i},400,{300 + 10 * i}" for i in range(6)], "on a line"),
    ],
)
def test_bad_points_are_refused(made: Path, tmp_path: Path, rows: list[str], text: str) -> None:
    head = "name,x_mm,y_mm,z_mm,left_x_px,left_y_px,right_x_px,right_y_px"
    (tmp_path / "points.csv").write_text("\n".join([head, *rows]))
    shutil.copy(made / "rig.yaml", tmp_path)
    one_line(*run(tmp_path, "register", "--points", "points.csv", "--rig", "rig.yaml", "-o", "x/rig.yaml"), text)
    assert not (tmp_path / "x").exists()


def test_wrong_usage_is_told_apart(made: Path) -> None:
    code, _, _ = run(made, "register", "registration", "--rig", "rig.yaml", "-o", "x.yaml")
    assert code == 2
    code, _, _ = run(made, "register", "--rig", "rig.yaml", "-o", "x.yaml")
    assert code == 2


def test_a_folder_is_not_overwritten(made: Path) -> None:
    code, _, err = run(made, "calibrate", "calibration", "--board", "board.yaml", "-o", "registration")
    assert code == 1
    assert "this is a folder" in err
