"""``run --base``: the curve starts at a base marked by hand."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from conftest import SimulatedPair
from tubesight.cli.main import main
from tubesight.core import FramePair, Status, Tip, Tube
from tubesight.files.rig import save_rig
from tubesight.files.tables import read_curves, read_shapes
from tubesight.geometry.rig import Rig
from tubesight.sensor import ShapeSensor
from tubesight.simulate import Arc, Phantom, straight

TUBE = Tube(8.0, Tip("round"))
BEND = Arc(np.radians(25), np.radians(140), 150.0)
# A pixel at 310 mm with a focal length of 743 px.
MM_PER_PX = 310 / 743

Simulate = Callable[..., SimulatedPair]


def marks_of(rig: Rig, point_mm: np.ndarray, off_px: float = 0.0) -> dict[str, np.ndarray]:
    return {name: rig.project(name, point_mm) + np.array([off_px, -off_px]) for name in rig.names}


@pytest.mark.parametrize("method", ["silhouette", "cone_ray"])
@pytest.mark.parametrize("phantom", [straight(150.0), BEND], ids=["straight", "arc"])
@pytest.mark.parametrize("from_mm", [0.0, 40.0])
def test_curve_starts_at_the_mark(simulated_pair: Simulate, phantom: Phantom, method: str, from_mm: float) -> None:
    """Also where the tube is seen before the mark, and in the frame of a rig that is registered."""
    seen = simulated_pair(phantom, TUBE)
    base = phantom.at(np.array([from_mm]))[0]
    result = ShapeSensor(seen.rig, TUBE, method, base_px=marks_of(seen.rig, base))(seen.pair)
    assert result.status is Status.OK, result.notes
    assert result.curve is not None and result.shape is not None
    # Edges are known to 0.1 px; the closed form's start is the foot of the mark on a curve that is off by half a pixel.
    assert np.linalg.norm(result.curve.at([0.0])[0] - base) < 0.5 * MM_PER_PX
    assert result.shape.length_mm == pytest.approx(150.0 - from_mm, abs=0.6 * MM_PER_PX)
    tangents = phantom.tangent(np.array([from_mm, phantom.length_mm]))
    expected = np.degrees(np.arccos(np.clip(tangents[0] @ tangents[1], -1, 1)))
    assert np.degrees(result.shape.bending_rad) == pytest.approx(expected, abs=0.5)


def test_mark_takes_the_place_of_the_clamp(simulated_pair: Simulate) -> None:
    clamped = Tube(8.0, Tip("round"), clamped=True)
    seen = simulated_pair(BEND, TUBE)
    base = BEND.at(np.array([30.0]))[0]
    sensor = ShapeSensor(seen.rig, clamped, base_px=marks_of(seen.rig, base))
    assert not sensor.tube.clamped
    result = sensor(seen.pair)
    assert result.curve is not None
    assert np.linalg.norm(result.curve.at([0.0])[0] - base) < 0.5 * MM_PER_PX


def test_sloppy_marks_move_the_start_along_the_tube_alone(simulated_pair: Simulate) -> None:
    """Three pixels beside: the start stays on the axis, as far along it as the clicks were off."""
    seen = simulated_pair(BEND, TUBE)
    base = BEND.at(np.array([20.0]))[0]
    result = ShapeSensor(seen.rig, TUBE, base_px=marks_of(seen.rig, base, 3.0))(seen.pair)
    assert result.curve is not None
    start = result.curve.at([0.0])[0]
    nearest = BEND.at(np.linspace(0, 60, 3001))
    assert np.linalg.norm(nearest - start, axis=1).min() < 0.2 * MM_PER_PX
    assert np.linalg.norm(start - base) < 5 * MM_PER_PX


def test_one_mark_only_tells_the_ends_apart(simulated_pair: Simulate) -> None:
    seen = simulated_pair(straight(150.0), TUBE)
    px = seen.rig.project("left", [0.0, 0.0, 30.0])
    result = ShapeSensor(seen.rig, TUBE, base_px={"left": px})(seen.pair)
    assert result.shape is not None and result.shape.length_mm > 140


@pytest.mark.parametrize(
    ("moved", "status", "said"),
    [
        ({"right": (0.0, 90.0)}, Status.VIEWS_DISAGREE, "the marks of the base miss each other"),
    ],
)
def test_marks_elsewhere_are_refused(
    simulated_pair: Simulate, moved: dict[str, tuple[float, float]], status: Status, said: str
) -> None:
    seen = simulated_pair(straight(150.0), TUBE)
    marks = marks_of(seen.rig, np.array([0.0, 0.0, 40.0]))
    marks |= {name: marks[name] + by for name, by in moved.items()}
    result = ShapeSensor(seen.rig, TUBE, base_px=marks)(seen.pair)
    assert result.status is status and said in result.notes[0]


def test_mark_beside_the_tube_is_refused(simulated_pair: Simulate) -> None:
    seen = simulated_pair(straight(150.0), TUBE)
    result = ShapeSensor(seen.rig, TUBE, base_px=marks_of(seen.rig, np.array([40.0, 40.0, 40.0])))(seen.pair)
    assert result.status is Status.BASE_HIDDEN and "beside the tube" in result.notes[0]


@pytest.mark.parametrize("from_mm", [0.0, 20.0])
def test_mark_shows_where_to_look(simulated_pair: Simulate, from_mm: float) -> None:
    """Here the shaded side of the holder is taken for the tube where no mark says where the tube is."""
    bend = Arc(np.radians(50), np.radians(40), 150.0)
    seen = simulated_pair(bend, TUBE)
    base = bend.at(np.array([from_mm]))[0]
    result = ShapeSensor(seen.rig, TUBE, base_px=marks_of(seen.rig, base, 1.5))(seen.pair)
    assert result.shape is not None, result.notes
    assert result.shape.length_mm == pytest.approx(150.0 - from_mm, abs=3 * MM_PER_PX)


def test_run_starts_every_curve_at_the_marks(
    simulated_pair: Simulate, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    seen: SimulatedPair = simulated_pair(BEND, TUBE)
    pair: FramePair = seen.pair
    for name, image in pair.images.items():
        (tmp_path / "photos" / name).mkdir(parents=True)
        cv2.imwrite(str(tmp_path / "photos" / name / "1.png"), image)
    save_rig(tmp_path / "rig.yaml", seen.rig)
    (tmp_path / "tube.yaml").write_text("diameter_mm: 8.0\ntip: {shape: round}\nclamped: true\n", encoding="utf-8")
    base = BEND.at(np.array([25.0]))[0]
    places = [f"{n}:{px[0]:.1f},{px[1]:.1f}" for n, px in marks_of(seen.rig, base).items()]
    files = ("photos", "--rig", "rig.yaml", "--tube", "tube.yaml", "-o", "out")
    args = [arg if arg.startswith("-") else str(tmp_path / arg) for arg in files]
    with pytest.raises(SystemExit) as left:
        main(["run", *args, "--base", *places])
    assert not left.value.code
    assert "it takes the place of the clamp" in capsys.readouterr().err
    (row,) = read_shapes(tmp_path / "out" / "shapes.csv")
    # The mark is written to a tenth of a pixel.
    assert row.length_mm == pytest.approx(125.0, abs=0.6 * MM_PER_PX)
    start = read_curves(tmp_path / "out" / "curves.npz").xyz_mm[0, 0]
    assert np.linalg.norm(start - base) < 0.5 * MM_PER_PX
    run = json.loads((tmp_path / "out" / "run.json").read_text())
    assert run["configuration"]["tube"]["clamped"] is False
