"""Planning: outlines touch the tube, information adds up, predictions come true, places keep the rules."""

import csv
import itertools
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from geometry_scenes import fewer
from tubesight.apps.planning.config import EXAMPLE, load_plan
from tubesight.apps.planning.information import CONTOUR, SCANS, Errors, information, noisy
from tubesight.apps.planning.placement import Place, Sector, best_places, candidates, rig_of, target_of
from tubesight.apps.planning.plan import make_plan
from tubesight.apps.planning.prediction import predict
from tubesight.apps.planning.views import draw, drawn_rig, exact_views, view_of
from tubesight.apps.planning.workspace import QUANTITIES, Workspace, survey
from tubesight.cli.main import main
from tubesight.core import InputError, Tip, Tube
from tubesight.files.rig import load_rig, save_rig
from tubesight.geometry.rig import Rig, RigCovariance
from tubesight.methods import METHODS
from tubesight.simulate import rig_around, truth
from tubesight.simulate.outlines import outline, stations
from tubesight.simulate.phantom import Arc

TUBE = Tube(12.0, Tip("ball", 16.0), clamped=True)
ROUND = Tube(8.0, Tip("round"), clamped=True)
RIG = rig_around(90.0)
# Errors of the edges alone, in a clamp that is as good as exact.
EDGES = Errors(shading_px=0.0, bias_px=0.0, clamp_mm=1e-6, clamp_rad=1e-8)


def arc(bending_deg: float, orientation_deg: float, length_mm: float = 160.0) -> Arc:
    return Arc(float(np.radians(bending_deg)), float(np.radians(orientation_deg)), length_mm)


def leave(*args: str | Path) -> int:
    with pytest.raises(SystemExit) as left:
        main([str(arg) for arg in args])
    return int(left.value.code or 0)


@fewer
@given(st.floats(0, 60), st.floats(0, 360), st.sampled_from([TUBE, ROUND]))
def test_outlines_touch_the_tube(bending: float, orientation: float, tube: Tube) -> None:
    """Every edge ray passes the centreline at the tube's radius, every contour ray the tip at that of the ball.

    2e-3 mm: the centreline is looked at every 0.02 mm, and lenses are inverted to 1e-10 px. Up to 60 degrees no edge
    lies behind a cusp, where the distance is not least.
    """
    phantom = arc(bending, orientation)
    dense = phantom.at(np.linspace(0, 160, 8001))
    assert tube.diameter_mm is not None
    for name in RIG.names:
        camera, centre = RIG.cameras[name], RIG.centre_mm(name)
        seen = outline(stations(phantom, tube), camera, RIG.camera_from_base[name], tube)
        rays = RIG.directions(name, camera.unproject(seen.edges_px.reshape(-1, 2)))
        off = np.linalg.norm(np.cross(dense[None] - centre, rays[:, None]), axis=-1).min(1)
        np.testing.assert_allclose(off, tube.diameter_mm / 2, atol=2e-3)
        rays = RIG.directions(name, camera.unproject(seen.contour_px))
        off = np.linalg.norm(np.cross(dense[-1] - centre, rays), axis=-1)
        np.testing.assert_allclose(off, (tube.tip.diameter_mm or tube.diameter_mm) / 2, atol=1e-6)


def test_outlines_are_those_of_photographs_seen_by_a_method() -> None:
    """From exact outlines the fit gives the tube back: 1e-3 mm, as its own tests have it."""
    phantom = arc(40, 70)
    exact = exact_views(phantom, RIG, TUBE)
    views = {name: view_of(exact[name], name, RIG.cameras[name], Errors()) for name in RIG.names}
    curve = METHODS["silhouette"].solve(views, RIG, TUBE)
    assert np.abs(curve.at([curve.length_mm])[0] - phantom.at(160.0)).max() < 1e-3


def test_noise_is_as_large_as_told() -> None:
    """Deviations of 500 draws: known to 1 / sqrt(1000) = 3 % each; the largest of 64 lies within 4 of those."""
    seen = exact_views(arc(40, 70), RIG, TUBE)["left"]
    errors = Errors(noise_px=0.1, shading_px=0.0, bias_px=0.0)
    drawn = [noisy(seen, errors, np.random.default_rng(k)) for k in range(500)]
    left = np.array([d.edges_px[:, 0] - seen.edges_px[:, 0] for d in drawn])
    np.testing.assert_allclose(np.sqrt((left**2).sum(-1).mean(0)), 0.1, rtol=0.14)
    assert left.shape == (500, SCANS, 2) and drawn[0].contour_px.shape == (CONTOUR, 2)


@fewer
@given(st.floats(5, 80), st.floats(0, 360))
def test_deviations_scale_with_the_noise(bending: float, orientation: float) -> None:
    """In an exact clamp and without shifts all deviations are proportional to the noise; 1e-4: the clamp is not "
    "exact."""
    one, two = (predict(arc(bending, orientation), RIG, TUBE, replace(EDGES, noise_px=n)) for n in (0.05, 0.1))
    assert two.tip_mm == pytest.approx(2 * one.tip_mm, rel=1e-4)
    assert two.length_mm == pytest.approx(2 * one.length_mm, rel=1e-4)
    assert two.orientation_rad == pytest.approx(2 * one.orientation_rad, rel=1e-4)


def test_turning_rig_and_tube_together_changes_nothing() -> None:
    target = np.array([0, 0, 80.0])
    camera = load_plan(None).camera
    found = []
    for turn in (0.0, 77.0):
        rig = rig_of([Place(10 + turn, 0, 300), Place(100 + turn, 20, 300)], camera, target, 0.2)
        found.append(predict(arc(50, 30 + turn), rig, TUBE, Errors()))
    # Differences of 1e-4 rad and central: 1e-6 of themselves.
    assert found[0].tip_mm == pytest.approx(found[1].tip_mm, rel=1e-5)
    assert found[0].orientation_rad == pytest.approx(found[1].orientation_rad, rel=1e-5)


def test_a_third_camera_only_helps() -> None:
    rig = rig_around(60.0, names=("left", "right", "third"))
    pair = Rig({n: rig.cameras[n] for n in ("left", "right")}, {n: rig.camera_from_base[n] for n in ("left", "right")})
    for orientation in (0, 100, 200):
        three, two = (predict(arc(50, orientation), r, TUBE, Errors()) for r in (rig, pair))
        assert three.tip_mm < two.tip_mm and three.length_mm < two.length_mm


def test_what_is_not_seen_or_not_defined_is_not_known() -> None:
    outside = predict(arc(90, 0), rig_around(90.0, distance_mm=150.0), TUBE, Errors())
    assert np.isnan(outside.tip_mm) and np.isnan(outside.length_mm)
    straight = predict(arc(0, 0), RIG, TUBE, Errors())
    assert np.isnan(straight.orientation_rad)
    assert 0 < straight.bending_rad < np.radians(0.1) and 0 < straight.tip_mm < 0.1
    told = information(arc(90, 0), rig_around(90.0, distance_mm=150.0), "left", TUBE, Errors())
    assert not told.seen and not told.matrix.any()


CALIBRATED = Rig(
    RIG.cameras,
    RIG.camera_from_base,
    covariance=RigCovariance(("left.cx", "right.cy", "left.tz"), np.diag([0.2, 0.3, 0.1]) ** 2),
)


@pytest.mark.parametrize("rig", [RIG, CALIBRATED], ids=["exact", "calibrated"])
@pytest.mark.parametrize("method", ["silhouette"])
def test_predictions_come_true(rig: Rig, method: str) -> None:
    """Errors of the fit on drawn edges are the predicted ones within 20 %, over the workspace.

    240 draws of numbers of one to three degrees of freedom: the root of their mean square is known to 5 %. The fit does
    not know the sizes of shading and blur, which costs it up to 10 %.
    """
    tip, length, bending = [], [], []
    for index, (b, o) in enumerate((b, o) for b in (10, 45, 80) for o in (20, 110, 200, 290)):
        phantom = arc(b, o)
        told = predict(phantom, rig, TUBE, Errors())
        for k in range(20):
            drawn = draw(phantom, rig, TUBE, Errors(), np.random.default_rng([index, k]))
            curve = METHODS[method].solve(drawn.views, rig, TUBE)
            true = truth(drawn.tube_as_it_is)
            tip.append(np.linalg.norm(curve.at([curve.length_mm])[0] - true["tip"]) / told.tip_mm)
            length.append((curve.length_mm - true["length"]) / told.length_mm)
            base, end = curve.tangent([0.0, curve.length_mm])
            theta = np.arctan2(np.linalg.norm(np.cross(base, end)), base @ end)
            bending.append((theta - np.radians(true["theta"])) / told.bending_rad)
    for ratios in (tip, length, bending):
        assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.2)


def test_a_drawn_rig_differs_as_told() -> None:
    """400 draws of a deviation: known to 1 / sqrt(800) = 3.5 %."""
    moved = [drawn_rig(CALIBRATED, np.random.default_rng(k)) for k in range(400)]
    off = np.array([r.cameras["left"].matrix[0, 2] for r in moved]) - RIG.cameras["left"].matrix[0, 2]
    assert off.std() == pytest.approx(0.2, rel=0.14)
    assert all(r.cameras["right"].matrix[0, 2] == RIG.cameras["right"].matrix[0, 2] for r in moved)
    assert drawn_rig(RIG, np.random.default_rng(0)) is RIG


def test_workspace_spreads_its_poses() -> None:
    poses = Workspace(160.0, (0.0, 90.0), (0.0, 360.0)).poses(4, 8)
    assert len(poses) == 1 + 3 * 8, "one straight tube"
    assert len({p.phi_rad for p in poses}) == 8, "a whole turn does not come back to its start"
    assert len(Workspace(160.0, (30.0, 30.0), (10.0, 10.0)).poses(4, 8)) == 1
    rows = [pose.row() for pose in survey(poses[:3], RIG, TUBE, Errors(), 0.0)]
    assert all(rows[1][f"{name}_sd_{unit}"] > 0 for name, unit in QUANTITIES.items())


def best(**changes: object) -> tuple[tuple[Place, ...], float]:
    """Best placement for the default plan with changed rules."""
    task = load_plan(None)
    rules = replace(task.rules, distance_mm=(300.0, 300.0), **changes)  # type: ignore[arg-type]
    found = best_places(task.workspace.poses(3, 6), task.tube, 2, task.camera, rules, task.errors, task.calibration_px)
    assert all(a.tip_sd_mm <= b.tip_sd_mm for a, b in itertools.pairwise(found) if a.seen == b.seen)
    return found[0].places, found[0].tip_sd_mm


def apart(places: tuple[Place, ...]) -> float:
    one, other = (p.direction for p in places)
    return float(np.degrees(np.arccos(np.clip(one @ other, -1, 1))))


def test_two_cameras_stand_at_right_angles_where_they_may() -> None:
    """By symmetry; a step of the candidates beside it is 15 degrees."""
    places, _ = best()
    assert 75 <= apart(places) <= 105


def test_places_keep_the_rules() -> None:
    forbidden = (Sector((30.0, 300.0), (-90.0, 90.0)),)
    places, worse = best(forbidden=forbidden, apart_deg=40.0)
    assert all(not s.holds(p.azimuth_deg, p.elevation_deg) for s in forbidden for p in places)
    assert 40 <= apart(places) <= 140
    assert worse >= best()[1], "rules cost, they do not help"
    rules = load_plan(None).rules
    assert {p.elevation_deg for p in candidates(replace(rules, allowed=Sector((0, 90), (-20, 30))))} >= {-20.0, 30.0}
    # A sector may run through north.
    assert Sector((350, 370), (0, 0)).holds(5, 0) and not Sector((350, 370), (0, 0)).holds(20, 0)


def test_impossible_rules_are_told() -> None:
    task = load_plan(None)
    few = task.workspace.poses(2, 4)
    for changes, words in (
        ({"distance_mm": (60.0, 60.0)}, "show a whole tube"),
        ({"allowed": Sector((0.0, 30.0), (0.0, 0.0)), "apart_deg": 60.0}, "degrees apart"),
    ):
        rules = replace(task.rules, **changes)  # type: ignore[arg-type]
        with pytest.raises(InputError, match=words):
            best_places(few, task.tube, 2, task.camera, rules, task.errors, 0.1)


def test_cameras_of_a_place_see_the_target_in_their_middle() -> None:
    task = load_plan(None)
    target = target_of(task.workspace.poses(3, 6))
    for portrait in (False, True):
        camera = replace(task.camera, portrait=portrait)
        rig = rig_of([Place(40.0, 20.0, 300.0)], camera, target, 0.0)
        middle, above = rig.project("camera1", target + np.array([[0, 0, 0], [0, 0, 1.0]]))
        np.testing.assert_allclose(middle, [959.5, 539.5], atol=1e-6)
        # +z runs down the picture, or across it.
        assert int(np.abs(above - middle).argmax()) == (0 if portrait else 1)
        assert np.linalg.norm(rig.centre_mm("camera1") - target) == pytest.approx(300.0)
        assert rig.centre_mm("camera1")[2] < target[2], "elevated cameras stand on the side of the clamp"


def test_the_example_is_the_defaults(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert leave("plan", "--example") == 0
    text = capsys.readouterr().out
    assert text == EXAMPLE
    (tmp_path / "plan.yaml").write_text(text)
    assert load_plan(tmp_path / "plan.yaml") == load_plan(None)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("placemnt: {}", "did you mean 'placement'"),
        ("placement: {distance_mm: [400, 250]}", "placement.distance_mm: expected two ascending numbers"),
        ("placement: {azimuth_deg: [0, 700]}", "more than once around"),
        ("placement: {forbidden: [{elevation_deg: [0, 99]}]}", "placement.forbidden.0.elevation_deg"),
        ("workspace: {bending_deg: [-5, 40]}", "workspace.bending_deg"),
        ("cameras: {view_deg: 60, focal_px: 900}", "say the same"),
        ("cameras: {count: 1}", "cameras.count"),
        ("tube: {tip: {shape: flat}}", "tube.tip.shape"),
        ("tube: {tip: {shape: ball}}", "diameter_mm"),
        ("tube: {tip: {shape: ball, diameter_mm: 3}}", "not thinner"),
        ("tube: {length_mm: 5}", "twice as long"),
        ("errors: {noise_px: 0}", "errors.noise_px"),
    ],
)
def test_bad_plans_are_refused_in_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, words: str
) -> None:
    (tmp_path / "plan.yaml").write_text(text)
    assert leave("plan", tmp_path / "plan.yaml", "-o", tmp_path / "out") == 1
    error = capsys.readouterr().err.strip()
    assert error.count("\n") == 0 and "plan.yaml" in error and words in error
    assert not (tmp_path / "out").exists()


SMALL = "tube: {length_mm: 120}\nworkspace: {bending_deg: [20, 60]}\nplacement: {distance_mm: [300, 300]}\n"


def test_plan_command_writes_what_it_says(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "plan.yaml").write_text(SMALL)
    out = tmp_path / "out"
    assert leave("plan", tmp_path / "plan.yaml", "-o", out, "--json") == 0
    printed = json.loads(capsys.readouterr().out)
    assert printed == json.loads((out / "plan.json").read_text())
    assert sorted(p.name for p in out.iterdir()) == ["plan.csv", "plan.json", "plan.png", "rig.yaml"]
    with (out / "plan.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == printed["workspace"]["poses"]
    mean = np.mean([float(row["tip_sd_mm"]) for row in rows])
    assert mean == pytest.approx(printed["workspace"]["tip_sd_mm"]["mean"], rel=1e-4)
    assert load_rig(out / "rig.yaml").rig.names == ("camera1", "camera2")
    # The rig that was written is predicted to be what it was planned to be.
    assert leave("plan", tmp_path / "plan.yaml", "--rig", out / "rig.yaml", "--json") == 0
    again = json.loads(capsys.readouterr().out)
    assert again["workspace"]["tip_sd_mm"]["mean"] == pytest.approx(mean, rel=1e-3)
    assert again["placements"] == []


def test_plan_command_prints_a_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "plan.yaml").write_text(SMALL)
    assert leave("plan", tmp_path / "plan.yaml", "--cameras", "3", "--apart", "30") == 0
    text = capsys.readouterr().out
    assert "camera3" in text and "orientation [deg]" in text and "not a medical device" in text
    assert leave("plan", tmp_path / "plan.yaml", "--rig", "rig.yaml", "--cameras", "3") == 2


def test_rigs_that_cannot_be_planned_with(tmp_path: Path) -> None:
    alone = Rig({"left": RIG.cameras["left"]}, {"left": RIG.camera_from_base["left"]})
    unregistered = Rig(RIG.cameras, RIG.camera_from_base, base_frame="left")
    for rig, words in ((alone, "one camera"), (unregistered, "not registered")):
        save_rig(tmp_path / "rig.yaml", rig)
        with pytest.raises(InputError, match=words):
            make_plan(None, tmp_path / "rig.yaml")


def test_a_rig_too_near_says_what_it_misses(tmp_path: Path) -> None:
    save_rig(tmp_path / "rig.yaml", rig_around(90.0, distance_mm=200.0))
    plan = make_plan(None, tmp_path / "rig.yaml")
    assert any("does not see all of the tube" in remark for remark in plan.remarks)
    assert plan.as_dict()["workspace"]["seen"] < 1
