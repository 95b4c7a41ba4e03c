"""Rigs of other tools that cannot be, are mistaken for another, or are made to hurt: one line, by name."""

import random
import re
import struct
import zlib
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import scipy.io

from shared_data import shared
from test_import_formats import (
    DISTORTION,
    K1,
    K2,
    ROTATION,
    SIZE,
    TRANSLATION,
    bouguet_values,
    kalibr_chain,
    matlab_struct,
    opencv_pair,
    ros_pair,
    saved,
    storage,
)
from tubesight.cli.main import main
from tubesight.core import InputError
from tubesight.files.importers import Settings, import_rig
from tubesight.files.importers.mat import parse_mat

MIRROR = np.diag([-1.0, 1.0, 1.0])
Make = Callable[[Path], list[Path]]


def edited(path: Path, *changes: tuple[str, str]) -> Path:
    text = path.read_text(encoding="utf-8")
    for old, new in changes:
        assert old in text, old
        text = text.replace(old, new, 1)
    path.write_text(text, encoding="utf-8")
    return path


def written(path: Path, content: bytes | str) -> list[Path]:
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return [path]


def ros_with(index: int, *changes: tuple[str, str]) -> Make:
    def make(folder: Path) -> list[Path]:
        paths = list(ros_pair(folder))
        edited(paths[index], *changes)
        return paths

    return make


def ros_mirrored(folder: Path) -> list[Path]:
    """Change the sign of the first number of the rectification, and of its row."""
    paths = list(ros_pair(folder))
    text = paths[0].read_text()
    start = text.index("data: [", text.index("rectification_matrix")) + 7
    row = text[start:].split(", ")[:3]
    paths[0].write_text(text[:start] + text[start:].replace(", ".join(row), ", ".join(str(-float(x)) for x in row), 1))
    return paths


def ros_sign(folder: Path) -> list[Path]:
    """The right camera's projection with the baseline's sign changed."""
    paths = list(ros_pair(folder))
    lines = paths[1].read_text().splitlines()
    values = [float(x) for x in re.findall(r"\[(.*)\]", lines[-1])[0].split(",")]
    values[3] *= -1
    lines[-1] = f"projection_matrix: {{rows: 3, cols: 4, data: {values}}}"
    return written(paths[1], "\n".join(lines)) and paths


def kalibr_with(*changes: tuple[str, str], by: str = "T_cn_cnm1") -> Make:
    return lambda folder: [edited(kalibr_chain(folder, "brown", by), *changes)]


def kalibr_in_mm(folder: Path) -> list[Path]:
    path = kalibr_chain(folder, "brown", "T_cn_cnm1")
    for x in TRANSLATION:
        edited(path, (f", {x / 1000}]", f", {x}]"))
    return [path]


def opencv_with(**changes: object) -> Make:
    return lambda folder: [opencv_pair(folder, **changes)]


def bouguet_with(**changes: object) -> Make:
    return lambda folder: [saved(folder / "Calib_Results_stereo.mat", bouguet_values() | changes)]


def cut_mat(folder: Path) -> list[Path]:
    path = saved(folder / "rig.mat", bouguet_values())
    return written(path, path.read_bytes()[:-200])


def mat_header() -> bytes:
    return b"MATLAB 5.0 MAT-file".ljust(124) + b"\x00\x01IM"


def element(kind: int, content: bytes) -> bytes:
    return struct.pack("<II", kind, len(content)) + content + b"\0" * (-len(content) % 8 if kind != 15 else 0)


def mat_array(kind: int, shape: tuple[int, ...], *values: bytes) -> bytes:
    flags, dims = struct.pack("<II", kind, 0), struct.pack(f"<{len(shape)}i", *shape)
    return element(14, element(6, flags) + element(5, dims) + element(1, b"x") + b"".join(values))


def mat_bomb(folder: Path) -> list[Path]:
    return written(folder / "bomb.mat", mat_header() + element(15, zlib.compress(b"\0" * (80 << 20))))


def mat_nested(folder: Path) -> list[Path]:
    inner = mat_array(6, (1, 1), element(9, struct.pack("<d", 1)))
    for _ in range(2000):
        inner = mat_array(2, (1, 1), element(5, struct.pack("<i", 2)), element(1, b"a\0"), inner)
    return written(folder / "nested.mat", mat_header() + inner)


def xml(inside: str) -> str:
    return f'<?xml version="1.0"?>\n{inside}'


ENTITIES = (
    '<!DOCTYPE a [<!ENTITY a "aaaaaaaaaa"><!ENTITY b "&a;&a;&a;&a;">]>\n<opencv_storage><K>&b;</K></opencv_storage>'
)
MANY_KEYS = "M1: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [1, 2"

IDENTITY_STEP = f"cam1:\n  T_cn_cnm1: {np.eye(4).tolist()}\n"

CASES: dict[str, tuple[Make, Settings, str]] = {
    # Left and right.
    "ros: files in the wrong order": (lambda f: list(ros_pair(f))[::-1], Settings(), "left and right look swapped"),
    "ros: sign of the baseline": (ros_sign, Settings(), "left and right look swapped"),
    "ros: named the wrong way round": (
        lambda f: list(ros_pair(f)),
        Settings(names=("right", "left")),
        "left and right look swapped",
    ),
    "opencv: second camera to the left": (
        opencv_with(T=-ROTATION @ np.array([-120.0, 4, 11])),
        Settings(),
        "left and right look swapped",
    ),
    "bouguet: left and right exchanged": (
        bouguet_with(R=ROTATION.T, om=-np.array([0.03, 0.43, -0.02]), T=-ROTATION.T @ TRANSLATION),
        Settings(),
        "left and right look swapped",
    ),
    "kalibr: named the wrong way round": (
        lambda f: [kalibr_chain(f)],
        Settings(names=("cam_right", "cam_left")),
        "left and right look swapped",
    ),
    # Units.
    "opencv: metres": (
        opencv_with(T=TRANSLATION / 1000),
        Settings(),
        "look like metres; name their unit with --units m",
    ),
    "bouguet: metres": (bouguet_with(T=TRANSLATION / 1000), Settings(), "look like metres"),
    "matlab: metres": (lambda f: [saved(f / "m.mat", matlab_struct(scale=1e-3))], Settings(), "look like metres"),
    "kalibr: millimetres": (kalibr_in_mm, Settings(), "look like millimetres; name their unit with --units mm"),
    "matlab: unknown unit": (
        lambda f: [saved(f / "m.mat", matlab_struct("furlongs"))],
        Settings(),
        "unknown unit 'furl",
    ),
    "one place": (opencv_with(T=TRANSLATION * 0), Settings(), "at one place"),
    # Sizes.
    "principal point outside": (opencv_with(image_width=640, image_height=480), Settings(), "wrong image size"),
    "half the size": (opencv_with(image_width=2560, image_height=1920), Settings(), "wrong image size"),
    "width and height exchanged": (opencv_with(image_width=960, image_height=1280), Settings(), "are exchanged"),
    "ros: two sizes": (
        ros_with(1, ("1280", "1400")),
        Settings(),
        "wrong image size: the cameras have 1280x960 and 1400",
    ),
    "kalibr: two sizes": (kalibr_with(("[1280, 960]", "[1360, 960]")), Settings(), "wrong image size"),
    "another size than the file's": (
        opencv_with(),
        Settings(sizes=((1024, 768),)),
        "wrong image size: the file says 1280",
    ),
    "no size and no common one": (
        lambda f: [storage(f / "x.yml", K=K1 + np.outer((300, 0, 0), (0, 0, 1)), D=DISTORTION["brown"][0])],
        Settings(),
        "add --size WIDTHxHEIGHT",
    ),
    "half a pixel": (opencv_with(image_width=1280.5), Settings(), "whole pixels"),
    # Rotations.
    "opencv: mirrored": (opencv_with(R=MIRROR @ ROTATION), Settings(), "R: rotation is mirrored"),
    "bouguet: mirrored": (bouguet_with(R=MIRROR @ ROTATION), Settings(), "R: rotation is mirrored"),
    "bouguet: transposed": (bouguet_with(R=ROTATION.T), Settings(), "is not the rotation of om"),
    "ros: mirrored": (ros_mirrored, Settings(), "rectification_matrix: rotation is mirrored"),
    "kalibr: mirrored": (
        kalibr_with((f"  - [{ROTATION[0, 0]}", f"  - [{-ROTATION[0, 0]}")),
        Settings(),
        "T_cn_cnm1: rotation is",
    ),
    "kalibr: transposed": (
        kalibr_with(("  - [0.0, 0.0, 0.0, 1.0]", "  - [0.1, 0.0, 0.0, 1.0]")),
        Settings(),
        "last row",
    ),
    "not orthonormal": (opencv_with(R=ROTATION * 1.01), Settings(), "R: rotation is not orthonormal"),
    # Lenses.
    "ros: another lens": (ros_with(0, ("plumb_bob", "mei")), Settings(), "the lens 'mei' is not supported"),
    "ros: number of coefficients": (ros_with(0, ("plumb_bob", "equidistant")), Settings(), "5 coefficients"),
    "kalibr: field of view": (kalibr_with(("radtan", "fov")), Settings(), "the lens 'fov' is not supported"),
    "kalibr: omnidirectional": (kalibr_with(("pinhole", "omni")), Settings(), "'omni' is not supported"),
    "kalibr: no model": (
        kalibr_with(("distortion_model", "model")),
        Settings(),
        "distortion_model: this key is missing",
    ),
    "opencv: thin prism": (opencv_with(D1=(*DISTORTION["rational"][0], 0.1, 0, 0, 0)), Settings(), "thin prism"),
    "opencv: lens contradicted": (opencv_with(distortion_model="fov"), Settings(), "'fov' is not supported"),
    "--lens contradicted": (opencv_with(lens="equidistant"), Settings(lens="brown"), "--lens says 'brown'"),
    "matlab: fisheye": (
        lambda f: [saved(f / "f.mat", {"MappingCoefficients": [1.0, 2.0]})],
        Settings(),
        "Scaramuzza's fisheye lens",
    ),
    "no distortion": (
        lambda f: [storage(f / "x.yml", M1=K1, M2=K2, D2=(0.0,) * 5)],
        Settings(sizes=(SIZE,)),
        "distortion is missing",
    ),
    # Contents.
    "R without T": (
        lambda f: [storage(f / "x.yml", M1=K1, D1=(0.0,) * 5, M2=K2, D2=(0.0,) * 5, R=ROTATION)],
        Settings(sizes=(SIZE,)),
        "belong together",
    ),
    "kalibr: two ways to a pose": (
        lambda f: [edited(kalibr_chain(f, "brown", "T_cam_imu"), ("cam1:\n", IDENTITY_STEP))],
        Settings(),
        "contradicts the poses against the IMU by 121 mm",
    ),
    "ros: three files": (lambda f: [*ros_pair(f), f / "left.yaml"], Settings(), "one camera or a pair"),
    "ros: another calibration": (
        ros_with(0, ("cols: 4, data: [", "cols: 4, data: [1")),
        Settings(),
        "another focal length",
    ),
    "ros: binned": (ros_with(0, ("image_width", "binning_x: 2\nimage_width")), Settings(), "binned"),
    "a lens twice": (lambda f: [opencv_pair(f), storage(f / "again.yml", M1=K1)], Settings(), "has it too"),
    "pair and single": (
        lambda f: [opencv_pair(f), storage(f / "one.yml", K=K1, D=(0.0,) * 5)],
        Settings(),
        "import them apart",
    ),
    "poses alone": (lambda f: [storage(f / "x.yml", R=ROTATION, T=TRANSLATION)], Settings(), "no camera matrix"),
    "two formats": (lambda f: [kalibr_chain(f), opencv_pair(f)], Settings(), "import one format at a time"),
    "names that do not fit": (opencv_with(), Settings(names=("a",)), "--names has 1 names for 2"),
    "names that are one": (opencv_with(), Settings(names=("a", "a")), "'a' is there twice"),
    "names that are none": (opencv_with(), Settings(names=("a", "clamp")), "cannot be a camera's name"),
    "text for numbers": (kalibr_with(("intrinsics: [", "intrinsics: [x")), Settings(), "intrinsics: expected a number"),
    "NaN": (opencv_with(M1=K1 * np.nan), Settings(), "M1: expected finite numbers"),
    "two columns": (opencv_with(M1=K1[:, :2]), Settings(), "expected a 3 x 3 matrix, got 3 x 2"),
    "not a camera matrix": (opencv_with(M1=K1 * [[-1], [1], [1]]), Settings(), "focal lengths have to be positive"),
    "transposed camera matrix": (opencv_with(M1=K1.T), Settings(), "M1: expected rows (fx, skew, cx)"),
    "no principal point": (
        opencv_with(M1=np.diag([1000.0, 1000, 1])),
        Settings(),
        "principal point (0.0, 0.0) of left",
    ),
    "matlab object": (lambda f: [saved(f / "o.mat", {"a": 1})], Settings(), "s = toStruct(stereoParams)"),
    "matlab: views contradict": (
        lambda f: [
            saved(
                f / "v.mat",
                {
                    "M1": K1,
                    "D1": np.zeros(5),
                    "M2": K2,
                    "D2": np.zeros(5),
                    "R": ROTATION.T,
                    "T": TRANSLATION,
                    "size": SIZE,
                    "tvecs1": np.eye(3) * 300,
                    "tvecs2": np.eye(3) * 300 @ ROTATION.T + TRANSLATION,
                },
            )
        ],
        Settings(),
        "contradicts the places of the board",
    ),
    # Files that are none, or made to hurt.
    "nothing known": (lambda f: written(f / "x.yaml", "a: 1\n"), Settings(), "of none of the formats"),
    "our own rig": (
        lambda f: written(f / "x.yaml", "format: tubesight-rig/1\nunits: mm\n"),
        Settings(),
        "none of the formats",
    ),
    "empty": (lambda f: written(f / "x.yaml", ""), Settings(), "expected keys and values"),
    "a list": (lambda f: written(f / "x.yaml", "- 1\n"), Settings(), "expected keys and values"),
    "binary": (lambda f: written(f / "x.yaml", bytes(range(256))), Settings(), "neither text in UTF-8 nor"),
    "absent": (lambda f: [f / "x.yaml"], Settings(), "no such file"),
    "cut off": (lambda f: written(f / "x.yml", MANY_KEYS), Settings(), "mend that line"),
    "yaml: 200000 brackets": (lambda f: written(f / "x.yml", "M1: " + "[" * 200_000), Settings(), "nested"),
    "json: 200000 brackets": (lambda f: written(f / "x.json", '{"M1": ' + "[" * 200_000), Settings(), "nested"),
    "json: cut off": (lambda f: written(f / "x.json", '{"M1": [1, '), Settings(), "not JSON"),
    "xml: 200000 elements": (lambda f: written(f / "x.xml", xml("<a>" * 200_000)), Settings(), "nested"),
    "xml: cut off": (lambda f: written(f / "x.xml", xml("<a><b>")), Settings(), "not XML"),
    "xml: entities": (lambda f: written(f / "x.xml", xml(ENTITIES)), Settings(), "entities are not allowed"),
    "yaml: aliases": (lambda f: written(f / "x.yml", "a: &a [1, 2]\nb: [*a, *a]\n"), Settings(), "aliases"),
    "yaml: python objects": (lambda f: written(f / "x.yml", "a: !!python/name:os.system\n"), Settings(), "could not"),
    "17 MiB": (lambda f: written(f / "x.yml", b"#" * (17 << 20)), Settings(), "more than such a file can have"),
    "5 MiB of text": (lambda f: written(f / "x.yml", b"#" * (5 << 20)), Settings(), "more than a calibration has"),
    "mat: cut off": (cut_mat, Settings(), "damaged or cut off"),
    "mat: inflates to 80 MiB": (mat_bomb, Settings(), "inflates to over 64 MiB"),
    "mat: 2000 structs deep": (mat_nested, Settings(), "nested more than 16 deep"),
    "mat: version 7.3": (
        lambda f: written(f / "x.mat", b"\x89HDF\r\n\x1a\n" + b"\0" * 200),
        Settings(),
        "save it again with -v7",
    ),
}
REMEDY = r"add|remove|mend|name|save|check|write|calibrate|import|give|use|leave|is it|in MATLAB|exchange|expected keys"


@pytest.mark.parametrize("case", CASES)
def test_refused_in_one_line(case: str, tmp_path: Path) -> None:
    make, settings, expected = CASES[case]
    paths = make(tmp_path)
    with pytest.raises(InputError) as error:
        import_rig(paths, settings)
    text = str(error.value)
    assert expected in text
    assert "\n" not in text
    assert text.startswith("--names") or any(str(path) in text for path in paths)
    assert re.search(REMEDY, text)


def test_what_is_refused_by_mistake_can_be_confirmed(tmp_path: Path) -> None:
    """Unusual rigs are possible: the user says so."""
    crop = opencv_pair(tmp_path, image_width=2560, image_height=1920)
    assert import_rig([crop], Settings(sizes=((2560, 1920),)))[0].cameras["left"].size_px == (2560, 1920)
    chain = edited(kalibr_chain(tmp_path), ("[1280, 960]", "[1360, 960]"))
    assert import_rig([chain], Settings(sizes=((1360, 960), SIZE)))[0].cameras["cam1"].size_px == SIZE
    tiny = opencv_pair(tmp_path, T=TRANSLATION / 1000)
    for units, baseline_mm in (("mm", np.linalg.norm(TRANSLATION) / 1000), ("m", np.linalg.norm(TRANSLATION))):
        pose = import_rig([tiny], Settings(units=units))[0].relative_pose("right", "left")
        assert abs(np.linalg.norm(pose.translation_mm) / baseline_mm - 1) < 1e-12
    swapped = opencv_pair(tmp_path, T=-ROTATION @ np.array([-120.0, 4, 11]))
    assert import_rig([swapped], Settings(names=("right", "left")))[0].names == ("right", "left")
    assert import_rig([swapped], Settings(names=("a", "b")))[0].names == ("a", "b")


def test_cameras_at_right_angles_are_not_taken_for_swapped(tmp_path: Path) -> None:
    """Two cameras on a circle, each looking at its middle, whatever the angle between them."""
    from scipy.spatial.transform import Rotation

    for angle_deg in (20, 60, 90, 120, 150):
        turn = Rotation.from_euler("y", angle_deg, degrees=True).as_matrix()
        path = opencv_pair(tmp_path, R=turn, T=np.array([0, 0, 300]) - turn @ np.array([0, 0, 300]))
        assert import_rig([path])[0].names == ("left", "right")
    rolled = np.diag([-1.0, -1.0, 1.0])  # mounted upside down: its right is our left
    for x in (120.0, -120.0):
        assert import_rig([opencv_pair(tmp_path, R=rolled, T=-rolled @ np.array([x, 0, 0]))])[0].names == (
            "left",
            "right",
        )


@pytest.mark.parametrize("name", ["ros_left.yaml", "kalibr_tum_vi.yaml", "opencv_intrinsics.yml"])
def test_real_files_cut_off_anywhere_are_refused_or_read(name: str, tmp_path: Path) -> None:
    content = (shared("real/calibration-formats") / name).read_bytes()
    for length in range(0, len(content), 37):
        try:
            import_rig(written(tmp_path / name, content[:length]))
        except InputError as error:
            assert "\n" not in str(error)


def test_damaged_files_are_refused_or_read(tmp_path: Path) -> None:
    """Bytes changed, inserted and removed at random: a rig or one line, never anything else."""
    draw = random.Random(11)
    sources = [opencv_pair(tmp_path, ext) for ext in (".yml", ".xml", ".json")]
    sources += [
        *ros_pair(tmp_path),
        kalibr_chain(tmp_path, by="T_imu_cam"),
        saved(tmp_path / "b.mat", bouguet_values()),
    ]
    scipy.io.savemat(tmp_path / "c.mat", {"s": matlab_struct()}, do_compression=True)
    sources += [saved(tmp_path / "m.mat", matlab_struct()), tmp_path / "c.mat"]
    refused = 0
    for _ in range(1500):
        source = draw.choice(sources)
        content = bytearray(source.read_bytes())
        for _ in range(draw.choice([1, 2, 10])):
            at = draw.randrange(len(content))
            content[at : at + draw.choice([0, 1, 4, 40])] = draw.randbytes(draw.choice([0, 1, 2]))
        try:
            import_rig(written(tmp_path / f"damaged{source.suffix}", bytes(content)))
        except InputError as error:
            refused += 1
            assert "\n" not in str(error)
    assert 500 < refused < 1500


def test_matlab_files_read_as_scipy_reads_them(tmp_path: Path) -> None:
    values = bouguet_values() | {"text": "größe", "cells": np.array([1, "a"], object), "flag": np.array([True, False])}
    values |= {
        "i": np.arange(6, dtype=np.int16).reshape(2, 3),
        "empty": np.empty((0, 0)),
        "s": {"a": 1.5, "b": {"c": "d"}},
    }
    for compressed in (False, True):
        path = tmp_path / "x.mat"
        scipy.io.savemat(path, values, do_compression=compressed)
        read, wanted = parse_mat(path.read_bytes(), path), scipy.io.loadmat(path)
        assert set(read) == set(values)
        for key in set(values) - {"text", "cells", "s"}:
            assert np.array_equal(read[key], wanted[key]), key
        assert read["text"] == "größe" and read["cells"] is None
        assert read["s"] == {"a": np.array([[1.5]]), "b": {"c": "d"}}
    published = shared("real/stereo-chessboard") / "published_Calib_Results_stereo.mat"
    read, wanted = parse_mat(published.read_bytes(), published), scipy.io.loadmat(published)
    for key, value in read.items():
        assert value == wanted[key][0] if isinstance(value, str) else np.array_equal(value, wanted[key])


@pytest.mark.parametrize(
    ("args", "code", "expected"),
    [
        (("stereo.yml", "-o", "folder"), 1, "this is a folder; name the rig file"),
        (("stereo.yml", "-o", "stereo.yml"), 1, "one of the files to read"),
        (("stereo.yml", "-o", "stereo.yml/rig.yaml"), 1, "cannot be written"),
        (("absent.yml", "-o", "rig.yaml"), 1, "no such file"),
        (("stereo.yml", "-o", "rig.yaml", "--size", "640"), 2, "WIDTHxHEIGHT"),
        (("stereo.yml", "-o", "rig.yaml", "--units", "km"), 2, "--units"),
        (("stereo.yml", "-o", "rig.yaml", "--format", "bouguet"), 1, "stereo.yml: fc: this key is missing"),
        (("-o", "rig.yaml"), 2, "FILES"),
    ],
)
def test_command_refuses(
    args: tuple[str, ...],
    code: int,
    expected: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    opencv_pair(tmp_path)
    (tmp_path / "folder").mkdir()
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SystemExit) as left:
        main(["import", *args])
    captured = capsys.readouterr()
    assert left.value.code == code and captured.out == ""
    assert expected.lower() in captured.err.lower()
    assert code == 2 or re.fullmatch(r"error: [^\n]+\n", captured.err)
    assert sorted(tmp_path.rglob("*")) == before


def test_export_refuses_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as left:
        main(["rig-export", str(tmp_path / "rig.yaml"), "--format", "ros", "-o", str(tmp_path / "out")])
    assert left.value.code == 1
    assert re.fullmatch(r"error: [^\n]+no such file[^\n]+\n", capsys.readouterr().err)
    assert not (tmp_path / "out").exists()
