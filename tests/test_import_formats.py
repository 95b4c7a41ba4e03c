"""Rigs of other tools project as those tools do: 1000 points against OpenCV or the format's own formula."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io

from shared_data import shared
from tubesight.cli import import_, rig_export
from tubesight.cli.main import main
from tubesight.core import Array, InputError
from tubesight.files.exporters import EXPORTERS
from tubesight.files.importers import IMPORTERS, UNITS, Settings, import_rig
from tubesight.files.rig import load_rig, save_rig
from tubesight.geometry.camera import Camera
from tubesight.geometry.lens import LENSES
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig

# Coordinates of some 1000 px in double precision, through a dozen operations: 1e-12 px; the requirement is 1e-9 px.
TOLERANCE_PX = 1e-9

SIZE = (1280, 960)
K1 = np.array([[1010.5, 0.0, 652.25], [0.0, 1008.75, 471.5], [0.0, 0.0, 1.0]])
K2 = np.array([[1021.0, 0.0, 630.125], [0.0, 1020.25, 488.0], [0.0, 0.0, 1.0]])
DISTORTION = {
    "brown": ((-0.21, 0.08, 0.0011, -0.0007, 0.013), (-0.19, 0.06, -0.0008, 0.0012, 0.02)),
    "rational": (
        (0.11, -0.04, 0.001, -0.0006, 0.002, 0.3, -0.05, 0.004),
        (0.1, -0.03, 0.002, 0.0005, 0, 0.28, 0.01, 0),
    ),
    "equidistant": ((0.021, -0.008, 0.004, -0.001), (0.018, -0.006, 0.002, 0.0005)),
}
# The second camera stands 120 mm to the right, turned inwards by 25 degrees and tilted a little.
ROTATION = cv2.Rodrigues(np.array([0.03, 0.43, -0.02]))[0]
TRANSLATION = -ROTATION @ np.array([120.0, 4.0, 11.0])


def points_mm() -> Array:
    """A thousand points in front of both cameras."""
    return np.random.default_rng(5).uniform((-60, -60, 260), (160, 60, 500), (1000, 3))


def opencv_px(points: Array, k: Array, distortion: Any, lens: str, rotation: Array, translation: Array) -> Array:
    coefficients = np.array(distortion, float)
    if lens == "equidistant":
        rvec = cv2.Rodrigues(rotation)[0]
        return cv2.fisheye.projectPoints(points[:, None], rvec, translation, k, coefficients)[0].reshape(-1, 2)
    return cv2.projectPoints(points, rotation, translation, k, coefficients)[0].reshape(-1, 2)


def assert_projects(rig: Rig, lens: str, k: tuple[Array, Array] = (K1, K2), poses: bool = True) -> None:
    points = points_mm()
    wanted = {
        0: opencv_px(points, k[0], DISTORTION[lens][0], lens, np.eye(3), np.zeros(3)),
        1: opencv_px(points, k[1], DISTORTION[lens][1], lens, ROTATION, TRANSLATION),
    }
    for index, name in enumerate(rig.names):
        assert rig.cameras[name].lens == lens and rig.cameras[name].size_px == SIZE
        if poses:
            got = rig.project(name, points)
        else:
            got = rig.cameras[name].project(points if index == 0 else points @ ROTATION.T + TRANSLATION)
        assert np.abs(got - wanted[index]).max() < TOLERANCE_PX


def storage(path: Path, **entries: Any) -> Path:
    """Write a file with OpenCV's own writer."""
    file = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for key, value in entries.items():
        file.write(key, np.atleast_2d(value) if isinstance(value, np.ndarray | tuple) else value)
    file.release()
    return path


def opencv_pair(folder: Path, ext: str = ".yml", lens: str = "brown", **changes: Any) -> Path:
    d = DISTORTION[lens]
    entries = {"M1": K1, "D1": d[0], "M2": K2, "D2": d[1], "R": ROTATION, "T": TRANSLATION}
    size = {"image_width": SIZE[0], "image_height": SIZE[1], "fisheye_model": int(lens == "equidistant")}
    return storage(folder / f"stereo{ext}", **(entries | size | changes))


def matrix_text(values: Any) -> str:
    rows = np.atleast_2d(values)
    return f"{{rows: {len(rows)}, cols: {rows.shape[1]}, data: {rows.ravel().tolist()}}}"


def ros_pair(folder: Path, lens: str = "brown", vertical: bool = False) -> tuple[Path, Path]:
    """Rectified by OpenCV, metres, as camera_calibration does."""
    translation = TRANSLATION[[1, 0, 2]] if vertical else TRANSLATION
    r1, r2, p1, p2, *_ = cv2.stereoRectify(
        K1, np.zeros(5), K2, np.zeros(5), SIZE, ROTATION, translation[:, None] / 1000
    )
    model = {"brown": "plumb_bob", "rational": "rational_polynomial", "equidistant": "equidistant"}[lens]
    paths = []
    for name, k, d, r, p in (("left", K1, DISTORTION[lens][0], r1, p1), ("right", K2, DISTORTION[lens][1], r2, p2)):
        path = folder / f"{name}.yaml"
        path.write_text(
            f"image_width: {SIZE[0]}\nimage_height: {SIZE[1]}\ncamera_name: rig/{name}\n"
            f"camera_matrix: {matrix_text(k)}\ndistortion_model: {model}\ndistortion_coefficients: {matrix_text(d)}\n"
            f"rectification_matrix: {matrix_text(r)}\nprojection_matrix: {matrix_text(p)}\n",
            encoding="utf-8",
        )
        paths.append(path)
    return paths[0], paths[1]


def transform(rotation: Array, translation_mm: Array) -> Array:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = rotation, np.asarray(translation_mm) / 1000
    return made


def kalibr_chain(folder: Path, lens: str = "brown", by: str = "T_cn_cnm1", **changes: str) -> Path:
    """A chain in metres with its poses written in one of three ways."""
    cam0_from_imu = transform(cv2.Rodrigues(np.array([0.5, -1.2, 0.8]))[0], np.array([30.0, -20.0, 55.0]))
    cam1_from_cam0 = transform(ROTATION, TRANSLATION)
    keys = [{}, {}]
    for index, pose in enumerate((cam0_from_imu, cam1_from_cam0 @ cam0_from_imu)):
        if by == "T_cn_cnm1" and index:
            keys[1]["T_cn_cnm1"] = cam1_from_cam0
        elif by == "T_cam_imu":
            keys[index]["T_cam_imu"] = pose
        elif by == "T_imu_cam":
            keys[index]["T_imu_cam"] = np.linalg.inv(pose)
    text = "%YAML:1.0\n"
    for index, (k, d) in enumerate(zip((K1, K2), DISTORTION[lens], strict=True)):
        coefficients = d[:4]
        text += (
            f"cam{index}:\n  camera_model: pinhole\n  distortion_coeffs: {list(coefficients)}\n"
            f"  distortion_model: {'equidistant' if lens == 'equidistant' else 'radtan'}\n"
            f"  intrinsics: [{k[0, 0]}, {k[1, 1]}, {k[0, 2]}, {k[1, 2]}]\n  resolution: [{SIZE[0]}, {SIZE[1]}]\n"
        )
        for key, value in keys[index].items():
            text += f"  {key}:\n" + "".join(f"  - {row}\n" for row in value.tolist())
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    path = folder / "camchain.yaml"
    path.write_text(text, encoding="utf-8")
    return path


def bouguet_values() -> dict[str, Any]:
    values: dict[str, Any] = {"om": cv2.Rodrigues(ROTATION)[0], "T": TRANSLATION[:, None], "R": ROTATION}
    for side, k, d in (("left", K1, DISTORTION["brown"][0]), ("right", K2, DISTORTION["brown"][1])):
        values |= {
            f"fc_{side}": k[[0, 1], [0, 1]][:, None],
            f"cc_{side}": k[:2, 2:],
            f"kc_{side}": np.array(d)[:, None],
            f"alpha_c_{side}": 0.0,
        }
    return values | {"nx": np.uint16(SIZE[0]), "ny": np.uint16(SIZE[1])}


def matlab_struct(units: str = "millimeters", scale: float = 1.0) -> dict[str, Any]:
    """``toStruct(stereoParams)``: everything transposed, pixels counted from 1."""
    cameras = {}
    for index, (k, d) in enumerate(zip((K1, K2), DISTORTION["brown"], strict=True), start=1):
        cameras[f"CameraParameters{index}"] = {
            "IntrinsicMatrix": (k + np.outer((1, 1, 0), (0, 0, 1))).T,
            "RadialDistortion": np.array([d[0], d[1], d[4]]),
            "TangentialDistortion": np.array(d[2:4]),
            "ImageSize": np.array([float(SIZE[1]), float(SIZE[0])]),
            "WorldUnits": units,
        }
    return cameras | {"RotationOfCamera2": ROTATION.T, "TranslationOfCamera2": TRANSLATION * scale}


def saved(path: Path, values: Mapping[str, Any]) -> Path:
    scipy.io.savemat(path, dict(values))
    return path


@pytest.mark.parametrize("lens", DISTORTION)
@pytest.mark.parametrize("ext", [".yml", ".xml", ".json"])
def test_opencv_storage_projects_as_opencv(ext: str, lens: str, tmp_path: Path) -> None:
    rig, name, notes = import_rig([opencv_pair(tmp_path, ext, lens)])
    assert name == "opencv" and rig.names == ("left", "right") and rig.base_frame == "left"
    assert "mm; name another unit with --units" in " ".join(notes)
    assert_projects(rig, lens)


def test_opencv_lenses_and_poses_may_be_in_files_of_their_own(tmp_path: Path) -> None:
    d = DISTORTION["brown"]
    lenses = storage(tmp_path / "intrinsics.yml", M1=K1, D1=d[0], M2=K2, D2=d[1])
    poses = storage(tmp_path / "extrinsics.yml", R=ROTATION, T=TRANSLATION, R1=np.eye(3), P1=np.eye(3, 4))
    assert_projects(import_rig([lenses, poses], Settings(sizes=(SIZE,)))[0], "brown")
    keys = {"image_Width": SIZE[0], "image_Height": SIZE[1]}
    one = storage(tmp_path / "west.yml", Camera_Matrix=K1, Distortion_Coefficients=d[0], **keys)
    two = storage(tmp_path / "east.yml", camera_matrix=K2, distortion_coefficients=d[1], **keys)
    rig = import_rig([one, two])[0]
    assert rig.names == ("west", "east") and not rig.camera_from_base
    assert_projects(rig, "brown", poses=False)
    rvec = storage(tmp_path / "pose.yml", rvec=cv2.Rodrigues(ROTATION)[0], tvec=TRANSLATION / 10)
    rig = import_rig([one, two, rvec], Settings(names=("left", "right"), units="cm"))[0]
    assert rig.names == ("left", "right")
    assert_projects(rig, "brown")


def test_opencv_lenses_of_zero_thin_prism_are_rational(tmp_path: Path) -> None:
    d = [(*c, 0, 0, 0, 0, 0, 0) for c in DISTORTION["rational"]]
    assert_projects(import_rig([opencv_pair(tmp_path, lens="rational", D1=d[0], D2=d[1])])[0], "rational")


def test_four_coefficients_are_brown_unless_told_otherwise(tmp_path: Path) -> None:
    d = DISTORTION["equidistant"]
    path = storage(tmp_path / "one.yml", K=K1, D=np.array(d[0])[:, None], image_width=SIZE[0], image_height=SIZE[1])
    rig, _, notes = import_rig([path])
    assert rig.cameras["one"].lens == "brown" and "--lens equidistant" in " ".join(notes)
    assert_projects(import_rig([path], Settings(lens="equidistant"))[0], "equidistant", poses=False)


def test_opencv_leaves_a_skew_out_and_so_does_the_import(tmp_path: Path) -> None:
    skewed = K1 + np.outer((3.0, 0, 0), (0, 1, 0))
    rig, _, notes = import_rig([opencv_pair(tmp_path, M1=skewed)])
    assert "the skew of 3 px was left out" in " ".join(notes)
    assert_projects(rig, "brown", (skewed, K2))


@pytest.mark.parametrize("lens", DISTORTION)
def test_ros_pair_projects_as_opencv(lens: str, tmp_path: Path) -> None:
    rig, name, notes = import_rig(ros_pair(tmp_path, lens))
    assert name == "ros" and rig.names == ("left", "right")
    assert notes == ("lengths were read as m, the rig is in mm",)
    assert_projects(rig, lens)


def test_ros_cameras_may_stand_above_each_other(tmp_path: Path) -> None:
    rig = import_rig(ros_pair(tmp_path, vertical=True))[0]
    pose = rig.relative_pose("right", "left")
    # Rotations of double precision on 120 mm.
    assert np.abs(pose.rotation - ROTATION).max() < 1e-12
    assert np.abs(pose.translation_mm - TRANSLATION[[1, 0, 2]]).max() < 1e-9


def test_ros_messages_and_single_cameras(tmp_path: Path) -> None:
    left, right = ros_pair(tmp_path)
    for path in (left, right):
        text = path.read_text()
        for old, new in (
            ("image_", ""), ("camera_matrix", "k"), ("distortion_coefficients", "d"), ("rectification_matrix", "r"),
            ("projection_matrix", "p"), ("camera_name: rig/", "header: {frame_id: rig/"),
        ):  # fmt: skip
            text = text.replace(old, new)
        text = (
            text.replace(f"rig/{path.stem}", f"rig/{path.stem}}}") + "binning_x: 0\nroi: {x_offset: 0, width: 0}\n---\n"
        )
        path.write_text(text)
    rig = import_rig([left, right])[0]
    assert rig.names == ("left", "right")
    assert_projects(rig, "brown")
    alone, _, notes = import_rig([right])
    assert alone.names == ("right",) and not alone.camera_from_base and not notes


@pytest.mark.parametrize("by", ["T_cn_cnm1", "T_cam_imu", "T_imu_cam"])
def test_kalibr_chain_projects_as_opencv_in_both_directions(by: str, tmp_path: Path) -> None:
    rig, name, notes = import_rig([kalibr_chain(tmp_path, "equidistant", by)])
    assert name == "kalibr" and rig.names == ("cam0", "cam1") and notes == ("lengths were read as m, the rig is in mm",)
    assert_projects(rig, "equidistant")


def test_kalibr_radtan_is_brown_without_k3_and_poses_may_be_absent(tmp_path: Path) -> None:
    rig, _, notes = import_rig([kalibr_chain(tmp_path, "brown", "none")])
    assert not rig.camera_from_base and "the lens alone was read" in notes[0]
    points = points_mm()
    wanted = opencv_px(points, K1, DISTORTION["brown"][0][:4], "brown", np.eye(3), np.zeros(3))
    assert np.abs(rig.cameras["cam0"].project(points) - wanted).max() < TOLERANCE_PX


def test_bouguet_projects_by_its_own_formula(tmp_path: Path) -> None:
    values = bouguet_values()
    rig, name, _ = import_rig([saved(tmp_path / "Calib_Results_stereo.mat", values)])
    assert name == "bouguet"
    assert_projects(rig, "brown")
    del values["R"]
    assert_projects(import_rig([saved(tmp_path / "no_matrix.mat", values)])[0], "brown")
    skewed = import_rig([saved(tmp_path / "skew.mat", values | {"alpha_c_left": 0.002})])[0]
    points = points_mm()
    x = opencv_px(points, np.eye(3), DISTORTION["brown"][0], "brown", np.eye(3), np.zeros(3))
    wanted = np.stack([K1[0, 0] * (x[:, 0] + 0.002 * x[:, 1]) + K1[0, 2], K1[1, 1] * x[:, 1] + K1[1, 2]], -1)
    assert np.abs(skewed.project("left", points) - wanted).max() < TOLERANCE_PX
    alone = {key.removesuffix("_left"): value for key, value in values.items() if not key.endswith("_right")}
    mono = import_rig([saved(tmp_path / "Calib_Results.mat", alone)])[0]
    assert mono.names == ("Calib_Results",) and not mono.camera_from_base


@pytest.mark.parametrize("wrapped", [True, False])
def test_matlab_struct_projects_by_its_own_formula(wrapped: bool, tmp_path: Path) -> None:
    """Transposed matrices, pixels counted from 1, rows before columns."""
    struct = matlab_struct()
    path = saved(tmp_path / "rig.mat", {"stereoParams": struct} if wrapped else struct)
    rig, name, _ = import_rig([path])
    assert name == "matlab"
    assert_projects(rig, "brown")
    metres = import_rig([saved(tmp_path / "m.mat", matlab_struct("meters", 1e-3))])[0]
    assert_projects(metres, "brown")
    new = matlab_struct() | {"PoseCamera2": {"R": ROTATION, "Translation": TRANSLATION}}
    for index in (1, 2):
        new[f"CameraParameters{index}"]["K"] = new[f"CameraParameters{index}"].pop("IntrinsicMatrix").T
    del new["RotationOfCamera2"], new["TranslationOfCamera2"]
    assert_projects(import_rig([saved(tmp_path / "new.mat", new)])[0], "brown")


def test_matlab_matrices_under_opencv_names(tmp_path: Path) -> None:
    d = DISTORTION["brown"]
    values = {"cameraMatrix1": K1, "distCoeffs1": d[0], "cameraMatrix2": K2, "distCoeffs2": d[1], "units": "mm"}
    values |= {"R": ROTATION, "t": TRANSLATION[:, None], "imageSize": SIZE}
    rig, name, notes = import_rig([saved(tmp_path / "rig.mat", values)])
    assert name == "matlab" and "--first-pixel 1" in " ".join(notes)
    assert_projects(rig, "brown")
    shifted = import_rig([tmp_path / "rig.mat"], Settings(first_pixel=1))[0]
    assert shifted.cameras["left"].matrix[:2, 2].tolist() == (K1[:2, 2] - 1).tolist()


def test_published_baselines() -> None:
    """What the folder's description says, to its last digit."""
    folder = shared("real/calibration-formats")
    for name, wanted_mm, digit_mm in (
        ("kalibr_euroc.yaml", 110.08, 0.005),
        ("kalibr_tum_vi.yaml", 101.09, 0.005),
        ("matlab_stereo_struct.mat", 42.48, 0.005),
    ):
        rig = import_rig([folder / name])[0]
        first, second = rig.names
        baseline = np.linalg.norm(rig.relative_pose(second, first).translation_mm)
        assert abs(baseline - wanted_mm) <= digit_mm
    stereo = shared("real/stereo-chessboard") / "published_Calib_Results_stereo.mat"
    rig = import_rig([stereo])[0]
    published = scipy.io.loadmat(stereo)
    assert np.abs(rig.relative_pose("right", "left").translation_mm - published["T"].ravel()).max() < 1e-12
    assert rig.cameras["left"].size_px == (640, 480)
    # P[0, 3] / P[0, 0] of the right file, in mm.
    rig = import_rig([folder / "ros_left.yaml", folder / "ros_right.yaml"])[0]
    assert abs(np.linalg.norm(rig.relative_pose("right", "left").translation_mm) - 124345.326 / 665.465026) < 1e-9


def test_published_opencv_lenses_project_as_opencv() -> None:
    path = shared("real/calibration-formats") / "opencv_intrinsics.yml"
    rig, _, notes = import_rig([path])
    assert "640x480 was assumed" in " ".join(notes)
    file, points = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ), points_mm()
    for name, index in (("left", 1), ("right", 2)):
        k, d = (file.getNode(f"{key}{index}").mat() for key in "MD")
        wanted = cv2.projectPoints(points, np.zeros(3), np.zeros(3), k, d)[0].reshape(-1, 2)
        assert np.abs(rig.cameras[name].project(points) - wanted).max() < TOLERANCE_PX


def made_rig(lens: str = "brown", names: tuple[str, ...] = ("left", "right"), registered: bool = False) -> Rig:
    camera_from_base = Pose.from_rotvec([0.3, 0.2, -0.1], [10, 20, 300]) if registered else Pose.identity()
    poses = {names[0]: camera_from_base, names[1]: Pose(ROTATION, TRANSLATION) @ camera_from_base}
    cameras = {n: Camera(k, SIZE, d, lens) for n, k, d in zip(names, (K1, K2), DISTORTION[lens], strict=True)}
    return Rig(cameras, poses, "clamp" if registered else names[0])


@pytest.mark.parametrize("lens", DISTORTION)
@pytest.mark.parametrize("tool", EXPORTERS)
def test_exported_rigs_come_back(tool: str, lens: str, tmp_path: Path) -> None:
    files = EXPORTERS[tool](made_rig(lens, registered=True))
    for name, text in files.items():
        (tmp_path / name).write_text(text)
    rig, found, _ = import_rig([tmp_path / name for name in sorted(files)])
    assert found == tool
    assert_projects(rig, lens)


def test_opencv_reads_the_export(tmp_path: Path) -> None:
    ((name, text),) = EXPORTERS["opencv"](made_rig("rational")).items()
    (tmp_path / name).write_text(text)
    assert text.startswith("%YAML:1.0\n")
    file = cv2.FileStorage(str(tmp_path / name), cv2.FILE_STORAGE_READ)
    for key, wanted in (("M1", K1), ("M2", K2), ("D1", DISTORTION["rational"][0]), ("R", ROTATION), ("T", TRANSLATION)):
        assert np.array_equal(np.ravel(file.getNode(key).mat()), np.ravel(wanted)) or key == "R"
    assert np.abs(file.getNode("R").mat() - ROTATION).max() < 1e-15
    assert [int(file.getNode("image_size2").at(i).real()) for i in range(2)] == list(SIZE)


def test_ros_export_is_rectified() -> None:
    """Points come out on one row of both rectified pictures, with the disparity that ROS turns into depth."""
    from tubesight.files.nested import parse_yaml

    infos = {n: parse_yaml(t, Path(n)) for n, t in EXPORTERS["ros"](made_rig()).items()}
    points, px = points_mm(), {}
    for name, local in (("left", points), ("right", points @ ROTATION.T + TRANSLATION)):
        info = infos[f"{name}.yaml"]
        r, p = (
            np.reshape(info[k]["data"], s) for k, s in (("rectification_matrix", (3, 3)), ("projection_matrix", (3, 4)))
        )
        rectified = local / 1000 @ r.T
        q = rectified @ p[:, :3].T
        px[name] = q[:, :2] / q[:, 2:]
        depth, focal, shift = rectified[:, 2], p[0, 0], p[0, 3]
    # In a camera's own rectified frame the pixel is K'(x / z); ROS's disparity is f * baseline / z.
    assert np.abs(px["left"][:, 1] - px["right"][:, 1]).max() < TOLERANCE_PX
    assert np.abs(px["left"][:, 0] - px["right"][:, 0] + shift / depth).max() < TOLERANCE_PX
    assert abs(-shift / focal - np.linalg.norm(TRANSLATION) / 1000) < 1e-12


def test_ros_export_finds_out_which_camera_is_left(tmp_path: Path) -> None:
    """A rig whose first camera is the right one: the baseline is in the file of the right one all the same."""
    rig = made_rig(names=("a", "b"))
    turned = Rig({n: rig.cameras[n] for n in ("b", "a")}, rig.camera_from_base, "a")
    assert EXPORTERS["ros"](turned) == {n: EXPORTERS["ros"](rig)[n] for n in ("b.yaml", "a.yaml")}


def test_exports_of_lenses_and_of_more_cameras() -> None:
    rig = made_rig()
    lenses = Rig(rig.cameras, {}, "left")
    assert list(EXPORTERS["opencv"](lenses)) == ["left.yml", "right.yml"]
    assert list(EXPORTERS["ros"](lenses)) == ["left.yaml", "right.yaml"]
    third = Pose.from_rotvec([0, 0.1, 0], [-50, 0, 0])
    three = Rig({**rig.cameras, "top": rig.cameras["left"]}, {**rig.camera_from_base, "top": third}, "left")
    assert list(EXPORTERS["opencv"](three)) == ["left_right.yml", "left_top.yml"]
    assert list(EXPORTERS["ros"](three)) == ["left.yaml", "right.yaml", "top.yaml"]


@pytest.mark.parametrize(
    ("change", "tool", "expected"),
    [
        (lambda c: Camera(c.matrix + np.eye(3, k=1) * [0, 2, 0], SIZE, c.distortion), "opencv", "knows no skew"),
        (lambda c: Camera(c.matrix + np.eye(3, k=1) * [0, 2, 0], SIZE, c.distortion), "ros", "knows no skew"),
        (lambda c: Camera(c.matrix, SIZE, np.zeros(4), "equidistant"), "opencv", "no pair of a equidistant"),
    ],
)
def test_exports_refuse_what_the_other_tool_cannot_hold(
    change: Callable[[Camera], Camera], tool: str, expected: str
) -> None:
    rig = made_rig()
    changed = Rig({**rig.cameras, "left": change(rig.cameras["left"])}, rig.camera_from_base, "left")
    with pytest.raises(InputError, match=expected):
        EXPORTERS[tool](changed)


def test_ros_export_refuses_cameras_one_behind_the_other() -> None:
    rig = made_rig()
    behind = Rig(rig.cameras, {"left": Pose.identity(), "right": Pose.from_rotvec([0, 0.01, 0], [0, 0, -100])}, "left")
    with pytest.raises(InputError, match="look along their baseline"):
        EXPORTERS["ros"](behind)


def test_commands_import_and_export(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "made" / "rig.yaml"
    source = opencv_pair(tmp_path)
    main_ok("import", source, "-o", out, "--json")
    printed = json.loads(capsys.readouterr().out)
    assert printed["format"] == "opencv" and abs(printed["baseline_mm"]["right"] - np.linalg.norm(TRANSLATION)) < 1e-9
    file = load_rig(out)
    assert file.rig.base_frame == "left" and not file.rig.registered
    assert file.calibration is not None and file.calibration["imported"]["format"] == "opencv"
    assert_projects(file.rig, "brown")
    main_ok(
        "import",
        source,
        "-o",
        out,
        "--names",
        "west, east",
        "--size",
        "1280x960",
        "--units",
        "mm",
        "--format",
        "opencv",
    )
    captured = capsys.readouterr()
    assert "west" in captured.out and str(out) in captured.out and "next: tubesight register" in captured.out
    for tool in EXPORTERS:
        main_ok("rig-export", out, "--format", tool, "-o", tmp_path / tool)
        assert str(tmp_path / tool) in capsys.readouterr().out
        assert_projects(import_rig(sorted((tmp_path / tool).iterdir(), reverse=True))[0], "brown")


def main_ok(*args: object) -> None:
    with pytest.raises(SystemExit) as left:
        main([str(arg) for arg in args])
    assert left.value.code in (0, None)


def test_command_line_knows_what_the_files_know() -> None:
    assert {str(f) for f in import_.Format} == set(IMPORTERS)
    assert {str(u) for u in import_.Unit} == set(UNITS)
    assert {str(lens) for lens in import_.Lens} == set(LENSES)
    assert {str(f) for f in rig_export.Format} == set(EXPORTERS)


def test_imported_names_load(tmp_path: Path) -> None:
    """Names of other tools become names that a rig file may have."""
    d = DISTORTION["brown"][0]
    for stem in ("background", "-left-", "a b/c", "Kamera ä", "..", "_1", "clamp"):
        path = storage(tmp_path / "one.yml", camera_matrix=K1, distortion_coefficients=d, camera_name=stem)
        rig = import_rig([path], Settings(sizes=(SIZE,)))[0]
        save_rig(tmp_path / "rig.yaml", rig)
        assert load_rig(tmp_path / "rig.yaml").rig.names == rig.names
