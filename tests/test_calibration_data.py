"""Calibration of rendered photographs with known truth, and of third-party photographs with published results."""

import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import scipy.io

from calibration_scenes import volume_mm
from shared_data import shared
from tubesight.apps.calibrate import Outcome, calibrate_folder
from tubesight.apps.register import register_folder
from tubesight.files.rig import load_rig, save_rig
from tubesight.geometry.rig import Rig

# What the specification demands of the mock-up, and what careful corners reach with a margin of five.
MOCKUP_MM = 0.015


@dataclass(frozen=True)
class Mockup:
    folder: Path
    out: Path
    calibrated: Outcome
    registered: Outcome

    @property
    def true(self) -> Rig:
        return load_rig(self.folder / "rig_true.yaml").rig


@pytest.fixture(scope="module")
def mockup(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Mockup]:
    folder = shared("mockup")
    out = tmp_path_factory.mktemp("mockup")
    board = folder / "board.yaml"
    calibrated = calibrate_folder(folder / "calibration", board, out / "calibrated.yaml", out / "report")
    registered = register_folder(
        folder / "registration", out / "calibrated.yaml", board, out / "rig.yaml", report=out / "report2"
    )
    yield Mockup(folder, out, calibrated, registered)


def test_mockup_points_of_the_working_volume_come_back(mockup: Mockup) -> None:
    rig = load_rig(mockup.out / "rig.yaml").rig
    assert rig.registered
    assert volume_mm(rig, mockup.true).max() < MOCKUP_MM


def test_mockup_uses_every_picture_and_says_so(mockup: Mockup) -> None:
    quality = mockup.calibrated.quality
    assert quality is not None
    assert [q.views for q in quality.cameras.values()] == [16, 16]
    assert not mockup.calibrated.left_out
    # The corners scatter by 0.01 px a coordinate (noise and JPEG); the finder's own would by 0.2.
    assert quality.rms_px < 0.03
    assert quality.pairs[0].epipolar_px < 0.05
    assert mockup.calibrated.verdict.level == "good"
    assert "tubesight register" in mockup.calibrated.verdict.next_step
    assert "tubesight run" in mockup.registered.verdict.next_step


def test_mockup_errors_agree_with_the_covariance(mockup: Mockup) -> None:
    """Lens parameters against their truth (where k3 is not free, its part goes into k1 and k2)."""
    rig = load_rig(mockup.out / "rig.yaml").rig
    assert rig.covariance is not None
    assert rig.covariance.names[:3] == ("left.f", "left.cx", "left.cy")
    assert {n.rpartition(".")[2] for n in rig.covariance.names} >= {"rx", "ry", "rz", "tx", "ty", "tz"}
    sd = dict(zip(rig.covariance.names, np.sqrt(rig.covariance.matrix.diagonal()), strict=True))
    for name in rig.names:
        error = rig.cameras[name].matrix - mockup.true.cameras[name].matrix
        for parameter, place in (("f", (0, 0)), ("cx", (0, 2)), ("cy", (1, 2))):
            # Six numbers; the largest of six normal ones is below 4 deviations in 99.96 % of cases.
            assert abs(error[place]) < 4 * sd[f"{name}.{parameter}"]
    assert np.linalg.eigvalsh(rig.covariance.matrix).min() > 0


def test_mockup_report_is_one_page_with_a_picture_per_camera(mockup: Mockup) -> None:
    page = (mockup.out / "report" / "report.html").read_text(encoding="utf-8")
    assert page.count("data:image/png;base64,") == 2
    assert 'src="http' not in page
    assert mockup.calibrated.verdict.sentence in page
    for name in ("left", "right"):
        picture = cv2.imread(str(mockup.out / "report" / f"coverage_{name}.png"))
        assert picture is not None
        assert picture.shape == (540, 960, 3)


def test_mockup_rig_without_observations_keeps_its_lenses(mockup: Mockup, tmp_path: Path) -> None:
    true = mockup.true
    save_rig(tmp_path / "lenses.yaml", Rig(true.cameras, {}, "left"))
    board = mockup.folder / "board.yaml"
    outcome = register_folder(mockup.folder / "registration", tmp_path / "lenses.yaml", board, tmp_path / "rig.yaml")
    rig = load_rig(tmp_path / "rig.yaml").rig
    assert np.array_equal(rig.cameras["left"].matrix, true.cameras["left"].matrix)
    assert rig.covariance is None
    assert any("no observations" in w for w in outcome.warnings)
    # Each camera is placed from two boards alone: corners of 0.015 px over 100 mm fix it to 0.02 mm at their edge.
    assert volume_mm(rig, true).max() < 0.05


def test_mockup_files_name_their_pictures(mockup: Mockup) -> None:
    record = load_rig(mockup.out / "rig.yaml").calibration
    assert record is not None
    assert record["board"] == {"type": "chessboard", "squares": [10, 7], "square_mm": 13.0}
    assert len(record["observations"]) == 32
    assert set(record["views"]) == {"left", "right"}
    assert record["views"]["left"]["008.jpg"] < 0.1
    assert record["image_hashes"]["left/008.jpg"].startswith("sha256:")
    assert set(record["registration"]["deviation_mm"]) == {"000.jpg", "001.jpg"}


@pytest.fixture(scope="module")
def published() -> dict[str, Any]:
    return dict(scipy.io.loadmat(shared("real") / "stereo-chessboard" / "published_Calib_Results_stereo.mat"))


@pytest.fixture(scope="module")
def stereo(tmp_path_factory: pytest.TempPathFactory) -> tuple[Rig, Outcome]:
    source = shared("real") / "stereo-chessboard"
    folder = tmp_path_factory.mktemp("stereo")
    for name in ("left", "right"):
        (folder / "pictures" / name).mkdir(parents=True)
        for path in source.glob(f"{name}*.jpg"):
            shutil.copy(path, folder / "pictures" / name / path.name.removeprefix(name))
    board = folder / "board.yaml"
    board.write_text("type: chessboard\nsquares: [10, 7]\nsquare_mm: 30.0\n", encoding="utf-8")
    outcome = calibrate_folder(folder / "pictures", board, folder / "rig.yaml")
    return load_rig(folder / "rig.yaml").rig, outcome


def test_real_stereo_pairs_agree_with_the_published_calibration(
    stereo: tuple[Rig, Outcome], published: dict[str, Any]
) -> None:
    rig, outcome = stereo
    pose = rig.relative_pose("right", "left")
    pairs = [("T", pose.translation_mm, "T_error"), ("om", pose.rotvec_rad, "om_error")]
    for name in rig.names:
        matrix = rig.cameras[name].matrix
        pairs.append((f"fc_{name}", matrix.diagonal()[:2], f"fc_{name}_error"))
        pairs.append((f"cc_{name}", matrix[:2, 2], f"cc_{name}_error"))
    for key, value, error in pairs:
        off = np.abs(value - published[key].ravel()) / published[error].ravel()
        assert off.max() < 1.5, f"{key} is {off} published errors off"
    assert outcome.quality is not None
    assert outcome.quality.rms_px < 0.25
    assert not outcome.left_out


def test_real_lenses_keep_one_focal_length_and_no_k3(stereo: tuple[Rig, Outcome]) -> None:
    """The published ones agree within their error; so the data do not earn more parameters."""
    for camera in stereo[0].cameras.values():
        assert camera.matrix[0, 0] == camera.matrix[1, 1]
        assert camera.distortion[4] == 0


def test_real_deviations_are_of_the_size_of_the_published_errors(
    stereo: tuple[Rig, Outcome], published: dict[str, Any]
) -> None:
    """The published errors are three deviations of independent corners; the boards' bend makes ours larger."""
    covariance = stereo[0].covariance
    assert covariance is not None
    sd = dict(zip(covariance.names, np.sqrt(covariance.matrix.diagonal()), strict=True))
    for name in ("left", "right"):
        ratio = sd[f"{name}.f"] / published[f"fc_{name}_error"].mean()
        assert 1 / 3 < ratio < 3
