"""Compiled code of the silhouette fit against its NumPy twins."""

import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields

import numba
import numpy as np
import pytest

from fit_scenes import curve, views_of
from tubesight.core import Status, Tip, Tube, Unmeasurable
from tubesight.core.kernels import COMPILED
from tubesight.geometry.camera import Camera
from tubesight.geometry.families import BASE, FAMILIES, INTERVALS, Family, nodes_of
from tubesight.geometry.pose import Pose
from tubesight.methods import curve_kernels, fit_kernels, kernels, ray_kernels, rays, solve
from tubesight.methods.fit import fit_family, priors
from tubesight.methods.rays import Problem, collect, rows_of_view
from tubesight.simulate import rig_around

pytestmark = pytest.mark.skipif(not COMPILED, reason="nothing is compiled here")

RIG = rig_around(80.0, size_px=(1280, 720))
BALL = Tube(12.0, Tip("ball", 16.0), clamped=True)
# Twins do the same sums in another order: a few thousand roundings of 1e-16 on numbers up to 1e3.
CLOSE = {"rtol": 1e-9, "atol": 1e-9}


def called(kernel: Callable[..., object]) -> Callable[..., object]:
    """Entry from Python to a function that only compiled ones call."""
    return numba.njit(lambda *args: kernel(*args), error_model="numpy")


PARTS = {
    name: called(getattr(kernels, name))
    for name in ("misses", "end_miss", "weights", "shift_factors", "without_shifts", "rms", "normal_equations")
}
EMPTY_NODES, EMPTY_CHAIN = called(curve_kernels.empty_nodes), called(curve_kernels.empty_chain)
NODES_OF = called(curve_kernels.nodes_of)


def parameters_of(family: Family, seed: int, size: float = 0.5) -> np.ndarray:
    rng = np.random.default_rng(seed)
    p = np.append(size * rng.normal(size=family.count - 1), 150.0)
    return np.concatenate([p, [0.3, -0.2, 0.01, -0.02]])


def compiled_nodes(family: Family, p: np.ndarray, start: Pose) -> tuple[np.ndarray, ...]:
    nodes = EMPTY_NODES(family.count)
    chain = EMPTY_CHAIN(family.count)
    rotation, translation = np.array(start.rotation), np.array(start.translation_mm)
    NODES_OF(family.kind, family.count, p, rotation, translation, chain, nodes)
    return nodes


@pytest.mark.parametrize("name", FAMILIES)
@pytest.mark.parametrize("size", [0.0, 1e-9, 0.5, 2.0])
def test_nodes_agree(name: str, size: float) -> None:
    family, start = FAMILIES[name], Pose.from_rotvec([0.3, 0.2, -0.4], [5.0, 6.0, 7.0])
    p = parameters_of(family, 4, size)
    want = nodes_of(family, p, start)
    for field, got in zip(fields(want), compiled_nodes(family, p, start), strict=True):
        np.testing.assert_allclose(got, getattr(want, field.name), err_msg=field.name, **CLOSE)


@pytest.mark.parametrize("name", FAMILIES)
def test_derivatives_of_nodes(name: str) -> None:
    """Against central differences.

    The chain carries derivatives by the midpoint rule: an arc of 1 / 48 and a polynomial of degree 4, which turns 2.6
    rad between two of its nodes, leave 2e-2 at most, and others 1e-2. The last B-spline acts on the last arcs
    alone, with the third power of the way: on seven of them the rule errs by 4e-2 of its effect, on three by 0.17.
    """
    share = {"spatial4": 2e-2, "spline": 4e-2, "fine_spline": 0.17}.get(name, 1e-2)
    family, start = FAMILIES[name], Pose.identity()
    p = parameters_of(family, 1)
    p[family.count :] = 0.0
    nodes = nodes_of(family, p, start)
    for k in range(len(p)):
        step = np.zeros(len(p))
        step[k] = 1e-5
        ahead, behind = nodes_of(family, p + step, start), nodes_of(family, p - step, start)
        slope = (ahead.points - behind.points) / 2e-5
        np.testing.assert_allclose(nodes.d_points[..., k], slope, atol=share * max(np.abs(slope).max(), 1e-3))
        turn = np.cross(nodes.d_turn[..., k], nodes.tangents)
        slope = (ahead.tangents - behind.tangents) / 2e-5
        np.testing.assert_allclose(turn, slope, atol=share * max(np.abs(slope).max(), 1e-3))
        np.testing.assert_allclose(nodes.d_s[:, k], (ahead.s_mm - behind.s_mm) / 2e-5, atol=1e-6)


def problem(tube: Tube = BALL, noise_px: float = 0.2, **changes: object) -> Problem:
    views = views_of(curve("arcs2", [0.6, 0.2, 0.1, 0.5, 0.1, 150.0]), RIG, tube, noise_px)
    ball = None if tube.tip.diameter_mm is None else tube.tip.diameter_mm / 2
    end = np.array([45.0, 20.0, 130.0]) if tube.tip.shape == "flat" else None
    return collect(views, RIG, tube, Pose.identity(), 6.0, ball, end)._replace(**changes)


PROBLEMS: dict[str, Callable[[], Problem]] = {
    "ball": problem,
    "round": lambda: problem(Tube(12.0, Tip("round"), clamped=True)),
    "flat, no tip rays": lambda: problem(Tube(12.0, Tip("flat"), clamped=True)),
    "free": lambda: problem(Tube(12.0, Tip("ball", 16.0)), clamped=False),
    "open radius": lambda: problem(radius_open=True, radius_mm=5.5),
    "outliers": lambda: problem(noise_px=8.0),
    "all edges alike": lambda: problem(noise_px=0.0, place=np.full_like(problem().place, 0.5)),
}


@pytest.mark.parametrize("name", PROBLEMS)
def test_parts_agree(name: str) -> None:
    data, family = PROBLEMS[name](), FAMILIES["ellipse"]
    rng = np.random.default_rng(5)
    p = np.concatenate([[0.5, 0.3, 0.2, -0.3, 149.0], 0.01 * rng.normal(size=BASE), [0.1] * data.radius_open])
    nodes = nodes_of(family, p[: family.count + BASE], data.start)
    arrays = compiled_nodes(family, p[: family.count + BASE], data.start)
    start = np.floor(data.place * INTERVALS + 0.5).astype(np.int64)
    miss, jacobian, near = solve.misses(data, nodes, p, start)
    got_miss, got_jacobian, got_near = np.empty_like(miss), np.empty_like(jacobian), start.copy()
    PARTS["misses"](data, arrays, p, got_near, got_miss, got_jacobian)
    np.testing.assert_array_equal(got_near, near)
    np.testing.assert_allclose(got_miss, miss, **CLOSE)
    np.testing.assert_allclose(got_jacobian, jacobian, **CLOSE)

    end, end_slope = solve.end_miss(data, nodes, len(p))
    got_slope = np.empty(len(p))
    np.testing.assert_allclose(PARTS["end_miss"](data, arrays, got_slope), end, **CLOSE)
    np.testing.assert_allclose(got_slope, end_slope, **CLOSE)

    weight = solve.weights(data, miss)
    got_weight = np.empty_like(weight)
    PARTS["weights"](data, miss, got_weight)
    np.testing.assert_allclose(got_weight, weight, **CLOSE)
    assert ((weight >= 0) & (weight <= 1)).all()

    a = solve.precision(data, weight)
    got_a, factors = np.empty_like(a), np.empty((2, solve.NUISANCES, solve.NUISANCES))
    PARTS["shift_factors"](data, weight, got_a, factors)
    residual, cost = solve.without_shifts(data, miss, a)
    got_residual = np.empty_like(residual)
    np.testing.assert_allclose(PARTS["without_shifts"](data, miss, got_a, factors, got_residual), cost, **CLOSE)
    np.testing.assert_allclose(got_residual, residual, **CLOSE)
    np.testing.assert_allclose(PARTS["rms"](data, residual), solve.rms(data, residual), **CLOSE)

    hessian, gradient = solve.normal_equations(data, jacobian, residual, a)
    got_hessian, got_gradient = np.zeros_like(hessian), np.zeros_like(gradient)
    PARTS["normal_equations"](data, jacobian, residual, a, factors, got_hessian, got_gradient)
    np.testing.assert_allclose(np.tril(got_hessian), np.tril(hessian), rtol=1e-9, atol=1e-9 * np.abs(hessian).max())
    np.testing.assert_allclose(got_gradient, gradient, rtol=1e-9, atol=1e-9 * np.abs(gradient).max())

    known = np.diag(priors(data, family)[0])
    want = solve.sandwich(data, jacobian, residual, weight, known, family.count, 150.0)
    got = fit_kernels.sandwich(data, jacobian, residual, weight, known, family.count, 150.0)
    np.testing.assert_allclose(got, want, rtol=1e-6, atol=1e-9 * np.abs(want).max())


@pytest.mark.parametrize("family", ["circle", "ellipse", "arcs2", "spatial2", "polynomial2"])
@pytest.mark.parametrize("name", PROBLEMS)
def test_fits_agree(name: str, family: str) -> None:
    """Three steps from a rough guess: decisions on the way are the same, and roundings grow by the condition."""
    data, f = PROBLEMS[name](), FAMILIES[family]
    guess = {
        "circle": [0.4, 0.4, 145.0],
        "ellipse": [0.4, 0.4, 0.1, 0.1, 145.0],
        "arcs2": [0.2, 0.2, 0.2, 0.2, 0.0, 145.0],
        "spatial2": [0.4, 0.4, 0.0, 0.0, 0.0, 0.0, 145.0],
        "polynomial2": [0.7, 0.5, 0.0, 0.0, 145.0],
    }[family]
    prior, anchor = priors(data, f)
    p = np.zeros(len(prior))
    p[: f.count] = guess
    want = solve.fit(data, f, p, prior, anchor, np.inf, 3)
    got = fit_kernels.fit(data, f, p, prior, anchor, np.inf, 3)
    # At most 1e6 of condition in the normal equations of three steps.
    np.testing.assert_allclose(got[0], want[0], rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(got[1].points, want[1].points, rtol=0, atol=1e-7)
    for k in (2, 3, 5, 6):
        np.testing.assert_allclose(got[k], want[k], rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("worth_px", [0.01, 100.0])
def test_whole_fits_agree(worth_px: float) -> None:
    """To their end, short steps and fits that are given up included; the last steps are roundings of different sums."""
    data, family = problem(noise_px=0.05), FAMILIES["circle"]
    prior, anchor = priors(data, family)
    p = np.append([0.4, 0.3, 148.0], np.zeros(len(prior) - 3))
    want = solve.fit(data, family, p, prior, anchor, worth_px, solve.ITERATIONS)
    got = fit_kernels.fit(data, family, p, prior, anchor, worth_px, solve.ITERATIONS)
    np.testing.assert_allclose(got[0], want[0], rtol=1e-7, atol=1e-7)
    np.testing.assert_allclose(got[5:], want[5:], rtol=1e-6)


def test_movement_of_a_short_step() -> None:
    """Against the curve after it.

    Derivatives are right to 1 %; what slides along the curve does not count, so that more length counts at the end.
    """
    family, p = FAMILIES["circle"], np.array([0.4, 0.2, 150.0, 0, 0, 0, 0])
    nodes = nodes_of(family, p, Pose.identity())
    bend, longer = np.array([1e-3, 0, 0, 0, 0, 0, 0]), np.array([0, 0, 0.01, 0, 0, 0, 0])
    there = nodes_of(family, p + bend, Pose.identity())
    assert solve.movement(nodes, bend) == pytest.approx(np.linalg.norm(there.points[-1] - nodes.points[-1]), rel=0.01)
    assert solve.movement(nodes, longer) == pytest.approx(0.01, rel=0.01)
    arrays = compiled_nodes(family, p, Pose.identity())
    for step in (bend, longer, bend + longer):
        got = called(fit_kernels.movement)(arrays, p, p + step)
        np.testing.assert_allclose(got, solve.movement(nodes, step), rtol=1e-9)


@pytest.mark.parametrize("most", [5, 24, 1000])
@pytest.mark.parametrize("tip_most", [0, 7, 1000])
def test_rows_of_views_agree(most: int, tip_most: int) -> None:
    views = views_of(curve("circle", [0.5, 0.3, 150.0]), RIG, BALL, 0.1)
    sight, wants, counts = rays.optics(RIG, tuple(views)), [], [0]
    for view, rotation in zip(views.values(), sight.rotation, strict=True):
        contour = view.tip.contour_px[rays.spread(len(view.tip.contour_px), tip_most)]
        contour_rays = RIG.cameras[view.camera].unproject(contour)
        given = (view.edge_rays, view.centreline_px, view.tip.px, contour, contour_rays, rotation)
        wants.append(rows_of_view(*given, most))
        sides = min(len(view.edge_rays), most)
        counts += [sides, sides, len(contour)]
    known = rays.lenses(RIG, tuple(views))
    assert known is not None
    *got, row_start, finite = ray_kernels.gather(*rays.flat(views), *known, sight.rotation, most, tip_most)
    assert finite
    assert list(row_start) == list(np.cumsum(counts))
    for one, want in zip(got, zip(*wants, strict=True), strict=True):
        np.testing.assert_allclose(one, np.concatenate(want), **CLOSE)


@pytest.mark.parametrize(
    ("lens", "k"),
    [
        ("brown", [-0.2, 0.05, 1e-3, -2e-3, 0.01]),
        ("rational", [0.3, 0.1, 1e-3, -2e-3, 0.01, 0.5, 0.05, 0.0]),
        ("equidistant", [0.02, -0.01, 0.0, 0.0]),
        ("brown", [-3.0, 0.0, 0.0, 0.0, 0.0]),  # folds within the picture: the corners have no ray
    ],
)
def test_undistorting_agrees(lens: str, k: list[float]) -> None:
    camera = Camera(np.array([[900.0, 1.5, 640.0], [0, 910, 360], [0, 0, 1]]), (1280, 720), np.array(k), lens)
    pixels = np.stack(np.meshgrid(np.linspace(0, 1279, 9), np.linspace(0, 719, 7)), -1).reshape(-1, 2)
    np.testing.assert_allclose(rays.unprojected(camera, pixels), camera.unproject(pixels), rtol=0, atol=1e-11)


def test_meeting_point_is_where_rays_meet() -> None:
    point = np.array([20.0, -10.0, 130.0])
    centres = np.array([RIG.centre_mm(n) for n in RIG.names])
    d = (point - centres) / np.linalg.norm(point - centres, axis=1, keepdims=True)
    focal = np.array([RIG.cameras[n].focal_px for n in RIG.names])
    got, miss = ray_kernels.meeting_point(d, centres, focal)
    # Rounding of coordinates of 500 mm, and of the square root of the difference of two squares of that size.
    np.testing.assert_allclose(got, point, atol=1e-9)
    assert miss < 1e-3
    _, parallel = ray_kernels.meeting_point(np.stack([d[0], d[0]]), centres, focal)
    assert not parallel < 2.0
    assert np.isinf(ray_kernels.meeting_point(-d, centres, focal)[1])


@pytest.mark.parametrize("where", ["edge_rays", "centreline_px"])
def test_numbers_that_are_not_finite_are_refused(where: str) -> None:
    views = views_of(curve("circle", [0.5, 0.3, 150.0]), RIG, BALL)
    name, view = next(iter(views.items()))
    values = {field.name: getattr(view, field.name) for field in fields(view)}
    values[where] = values[where].copy()
    values[where][0] = np.nan
    views[name] = type(view)(**values)
    with pytest.raises(Unmeasurable) as caught:
        collect(views, RIG, BALL, Pose.identity(), 6.0, 8.0, None)
    assert caught.value.status is not Status.OK


def test_a_fit_of_nonsense_says_so() -> None:
    data = problem()
    fit = fit_family(data, FAMILIES["circle"], np.array([np.nan, 0.0, 150.0]))
    assert not fit.rms_px < 1.0


def test_without_compiling_the_twins_do_the_work() -> None:
    script = """
import sys; sys.path.insert(0, "tests")
from fit_scenes import curve, views_of
from tubesight.core import Tip, Tube
from tubesight.core.kernels import COMPILED
from tubesight.methods import METHODS
from tubesight.simulate import rig_around
assert not COMPILED
rig, tube = rig_around(80.0, size_px=(1280, 720)), Tube(12.0, Tip("ball", 16.0), clamped=True)
nodes = curve("circle", [0.5, 0.3, 150.0])
found = METHODS["silhouette"].solve(views_of(nodes, rig, tube), rig, tube)
assert found.model == "circle" and abs(found.at([found.length_mm]) - nodes.points[-1]).max() < 1e-3
"""
    done = subprocess.run(
        [sys.executable, "-c", script],
        env={"NUMBA_DISABLE_JIT": "1", "PATH": ""},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
