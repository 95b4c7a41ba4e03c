"""From exact views to the shape: the closed form as a whole, before changed cameras, frames and scales.

The closed form describes an image by the simplest conic within 0.025 px, so that its points are off by some hundredths
of a millimetre while the tip, which is triangulated, is exact. What a change of frame may alter is rounding alone.
"""

from collections.abc import Mapping

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from geometry_scenes import LENGTH_MM, Array, azimuths, few, fewer, poses, rays_of, rigs, sight
from tubesight.core import Tube
from tubesight.geometry.cone import epipolar_crossing
from tubesight.geometry.curve import Curve3D
from tubesight.geometry.pose import Pose
from tubesight.geometry.rig import Rig
from tubesight.geometry.shape import shape_of
from tubesight.methods.cone_ray import curve_points, solve
from tubesight.simulate import Arc, EllipseArc
from tubesight.vision.view import TipView, View

RADIUS_MM = 6.0
# Closer to a common plane than this, the rays that are left do not reach both ends of the tube.
GOOD_CROSSING = 0.15
# A model, of an image or of the tube, is taken for right within 0.1 px: at 0.5 m and 1500 px 0.033 mm across the line
# of sight.
MODEL_MM = 0.1 * 500 / 1500
# Rounding, magnified by the same and by what a conic and an ellipse in space lose.
SAME_MM = 1e-5


def view(rig: Rig, name: str, tube: Arc | EllipseArc, world: Pose, scale: float = 1.0, count: int = 60) -> View:
    """Exact view of a tube that stands at `world` (base_from_tube) before a rig, both scaled."""
    camera, pose = rig.cameras[name], rig.camera_from_base[name]
    points = scale * world.apply(tube.at(np.linspace(0.01, 0.99, count) * LENGTH_MM))
    base, tip = (rays_of(rig, name, scale * world.apply(tube.at(np.array([s]))))[0] for s in (0.0, LENGTH_MM))
    rays = rays_of(rig, name, points)
    px = camera.project(rays)
    along = np.gradient(px, axis=0)
    normal = np.stack([along[:, 1], -along[:, 0]], -1) / np.linalg.norm(along, axis=1, keepdims=True)
    half = RADIUS_MM * scale * camera.focal_px / pose.apply(points)[:, 2:]
    edges = np.stack([px + half * normal, px - half * normal], 1)
    edge_rays = camera.unproject(edges)
    edge_rays /= np.linalg.norm(edge_rays, axis=-1, keepdims=True)
    end = TipView(tip / np.linalg.norm(tip), camera.project(tip), float("nan"), np.zeros((0, 2)), 0.0, 0.0)
    return View(name, edges, edge_rays, rays, px, base, end, np.zeros(2), np.zeros(2), 0.5, "drawn")


def views(rig: Rig, tube: Arc | EllipseArc, world: Pose | None = None, scale: float = 1.0) -> dict[str, View]:
    return {name: view(rig, name, tube, world or Pose.identity(), scale) for name in rig.names}


def good(rig: Rig, tube: Arc | EllipseArc) -> None:
    """Keep the scene if both cameras and the tube are far enough from a common plane."""
    assume(sight(rig, tube).crossing > GOOD_CROSSING)


def tie(rig: Rig, tube: Arc | EllipseArc) -> bool:
    """Whether both views are crossed alike: rounding then decides which makes the cone."""
    points = tube.at(np.linspace(0.01, 0.99, 60) * LENGTH_MM)
    crossing = [
        epipolar_crossing(rays_of(rig, a, points)[:, :2], rig.relative_pose(a, b).translation_mm)
        for a, b in (rig.names, rig.names[::-1])
    ]
    return abs(crossing[0] - crossing[1]) < 1e-9


def shape_mm(rig: Rig, tube: Arc | EllipseArc) -> float:
    """Three times what a model may be off in depth: over the sines of the cameras' angle and of the crossing."""
    toward = [rig.centre_mm(n) - [0, 0, LENGTH_MM / 2] for n in rig.names]
    a, b = (d / np.linalg.norm(d) for d in toward)
    return float(3 * MODEL_MM / np.linalg.norm(np.cross(a, b)) / sight(rig, tube).crossing)


def sampled(curve: Curve3D) -> Array:
    return curve.at(np.linspace(0, curve.length_mm, 17))


tubes = st.one_of(
    st.builds(Arc, st.floats(np.radians(5), np.radians(90)), azimuths, st.just(LENGTH_MM)),
    st.builds(
        EllipseArc, st.floats(np.radians(30), np.radians(80)), st.sampled_from([0.6, 1.6]), azimuths, st.just(LENGTH_MM)
    ),
)


@few
@given(rigs(), tubes)
def test_points_of_the_closed_form_lie_on_the_tube(rig: Rig, tube: Arc | EllipseArc) -> None:
    good(rig, tube)
    seen = views(rig, tube)
    points, weights = curve_points(seen["left"], seen["right"], rig)
    truth = tube.at(np.linspace(0, LENGTH_MM, 4001))
    off = np.array([np.linalg.norm(truth - p, axis=1).min() for p in points])
    assert np.sqrt(np.average(off**2, weights=weights**2)) < shape_mm(rig, tube)
    order = np.array([np.linalg.norm(truth - p, axis=1).argmin() for p in points])
    assert (np.diff(order) > 0).all()


@few
@given(rigs(), st.floats(np.radians(5), np.radians(90)), azimuths)
def test_clamped_circles_come_back_exactly(rig: Rig, theta: float, phi: float) -> None:
    """Their curve follows from the tip, and the tip from its two axes."""
    tube = Arc(theta, phi, LENGTH_MM)
    good(rig, tube)
    curve = solve(views(rig, tube), rig, Tube(2 * RADIUS_MM, clamped=True))
    assert curve.model == "circle"
    shape = shape_of(curve, 0.1)
    # A tip known to 1e-10 mm, over a chord of 140 mm and a distance of 7 mm from the axis.
    assert np.allclose(shape.tip_mm, tube.at(LENGTH_MM), rtol=0, atol=1e-9)
    assert shape.bending_rad == pytest.approx(theta, abs=1e-10)
    assert abs((shape.orientation_rad - phi + np.pi) % (2 * np.pi) - np.pi) < 1e-9
    assert shape.length_mm == pytest.approx(LENGTH_MM, abs=1e-9)
    assert shape.curvature_per_mm == pytest.approx(theta / LENGTH_MM, rel=1e-9)


@few
@given(rigs())
def test_clamped_straight_tubes_come_back_exactly(rig: Rig) -> None:
    good(rig, Arc(0.0, 0.0, LENGTH_MM))
    curve = solve(views(rig, Arc(0.0, 0.0, LENGTH_MM)), rig, Tube(2 * RADIUS_MM, clamped=True))
    shape = shape_of(curve, 0.1)
    assert (curve.model, shape.bending_rad) == ("line", 0)
    assert np.isnan(shape.orientation_rad)
    assert shape.length_mm == pytest.approx(LENGTH_MM, abs=1e-9)


@few
@given(rigs(), tubes, st.booleans())
def test_the_whole_curve_comes_back(rig: Rig, tube: Arc | EllipseArc, clamped: bool) -> None:
    good(rig, tube)
    curve = solve(views(rig, tube), rig, Tube(2 * RADIUS_MM, clamped=clamped))
    truth = tube.at(np.linspace(0, LENGTH_MM, 4001))
    off = max(float(np.linalg.norm(truth - p, axis=1).min()) for p in sampled(curve))
    assert off < shape_mm(rig, tube)
    assert curve.length_mm == pytest.approx(LENGTH_MM, abs=shape_mm(rig, tube))


@fewer
@given(rigs(), tubes, st.booleans())
def test_cameras_may_be_swapped(rig: Rig, tube: Arc | EllipseArc, clamped: bool) -> None:
    good(rig, tube)
    assume(not tie(rig, tube))
    seen, what = views(rig, tube), Tube(2 * RADIUS_MM, clamped=clamped)
    there = Rig(dict(reversed(rig.cameras.items())), dict(reversed(rig.camera_from_base.items())))
    swapped: Mapping[str, View] = dict(reversed(seen.items()))
    here, back = solve(seen, rig, what), solve(swapped, there, what)
    assert here.model == back.model
    assert np.allclose(sampled(here), sampled(back), rtol=0, atol=SAME_MM)


@fewer
@given(rigs(), tubes, poses)
def test_free_tubes_move_with_their_rig(rig: Rig, tube: Arc | EllipseArc, move: Pose) -> None:
    good(rig, tube)
    assume(not tie(rig, tube))
    moved = Rig(rig.cameras, {n: p @ move.inverse() for n, p in rig.camera_from_base.items()})
    here, there = solve(views(rig, tube), rig, Tube(12.0)), solve(views(moved, tube, move), moved, Tube(12.0))
    assert here.model == there.model
    assert np.allclose(move.apply(sampled(here)), sampled(there), rtol=0, atol=SAME_MM)


@fewer
@given(rigs(), tubes, st.booleans(), st.floats(0, 2 * np.pi))
def test_a_turn_about_the_clamp_turns_the_shape(rig: Rig, tube: Arc | EllipseArc, clamped: bool, turn: float) -> None:
    good(rig, tube)
    assume(not tie(rig, tube))
    move = Pose.from_rotvec([0, 0, turn], np.zeros(3))
    moved = Rig(rig.cameras, {n: p @ move.inverse() for n, p in rig.camera_from_base.items()})
    what = Tube(2 * RADIUS_MM, clamped=clamped)
    here, there = solve(views(rig, tube), rig, what), solve(views(moved, tube, move), moved, what)
    assert np.allclose(move.apply(sampled(here)), sampled(there), rtol=0, atol=SAME_MM)


@fewer
@given(rigs(), tubes, st.booleans(), st.floats(0.01, 20))
def test_the_world_may_be_scaled(rig: Rig, tube: Arc | EllipseArc, clamped: bool, scale: float) -> None:
    """The pictures stay the same, and so does the shape, in other units: a guidewire before a microscope."""
    good(rig, tube)
    assume(not tie(rig, tube))
    larger = Rig(rig.cameras, {n: Pose(p.rotation, scale * p.translation_mm) for n, p in rig.camera_from_base.items()})
    what = Tube(2 * RADIUS_MM, clamped=clamped)
    here, there = solve(views(rig, tube), rig, what), solve(views(larger, tube, scale=scale), larger, what)
    assert here.model == there.model
    assert np.allclose(scale * sampled(here), sampled(there), rtol=0, atol=scale * SAME_MM)
