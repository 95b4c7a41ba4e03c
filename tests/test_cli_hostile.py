"""Inputs nobody should have to fear: one line that names the file and the remedy, and nothing left behind."""

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from small_set import write_small_set
from test_files_images import png_bomb
from tubesight.cli.main import main
from tubesight.files.rig import load_rig, save_rig
from tubesight.geometry.rig import Rig


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One pair: what is wrong with a picture is then wrong with the data set."""
    folder = write_small_set(tmp_path_factory.mktemp("template"))
    for path in folder.glob("photos/*/*"):
        if path.stem != "1":
            path.unlink()
    return folder


def replaced(name: str, old: str, new: str) -> Callable[[Path], Path]:
    def spoil(data: Path) -> Path:
        path = data / name
        text = path.read_text(encoding="utf-8")
        assert old in text
        path.write_text(text.replace(old, new, 1), encoding="utf-8")
        return path

    return spoil


def written(name: str, content: bytes) -> Callable[[Path], Path]:
    def spoil(data: Path) -> Path:
        path = data / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
        return path

    return spoil


def removed(name: str, named: str | None = None) -> Callable[[Path], Path]:
    def spoil(data: Path) -> Path:
        path = data / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()
        return data / (named or name)

    return spoil


def cut(name: str) -> Callable[[Path], Path]:
    def spoil(data: Path) -> Path:
        path = data / name
        path.write_bytes(path.read_bytes()[:-100])
        return path

    return spoil


def emptied(data: Path) -> Path:
    for path in data.glob("photos/*/*"):
        path.unlink()
    return data / "photos"


def as_jpeg(data: Path) -> Path:
    """Replace the left picture by a JPEG without its end, of which OpenCV would return the first part."""
    path = data / "photos/left/1.png"
    jpeg = cv2.imencode(".jpg", cv2.imread(str(path)))[1].tobytes()
    path.unlink()
    return written("photos/left/1.jpg", jpeg[: len(jpeg) // 2])(data)


def mirrored(data: Path) -> Path:
    """Change the sign of the first row of a pose."""
    path = data / "rig.yaml"
    lines = path.read_text(encoding="utf-8").splitlines()
    at = next(i for i, line in enumerate(lines) if "camera_from_base" in line) + 1
    row = [float(x) for x in re.findall(r"[-\d.e]+", lines[at].split("[")[1])]
    lines[at] = lines[at].split("[")[0] + str([-x for x in row])
    path.write_text("\n".join(lines), encoding="utf-8")
    return path


def lens_alone(data: Path) -> Path:
    rig = load_rig(data / "rig.yaml").rig
    save_rig(data / "rig.yaml", Rig(rig.cameras, {}, "left"))
    return data / "rig.yaml"


SMALL_PICTURE = cv2.imencode(".png", np.zeros((48, 64, 3), np.uint8))[1].tobytes()
ALIASES = ("a: &a [x, x]\n" + "\n".join(f"a{n}: &a{n} [*a{n - 1 if n else ''}, *a]" for n in range(40))).encode()

CASES: dict[str, tuple[Callable[[Path], Path], str]] = {
    "no rig": (removed("rig.yaml"), "no such file"),
    "no tube file": (removed("tube.yaml"), "no such file"),
    "no data set": (removed("photos"), "no such folder"),
    "no folder of a camera": (removed("photos/left", "photos"), "no subfolder 'left'"),
    "no pictures": (emptied, "no pictures here"),
    "picture without its mate": (removed("photos/right/1.png", "photos/right"), "no pictures here"),
    "one picture more": (written("photos/left/2.png", SMALL_PICTURE), "has no mate right/2;"),
    "cut-off JPEG": (as_jpeg, "cut off"),
    "cut-off PNG": (cut("photos/right/1.png"), "cut off"),
    "empty picture": (written("photos/left/1.png", b""), "empty"),
    "text as picture": (written("photos/left/1.png", b"not a picture"), "not a PNG"),
    "picture of 30000 x 30000": (written("photos/left/1.png", png_bomb(30_000)), "100 megapixels"),
    "other size": (written("photos/left/1.png", SMALL_PICTURE), "calibrated with 960 x 540"),
    "other size of the background": (
        written("photos/background/left/1.png", SMALL_PICTURE),
        "calibrated with 960 x 540",
    ),
    "typo in the rig": (replaced("rig.yaml", "distortion", "distorsion"), "did you mean 'distortion'?"),
    "typo in the tube": (replaced("tube.yaml", "clamped", "clampde"), "did you mean 'clamped'?"),
    "NaN in the rig": (replaced("rig.yaml", "0.058", ".nan"), "finite number"),
    "mirrored rig": (mirrored, "mirrored"),
    "lens alone": (lens_alone, "tubesight register"),
    "alias bomb": (written("rig.yaml", ALIASES), "aliases"),
    "200000 brackets": (written("rig.yaml", b"[" * 200_000), "nested"),
    "200000 brackets in the tube": (written("tube.yaml", b"a: " + b"{" * 200_000), "nested"),
    "17 MiB of rig": (written("rig.yaml", b"#" * (17 << 20)), "more than such a file can have"),
    "binary rig": (written("rig.yaml", bytes(range(256))), "UTF-8"),
    "empty tube": (written("tube.yaml", b""), "empty"),
}
# What a remedy sounds like: an imperative.
REMEDY = r"check|did you mean|put|take|use |add|mend|write|save|scale|calibrate|is it|name|aliases|known"


@pytest.mark.parametrize("case", CASES)
def test_run_refuses_in_one_line(case: str, template: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    data = tmp_path / "data"
    shutil.copytree(template, data)
    spoil, expected = CASES[case]
    culprit = spoil(data)
    out = tmp_path / "out"
    args = ["run", data / "photos", "--rig", data / "rig.yaml", "--tube", data / "tube.yaml", "-o", out, "--overlay"]
    with pytest.raises(SystemExit) as left:
        main([str(arg) for arg in args])
    captured = capfd.readouterr()
    assert left.value.code == 1
    assert captured.out == ""
    assert re.fullmatch(r"error: [^\n]+\n", captured.err), captured.err
    assert expected in captured.err
    assert str(culprit) in captured.err
    assert re.search(REMEDY, captured.err), captured.err
    assert not out.exists(), "something half written"


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere")
def test_results_that_cannot_be_written_are_refused_first(template: Path, tmp_path: Path) -> None:
    tmp_path.chmod(0o500)
    args = ["run", template / "photos", "--rig", template / "rig.yaml", "-o", tmp_path / "out"]
    with pytest.raises(SystemExit) as left:
        main([str(arg) for arg in args])
    assert left.value.code == 1


def test_results_below_a_file_are_refused_first(
    template: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    args = ["run", template / "photos", "--rig", template / "rig.yaml", "-o", tmp_path / "file" / "out"]
    with pytest.raises(SystemExit) as left:
        main([str(arg) for arg in args])
    assert left.value.code == 1
    assert "results cannot be written there; name a folder" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("name", "content", "expected"),
    [
        ("shapes.csv", None, "no such file"),
        ("shapes.csv", b"frame\n1\n", "column 'tube' is missing"),
        ("curves.npz", b"PK\x03\x04", "not a table of curves"),
        ("truth.json", b'{"units": "mm, deg", "frames": NaN}', "frames"),
        ("truth.json", b"[" * 200_000, "nested"),
        ("truth.json", b'{"units": "mm, deg"', "not JSON"),
    ],
)
def test_evaluate_refuses_in_one_line(
    name: str, content: bytes | None, expected: str, template: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    from tubesight.files.tables import Curves, ShapeRow, write_curves, write_shapes

    write_shapes(tmp_path / "shapes.csv", [ShapeRow("1", status="tip_not_found")])
    write_curves(tmp_path / "curves.npz", Curves((), np.zeros((0, 2)), np.zeros((0, 2, 3)), np.zeros((0, 2))))
    shutil.copy(template / "truth.json", tmp_path)
    if content is None:
        (tmp_path / name).unlink()
    else:
        (tmp_path / name).write_bytes(content)
    with pytest.raises(SystemExit) as left:
        main(["evaluate", str(tmp_path), "--truth", str(tmp_path / "truth.json")])
    captured = capfd.readouterr()
    assert left.value.code == 1 and captured.out == ""
    assert re.fullmatch(r"error: [^\n]+\n", captured.err) and expected in captured.err
    assert str(tmp_path / name) in captured.err
