"""Tubes whose end is not seen, whose diameter changes, or whose colour does."""

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from fit_scenes import curve, views_of
from shared_data import shared
from tubesight.cli.main import main
from tubesight.core import InputError, Status, Tip, Tube, Unmeasurable
from tubesight.files.rig import load_rig
from tubesight.files.tables import read_curves, read_shapes
from tubesight.files.tube import load_tube
from tubesight.geometry.families import Nodes
from tubesight.geometry.polyline import place_along
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.methods import METHODS
from tubesight.methods.agreement import triangulate_tip
from tubesight.methods.common_end import to_common_end
from tubesight.sensor import ShapeSensor
from tubesight.simulate import rig_around
from tubesight.vision.follow import follow
from tubesight.vision.locate import open_tip
from tubesight.vision.silhouette import learn, signal_of
from tubesight.vision.stages import stages
from tubesight.vision.view import View
from vision_scenes import Picture, drawn_tube

RIG = rig_around(90.0, size_px=(1920, 1080))
OPEN = Tube(12.0, Tip("open"), clamped=True)
CIRCLE = curve("circle", [0.5, 0.3, 150.0])
SHAPES = {
    "circle": CIRCLE,
    # An S-shape, and a hook that turns back, so that epipolar lines touch it in both views.
    "arcs2": curve("arcs2", [0.6, 0.2, -0.5, 0.3, 0.2, 150.0]),
    "hook": curve("circle", [1.4, 1.3, 170.0]),
    "straight": curve("circle", [0.0, 0.0, 150.0]),
}


def cut(view: View, share: float) -> View:
    """Show the first share of a view only, its end open."""
    keep = slice(0, round(share * len(view.edges_px)))
    parts = {name: getattr(view, name)[keep] for name in ("edges_px", "edge_rays", "rays", "centreline_px")}
    return replace(view, **parts, tip=open_tip(parts["rays"][-1], parts["centreline_px"][-1]))


def open_views(nodes: Nodes, left: float, right: float, rig: Rig = RIG) -> dict[str, View]:
    views = views_of(nodes, rig, Tube(12.0, Tip("round"), clamped=True))
    return {name: cut(views[name], share) for name, share in (("left", left), ("right", right))}


@pytest.mark.parametrize("shares", [(0.7, 1.0), (1.0, 0.8), (0.9, 0.9)])
@pytest.mark.parametrize("shape", SHAPES)
def test_views_end_where_the_shorter_one_does(shape: str, shares: tuple[float, float]) -> None:
    nodes = SHAPES[shape]
    views = to_common_end(open_views(nodes, *shares), RIG)
    tip = triangulate_tip(views, RIG)
    # Scans are the nodes of the curve; the last one of the shorter view is the end.
    scans = len(open_views(nodes, 1.0, 1.0)["left"].edges_px)
    end = nodes.points[round(min(shares) * scans) - 1]
    # Between scans the centreline is taken as straight: nodes 3.5 mm apart on the sharpest bend (1.9 rad over 170 mm)
    # leave 3.5^2 / 8 x 0.011 = 0.017 mm; epipolar lines that cross at 0.1 rad turn it into ten times as much along it.
    assert np.linalg.norm(tip - end) < 0.2
    noted = [name for name, view in views.items() if any("stands for the tip" in note for note in view.notes)]
    assert len(noted) == 1
    if shares[0] != shares[1]:
        assert noted == ["left" if shares[0] < shares[1] else "right"]


@pytest.mark.parametrize("clamped", [True, False])
@pytest.mark.parametrize("method", ["silhouette", "cone_ray"])
def test_methods_measure_the_part_that_is_seen(method: str, clamped: bool) -> None:
    views = to_common_end(open_views(CIRCLE, 0.7, 1.0), RIG)
    found = METHODS[method].solve(views, RIG, replace(OPEN, clamped=clamped))
    points = found.at(np.linspace(0, found.length_mm, 50))
    _, off = place_along(CIRCLE.points[:, [0, 2]], points[:, [0, 2]])
    scans = len(open_views(CIRCLE, 1.0, 1.0)["left"].edges_px)
    # Exact edges: the fit ends within 2e-3 mm; nodes 3 mm apart on a bend of 0.6 rad leave 0.005 mm between them. The
    # length is that to the last scan, as well as its match is known (see above).
    assert off.max() < 0.02
    assert found.length_mm == pytest.approx(CIRCLE.s_mm[round(0.7 * scans) - 1], abs=0.1)


def test_views_of_different_tubes_disagree() -> None:
    # Epipolar lines run across the tube: what tells two tubes apart is how far along it they begin and end.
    elsewhere = curve("circle", [0.5, 0.3, 150.0], Pose(np.eye(3), np.array([0.0, 0.0, 70.0])))
    one, other = open_views(CIRCLE, 1.0, 1.0), open_views(elsewhere, 1.0, 1.0)
    with pytest.raises(Unmeasurable) as caught:
        to_common_end({"left": one["left"], "right": other["right"]}, RIG)
    assert caught.value.status is Status.VIEWS_DISAGREE


def test_little_in_common_is_refused() -> None:
    with pytest.raises(Unmeasurable) as caught:
        to_common_end(open_views(CIRCLE, 0.14, 1.0), RIG)
    assert caught.value.status is Status.TOO_FEW_POINTS


def stepped(nodes: Nodes) -> dict[str, View]:
    """Views of a robot of two tubes: 12 mm at the base, 7 mm from the middle on."""
    thick, thin = (views_of(nodes, RIG, Tube(d, Tip("round"), clamped=True)) for d in (12.0, 7.0))
    views = {}
    for name in RIG.names:
        half = len(thick[name].edges_px) // 2
        count = min(len(thick[name].edges_px), len(thin[name].edges_px))
        parts = {
            part: np.concatenate([getattr(thick[name], part)[:half], getattr(thin[name], part)[half:count]])
            for part in ("edges_px", "edge_rays", "rays", "centreline_px")
        }
        views[name] = replace(thin[name], **parts)
    return views


@pytest.mark.parametrize("tip", ["round", "open"])
def test_a_tapered_tube_is_measured_by_its_middle(tip: str) -> None:
    views = stepped(CIRCLE)
    if tip == "open":
        views = to_common_end({name: cut(view, 1.0) for name, view in views.items()}, RIG)
    tube = Tube(12.0, Tip(tip), clamped=True)
    found = METHODS["silhouette"].solve(views, RIG, replace(tube, tapered=True))
    points = found.at(np.linspace(0, found.length_mm, 50))
    # Bisectors are off the middle by 0.002 px (0.001 mm) on an even tube; nodes leave 0.005 mm between them.
    assert place_along(CIRCLE.points[:, [0, 2]], points[:, [0, 2]])[1].max() < 0.02
    if tip == "round":
        assert np.linalg.norm(found.at([found.length_mm])[0] - CIRCLE.points[-1]) < 0.02
    # As an even tube it does not fit: the edges of the thin half are 2.5 mm, several pixels, inside.
    with pytest.raises(Unmeasurable) as caught:
        METHODS["silhouette"].solve(views, RIG, tube)
    assert caught.value.status is Status.RESIDUAL_TOO_LARGE


CLOTH = (0.3, 0.12, 0.08)


def two_tone() -> Picture:
    """Draw a tube that is bright at its upper half, and at its lower one nearly of the cloth's colour."""
    colours = (0.8, 0.8, 0.8), (0.24, 0.14, 0.09)
    bright, dark = (drawn_tube(width=8.0, tube=colour, cloth=CLOTH, ball=0.0, noise=0.004) for colour in colours)
    mix = np.clip((np.arange(len(bright)) - 45) / 45.0, 0, 1)[:, None, None]
    return np.asarray((1 - mix) * bright + mix * dark, np.uint8)


def test_a_walk_goes_on_with_the_colours_of_its_end() -> None:
    run, picture = stages(), two_tone()
    start, way, width = np.array([105.0, 20.0]), np.array([0.0, 1.0]), 8.0
    signal = signal_of(picture, None, learn(picture, None, start, way, width))
    track = run.walk_from_base(signal, start, way, width)
    assert track is not None
    # The tube is drawn from y = 18 to 113 and changes its colour from 45 to 90.
    assert track.middle_px[-1, 1] < 95
    last, whole = follow(run, picture, None, signal, track)
    assert 100 < whole.middle_px[-1, 1] < 118
    assert last.tube.mean() < signal.tube.mean() / 2
    steps = np.diff(whole.middle_px[:, 1])
    assert (steps > 0).all()


def test_an_even_tube_is_not_followed_past_its_end() -> None:
    run, picture = stages(), drawn_tube(ball=0.0)
    start, way = np.array([105.0, 20.0]), np.array([0.0, 1.0])
    signal = signal_of(picture, None, learn(picture, None, start, way, 16.0))
    track = run.walk_from_base(signal, start, way, 16.0)
    assert track is not None
    _, whole = follow(run, picture, None, signal, track)
    assert whole.middle_px[-1, 1] < 118


def test_an_open_end_has_no_diameter(tmp_path: Path) -> None:
    path = tmp_path / "tube.yaml"
    path.write_text("diameter_mm: 2.6\ntip: {shape: open}\ntapered: true\n", encoding="utf-8")
    assert load_tube(path) == Tube(2.6, Tip("open"), tapered=True)
    path.write_text("tip: {shape: open, diameter_mm: 2}\n", encoding="utf-8")
    with pytest.raises(InputError, match="an open end has no diameter; remove the key"):
        load_tube(path)


@pytest.mark.parametrize("frame", ["0001", "0005", "0008", "0011"])
def test_photographs_with_their_tip_left_out(frame: str) -> None:
    """On 12 photographs the curve was off by at most 0.03 mm and ended up to 15 mm before the tip."""
    from test_pipeline import distance_to, mockup_pair, mockup_sensor, mockup_truth

    sensor: ShapeSensor = mockup_sensor(tube=OPEN)
    result = sensor(mockup_pair(frame))
    assert result, result.notes
    truth = mockup_truth(frame)
    line = np.array(truth["centreline"])
    seen = line[: int(len(line) * (result.shape.length_mm - 1) / truth["length"])]
    assert distance_to(result.curve, seen).max() <= 0.1
    assert truth["length"] - 30 < result.shape.length_mm < truth["length"] + 2
    assert any("stands for the tip" in note for note in result.notes)
    assert mockup_sensor(tube=OPEN, method="reference")(mockup_pair(frame)).status is Status.TIP_NOT_FOUND


def leave(args: list[str]) -> int:
    with pytest.raises(SystemExit) as left:
        main(args)
    return int(left.value.code or 0)


LENSES = """\
format: tubesight-rig/1
units: mm
cameras:
  left: {size_px: [1280, 720], matrix: [[850, 0, 640], [0, 850, 360], [0, 0, 1]], distortion: [0, 0, 0, 0, 0]}
  right: {size_px: [1280, 720], matrix: [[850, 0, 640], [0, 850, 360], [0, 0, 1]], distortion: [0, 0, 0, 0, 0]}
"""


def test_a_robot_on_a_bench_by_the_command_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A real concentric-tube robot before crumpled cloth and a plate of dots: no clamp, a lens known by name only."""
    data = shared("real") / "ctr-robot"
    plate = json.loads((data / "calibration.json").read_text())["plate"]
    monkeypatch.chdir(tmp_path)
    for camera in ("left", "right"):
        for folder, name in ((f"photos/{camera}", camera), (f"photos/background/{camera}", f"background_{camera}")):
            Path(folder).mkdir(parents=True)
            cv2.imwrite(f"{folder}/robot.png", cv2.imread(str(data / f"{name}.png")))
    rows = ["name,x_mm,y_mm,z_mm,left_x_px,left_y_px,right_x_px,right_y_px"]
    both = zip(plate["object_mm"], plate["left_px"], plate["right_px"], strict=True)
    rows += [",".join(map(str, (f"d{k}", *xyz, *left, *right))) for k, (xyz, left, right) in enumerate(both)]
    Path("points.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    Path("lenses.yaml").write_text(LENSES, encoding="utf-8")
    Path("tube.yaml").write_text("diameter_mm: 2.6\ntip: {shape: open}\ntapered: true\n", encoding="utf-8")
    assert leave(["register", "--points", "points.csv", "--rig", "lenses.yaml", "-o", "rig.yaml"]) == 0
    run = "run photos --rig rig.yaml --tube tube.yaml -o out --overlay"
    assert leave([*run.split(), "--base", "left:511,61", "right:705,64"]) == 0
    (row,) = read_shapes(Path("out/shapes.csv"))
    assert row.status == Status.OK
    assert "stands for the tip" in row.notes
    assert "Warning" not in capsys.readouterr().err
    rig = load_rig(Path("rig.yaml")).rig
    # Base, the step from the outer tube to the next one, and the tip, by hand: 255 mm along the two chords. The curve
    # is longer than chords, but ends about 3 cm before the tip.
    by_hand = {"left": [(511, 61), (612, 404), (779, 487)], "right": [(705, 64), (745, 413), (1080, 604)]}
    chords = np.diff(
        rig.triangulate({name: rig.cameras[name].unproject(np.array(px, float)) for name, px in by_hand.items()}),
        axis=0,
    )
    assert row.length_mm == pytest.approx(np.linalg.norm(chords, axis=1).sum(), rel=0.06)
    points = read_curves(Path("out/curves.npz")).xyz_mm[0]
    # The robot is where a picture differs from the one without it: centres of that along rows, and no other part of the
    # project. The rig is registered to 0.45 px, and its lens is guessed.
    for camera, on_it in (
        ("left", [(515, 100), (529, 180), (563, 295), (609, 400), (657, 463), (698, 494)]),
        ("right", [(703, 130), (707, 210), (717, 305), (741, 400), (801, 510), (860, 568), (941, 612)]),
    ):
        off = place_along(rig.project(camera, points), centres(data, camera, on_it))[1]
        assert np.median(off) < 1.5, (camera, off)


def centres(data: Path, camera: str, near: list[tuple[int, int]]) -> np.ndarray:
    """Centres (N, 2) of what differs from the background along rows, within 14 px of some places."""
    names = (f"{camera}.png", f"background_{camera}.png")
    picture, empty = (cv2.imread(str(data / name)).astype(float) for name in names)
    found = []
    for x, y in near:
        # 60 of 765 levels: above the noise and compression of both pictures.
        weight = np.clip(np.abs(picture - empty).sum(-1)[y, x - 14 : x + 15] - 60, 0, None)
        found.append((x - 14 + np.average(np.arange(29), weights=weight), y))
    return np.array(found)
