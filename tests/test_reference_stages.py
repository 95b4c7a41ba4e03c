"""Pictures of the stages: figure 4 (a) to (l) of the paper, and the corresponding ones of the other pipelines."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from small_set import write_small_set
from tubesight.cli.main import app
from tubesight.core import FramePair
from tubesight.files.rig import load_rig
from tubesight.files.tube import load_tube
from tubesight.outputs.stages import write_stages
from tubesight.sensor import ShapeSensor

PAPER = [
    "a_crop",
    "b_background_removed",
    "c_tip_region",
    "d_distance_transform",
    "e_line_and_perpendicular",
    "f_Canny_edges",
    "g_three_points",
    "h_circle",
    "i_arc_mask",
    "j_first_arc",
    "k_second_arc",
    "l_all_points",
]
OWN = ["a_picture", "b_signal", "c_scans", "d_edges", "e_tip_contour", "f_centreline", "g_reprojection"]


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = write_small_set(tmp_path_factory.mktemp("stages"))
    for path in folder.glob("photos/*/*.png"):
        if path.stem != "1":
            path.unlink()
    return folder


@pytest.mark.parametrize(("method", "names"), [("reference", PAPER), ("cone_ray", OWN)])
def test_run_writes_the_stages(data: Path, tmp_path: Path, method: str, names: list[str]) -> None:
    words = ["run", str(data / "photos"), "--rig", str(data / "rig.yaml"), "--tube", str(data / "tube.yaml")]
    done = CliRunner().invoke(app, [*words, "--method", method, "-o", str(tmp_path), "--stages"])
    assert done.exit_code == 0, done.output
    for camera in ("left", "right"):
        found = sorted(path.stem for path in (tmp_path / "stages" / "1").glob(f"{camera}_*.png"))
        assert found == [f"{camera}_{name}" for name in names]
        for path in (tmp_path / "stages" / "1").glob(f"{camera}*.png"):
            # Every picture shows something: no stage is a blank.
            assert np.ptp(cv2.imread(str(path))) > 100, path.name
        assert (tmp_path / "stages" / "1" / f"{camera}.png").is_file()


def test_no_stages_unless_asked(data: Path, tmp_path: Path) -> None:
    words = ["run", str(data / "photos"), "--rig", str(data / "rig.yaml"), "--tube", str(data / "tube.yaml")]
    assert CliRunner().invoke(app, [*words, "--method", "reference", "-o", str(tmp_path)]).exit_code == 0
    assert not (tmp_path / "stages").exists()


@pytest.mark.parametrize(("method", "count"), [("reference", 1), ("cone_ray", 1)])
def test_pictures_end_with_the_stage_that_fails(data: Path, tmp_path: Path, method: str, count: int) -> None:
    """Of an empty scene the paper's pipeline has the crop alone, the others the picture."""
    rig, tube = load_rig(data / "rig.yaml").rig, load_tube(data / "tube.yaml")
    empty = np.full((540, 960, 3), (160, 70, 32), np.uint8)
    pair = FramePair(dict.fromkeys(rig.names, empty), "empty")
    sensor = ShapeSensor(rig, tube, method)
    result = sensor(pair)
    assert not result
    files = write_stages(tmp_path, pair, result, sensor)
    assert len(files) == 2 * (count + 1)
