"""Conic fits: exact on exact points of every kind, equivariant, optimal on noisy ones, defined on degenerate ones."""

import warnings
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from geometry_scenes import Array, few, seeds
from tubesight.geometry.conic import (
    CONIC_FITS,
    Conic,
    ConicFit,
    fit_halir_flusser,
    fit_line,
    fit_parabola,
    fit_taubin,
)

FITS = pytest.mark.parametrize("fit", CONIC_FITS.values(), ids=CONIC_FITS.keys())
GENERAL = pytest.mark.parametrize("fit", [fit_halir_flusser, fit_taubin], ids=["halir_flusser", "taubin"])

# An image plane is 1 across and its points are rounded to 1e-16. The fits never square that, so that the conic passes
# the points, and others between them, at some multiple of it: 2.5e-15 was the largest of 4000 draws.
EXACT = 1e-13
# Halir and Flusser's eigenproblem on points that are no exact ellipse does square it: 1e-16 over the square of a ratio
# of singular values, 1e-4 for the thinnest arcs drawn here; 3e-9 was the largest of 4000 draws.
SQUARED = 1e-7

CANONICAL = {"ellipse": np.diag([1.0, 1, -1]), "hyperbola": np.diag([1.0, -1, -1])}
PARABOLA = np.array([[1.0, 0, 0], [0, 0, -0.5], [0, -0.5, 0]])


@dataclass(frozen=True)
class Drawn:
    """Points (N, 2) of an arc of a conic, more points of it between them, its matrix, unit norm, and its kind."""

    xy: Array
    more: Array
    matrix: Array
    kind: str


def unit(matrix: Array) -> Array:
    """Matrix of a conic with unit norm and a positive sum of weights, to compare conics by."""
    scaled = matrix / np.linalg.norm(matrix)
    return np.asarray(scaled * np.sign(scaled.flat[int(np.argmax(np.abs(scaled)))]))


@st.composite
def affinities(draw: st.DrawFn, flattest: float = 0.01) -> Array:
    """Affine maps (3, 3): turned, scaled by up to 1 : 100, shifted by half a picture."""
    a, b = draw(st.floats(0, np.pi)), draw(st.floats(0, np.pi))
    turn = [np.array([[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]]) for t in (a, b)]
    result = np.eye(3)
    result[:2, :2] = 0.3 * turn[0] @ np.diag([1.0, draw(st.floats(flattest, 1))]) @ turn[1]
    result[:2, 2] = draw(st.floats(-0.5, 0.5)), draw(st.floats(-0.5, 0.5))
    return result


@st.composite
def arcs(draw: st.DrawFn, kinds: tuple[str, ...] = ("ellipse", "hyperbola", "parabola")) -> Drawn:
    """Arcs of conics of a kind, at least 0.5 long in their parameter (30 degrees of an ellipse)."""
    kind = draw(st.sampled_from(kinds))
    start, span, count = draw(st.floats(-1, 0.5)), draw(st.floats(0.5, 2.5)), draw(st.integers(6, 60))
    t = start + span * np.linspace(0, 1, 2 * count - 1)
    curve = {"ellipse": (np.cos(t), np.sin(t)), "hyperbola": (np.cosh(t), np.sinh(t)), "parabola": (t, t * t)}[kind]
    map_ = draw(affinities())
    xy = np.stack(curve, -1) @ map_[:2, :2].T + map_[:2, 2]
    back = np.linalg.inv(map_)
    matrix = back.T @ CANONICAL.get(kind, PARABOLA) @ back
    return Drawn(xy[::2], xy[1::2], unit(matrix), kind)


@few
@given(arcs())
def test_taubin_returns_exact_conics_of_every_kind(drawn: Drawn) -> None:
    conic = fit_taubin(drawn.xy)
    assert conic.kind == drawn.kind or (drawn.kind == "parabola" and conic.kind in ("ellipse", "hyperbola"))
    assert np.abs(conic.sampson(drawn.more)).max() < EXACT
    if drawn.kind == "parabola":
        # Rounding makes it an ellipse or a hyperbola; magnified 100 times by the flattest frame (1.4e-13 measured).
        assert abs(np.linalg.det(conic.normal[:2, :2])) < 100 * EXACT


@few
@given(arcs(("ellipse",)))
def test_halir_flusser_returns_exact_ellipses(drawn: Drawn) -> None:
    conic = fit_halir_flusser(drawn.xy)
    assert conic.kind == "ellipse"
    assert np.abs(conic.sampson(drawn.more)).max() < EXACT


@few
@given(st.floats(-0.5, 0.5), st.floats(0.01, 3), st.floats(-3, 3), st.floats(0, np.pi), st.integers(3, 40))
def test_parabola_returns_exact_parabolas(middle: float, bend: float, shift: float, turn: float, count: int) -> None:
    # An arc symmetric about its axis has that axis as its short principal one.
    x = np.linspace(-0.5, 0.5, count)
    cos, sin = np.cos(turn), np.sin(turn)
    xy = np.stack([x, 0.1 * bend * x * x], -1) @ np.array([[cos, sin], [-sin, cos]]) + [middle, shift]
    conic = fit_parabola(xy)
    assert conic.kind == "parabola"
    assert np.abs(conic.sampson(xy)).max() < EXACT


@few
@given(arcs())
def test_the_matrix_is_the_conic_on_the_image_plane(drawn: Drawn) -> None:
    matrix = fit_taubin(drawn.xy).matrix
    assert np.allclose(matrix, matrix.T, rtol=0, atol=1e-15)
    assert np.linalg.norm(matrix) == pytest.approx(1)
    v = np.column_stack([drawn.more, np.ones(len(drawn.more))])
    assert np.abs(np.einsum("ni,ij,nj->n", v, matrix, v)).max() < EXACT


@few
@given(arcs(("ellipse", "hyperbola")), st.floats(-0.4, 0.4), st.floats(-0.4, 0.4))
def test_taubin_follows_projective_maps(drawn: Drawn, p: float, q: float) -> None:
    """Another camera in the same place sees ``H^-T C H^-1``; that may be a conic of another kind."""
    homography = np.array([[1.0, 0, 0], [0, 1, 0], [p, q, 1]])
    v = np.column_stack([drawn.xy, np.ones(len(drawn.xy))]) @ homography.T
    assume(v[:, 2].min() > 0.2)
    back = np.linalg.inv(homography)
    expected = Conic.from_matrix(back.T @ drawn.matrix @ back)
    found = fit_taubin(v[:, :2] / v[:, 2:])
    more = np.column_stack([drawn.more, np.ones(len(drawn.more))]) @ homography.T
    assert np.abs(found.sampson(more[:, :2] / more[:, 2:])).max() < EXACT
    discriminant = np.linalg.det(expected.matrix[:2, :2])
    if abs(discriminant) > 1e-6:
        assert found.kind == ("ellipse" if discriminant > 0 else "hyperbola")


@GENERAL
@few
@given(arcs(), affinities(0.1), seeds)
def test_fits_follow_affine_maps_with_their_noise(fit: ConicFit, drawn: Drawn, map_: Array, seed: int) -> None:
    """The points' own frame is known up to a rotation, and both fits are invariant to rotations."""
    xy = drawn.xy + np.random.default_rng(seed).normal(0, 1e-4, drawn.xy.shape)
    here, there = fit(xy), fit(xy @ map_[:2, :2].T + map_[:2, 2])
    back = np.linalg.inv(there.frame @ map_)
    seen = unit(back.T @ (here.frame.T @ here.normal @ here.frame) @ back)
    # Carrying the matrix through two frames of up to 1 : 100 and back costs digits of its own (3e-9 measured).
    assert np.allclose(seen, unit(there.normal), rtol=0, atol=SQUARED)


@few
@given(arcs(), seeds)
def test_halir_flusser_always_gives_an_ellipse(drawn: Drawn, seed: int) -> None:
    for noise in (0.0, 1e-6, 1e-3, 0.3):
        conic = fit_halir_flusser(drawn.xy + np.random.default_rng(seed).normal(0, noise, drawn.xy.shape))
        # Exact points of a parabola or hyperbola pull the ellipse to the limit, where rounding decides.
        assert np.linalg.det(conic.normal[:2, :2]) > (0 if noise else -EXACT)


def frame_points(conic: Conic, xy: Array) -> Array:
    """Points (N, 3), homogeneous, in the frame in which a fit works."""
    return np.column_stack([xy, np.ones(len(xy))]) @ conic.frame.T


def symmetric_steps(rng: np.random.Generator, size: float) -> list[Array]:
    """Random small symmetric matrices: neighbours of a conic."""
    return [size * (m + m.T) for m in rng.normal(size=(40, 3, 3))]


@few
@given(arcs(("ellipse",)), seeds)
def test_halir_flusser_minimises_the_algebraic_distance(drawn: Drawn, seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy = drawn.xy + rng.normal(0, 1e-3, drawn.xy.shape)
    conic = fit_halir_flusser(xy)
    v = frame_points(conic, xy)

    def cost(c: Array) -> float:
        return float((np.einsum("ni,ij,nj->n", v, c, v) ** 2).sum() / np.linalg.det(c[:2, :2]))

    best = cost(np.array(conic.normal))
    for step in symmetric_steps(rng, 1e-3 * float(np.sqrt(np.linalg.det(conic.normal[:2, :2])))):
        # The fit's own error of SQUARED enters the cost at its minimum squared.
        assert cost(conic.normal + step) >= best * (1 - 1e-9)


@few
@given(arcs(), seeds)
def test_taubin_minimises_his_mean_square_distance(drawn: Drawn, seed: int) -> None:
    rng = np.random.default_rng(seed)
    xy = drawn.xy + rng.normal(0, 1e-3, drawn.xy.shape)
    conic = fit_taubin(xy)
    v = frame_points(conic, xy)

    def cost(c: Array) -> float:
        return float((np.einsum("ni,ij,nj->n", v, c, v) ** 2).sum() / (4 * ((v @ c)[:, :2] ** 2).sum()))

    best = cost(np.array(conic.normal))
    for size in (1e-2, 1e-4):
        assert all(cost(conic.normal + step) >= best * (1 - 1e-9) for step in symmetric_steps(rng, size))


def test_the_fits_differ_where_they_should() -> None:
    """A hyperbola: Taubin returns it, the ellipse and the parabola cannot."""
    t = np.linspace(-0.8, 0.8, 40)
    xy = 0.3 * np.stack([np.cosh(t), np.sinh(t)], -1)
    rms = {name: float(np.sqrt(np.mean(fit(xy).sampson(xy) ** 2))) for name, fit in CONIC_FITS.items()}
    assert rms["taubin"] < EXACT < 1e-4 < min(rms["halir_flusser"], rms["parabola"])
    assert max(rms["halir_flusser"], rms["parabola"]) < rms["line"]


@few
@given(arcs(("ellipse",)), seeds)
def test_sampson_is_the_distance_to_first_order(drawn: Drawn, seed: int) -> None:
    conic = Conic.from_matrix(drawn.matrix)
    v = np.column_stack([drawn.more, np.ones(len(drawn.more))])
    normal = 2 * (v @ drawn.matrix)[:, :2]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    off = np.random.default_rng(seed).uniform(-1, 1, len(v)) * 1e-7
    # Second order: off^2 times the curvature, at most 1 / (0.3 * 0.01^2) for an axis ratio of 100: 3e-11.
    assert np.allclose(np.abs(conic.sampson(drawn.more + off[:, None] * normal)), np.abs(off), rtol=0, atol=1e-10)


@st.composite
def lines(draw: st.DrawFn) -> tuple[Array, Array]:
    """Points (N, 2) on a line, and its unit normal."""
    turn, count = draw(st.floats(0, np.pi)), draw(st.integers(2, 40))
    along = np.array([np.cos(turn), np.sin(turn)])
    start = np.array([draw(st.floats(-0.5, 0.5)), draw(st.floats(-0.5, 0.5))])
    return start + np.linspace(0, 0.5, count)[:, None] * along, np.array([-along[1], along[0]])


@FITS
@few
@given(line=lines())
def test_points_on_a_line_give_the_double_line(fit: ConicFit, line: tuple[Array, Array]) -> None:
    xy, normal = line
    conic = fit(xy)
    assert conic.kind == "line"
    off = np.linspace(-0.3, 0.3, len(xy))
    assert np.allclose(np.abs(conic.sampson(xy + off[:, None] * normal)), np.abs(off), rtol=0, atol=1e-14)
    assert np.linalg.matrix_rank(conic.matrix, 1e-12) == 1


@FITS
@few
@given(line=lines(), depth=st.floats(-16, -4))
def test_every_fit_tends_to_the_line(fit: ConicFit, line: tuple[Array, Array], depth: float) -> None:
    """An arc of a circle 10^depth deep is fitted to a small share of its depth, down to where it is a line."""
    xy, normal = line
    assume(len(xy) >= 6)
    sag = 10**depth
    t = np.linspace(-1, 1, len(xy))
    bent = xy + sag * (1 - t * t)[:, None] * normal
    expected = sag if fit is fit_line else 0.0
    # The depth itself is rounded to 1e-16. Below 1e-11 of its length an arc counts as a line, off by its depth.
    assert np.abs(fit(bent).sampson(bent)).max() < expected + 1e-6 * sag + 1e-15 + (sag if sag < 1e-11 else 0)


@few
@given(affinities(0.1), st.integers(3, 20))
def test_taubin_returns_a_pair_of_lines(map_: Array, count: int) -> None:
    t = np.linspace(0.1, 1, count)[:, None]
    xy = np.vstack([t * [1.0, 0], -t * [1.0, 0], t * [0, 1.0], -0.7 * t * [0, 1.0]]) @ map_[:2, :2].T + map_[:2, 2]
    conic = fit_taubin(xy)
    assert conic.kind == "degenerate"
    assert np.abs(conic.sampson(xy)).max() < EXACT


@pytest.mark.parametrize("count", [3, 4])
@GENERAL
def test_fewer_than_five_points_fix_no_conic(fit: ConicFit, count: int) -> None:
    xy = np.array([[0.0, 0], [0.1, 0.01], [0.2, 0.04], [0.3, 0.09]])[:count]
    conic = fit(xy)
    assert conic.kind == "line"
    assert np.allclose(conic.sampson(xy), fit_line(xy).sampson(xy), rtol=0, atol=1e-15)
    assert np.abs(conic.sampson(xy)).max() < 0.02


def test_two_places_along_the_axis_fix_no_parabola() -> None:
    assert fit_parabola(np.array([[-1.0, 0], [-1, 0.1], [1, 0], [1, 0.1]])).kind == "line"


def test_three_points_fix_a_parabola() -> None:
    xy = np.array([[0.0, 0], [0.1, 0.01], [0.2, 0.0]])
    assert np.abs(fit_parabola(xy).sampson(xy)).max() < 1e-15
    assert fit_parabola(xy).kind == "parabola"


@GENERAL
@few
@given(arcs(), st.integers(2, 20))
def test_copies_do_not_count(fit: ConicFit, drawn: Drawn, times: int) -> None:
    """Four places, however often: the double line. Five and more: copies of all points change nothing."""
    four = np.repeat(drawn.xy[:4], times, axis=0)
    assert fit(four).kind == "line"
    once, often = fit(drawn.xy), fit(np.repeat(drawn.xy, times, axis=0))
    limit = EXACT if fit is fit_taubin or drawn.kind == "ellipse" else SQUARED
    assert np.abs(np.abs(once.sampson(drawn.more)) - np.abs(often.sampson(drawn.more))).max() < limit


@GENERAL
def test_a_line_and_one_point_fix_no_conic(fit: ConicFit) -> None:
    xy = np.array([[0.0, 0], [0.1, 0], [0.2, 0], [0.3, 0], [0.4, 0], [0.2, 0.01]])
    assert fit(xy).kind == "line"


@FITS
def test_points_that_say_nothing_are_refused(fit: ConicFit) -> None:
    with pytest.raises(ValueError, match="points that differ"):
        fit(np.full((8, 2), 0.3))
    with pytest.raises(ValueError, match="at least two, got 1"):
        fit(np.zeros((1, 2)))
    with pytest.raises(ValueError, match="finite points"):
        fit(np.array([[0.0, 0], [1, 1], [np.nan, 2], [3, 5], [4, 1], [2, 2]]))
    with pytest.raises(ValueError, match=r"expected shape \(N, 2\), got \(4, 3\)"):
        fit(np.zeros((4, 3)))


@FITS
@few
@given(seed=seeds, count=st.integers(2, 12))
def test_any_scatter_gives_a_finite_conic_without_a_warning(fit: ConicFit, seed: int, count: int) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        xy = np.random.default_rng(seed).integers(-2, 3, (count, 2)).astype(float)
        assume(len(np.unique(xy, axis=0)) > 1)
        conic = fit(xy)
        assert np.isfinite(conic.matrix).all()
        assert conic.kind in ("ellipse", "hyperbola", "parabola", "line", "degenerate")


@pytest.mark.parametrize(
    ("matrix", "kind"),
    [
        (CANONICAL["ellipse"], "ellipse"),
        (np.diag([1.0, 2, 3]), "ellipse"),  # without real points
        (CANONICAL["hyperbola"], "hyperbola"),
        (PARABOLA, "parabola"),
        (np.diag([1.0, -1, 0]), "degenerate"),  # two lines
        (np.diag([1.0, 1, 0]), "degenerate"),  # a point
        (np.array([[0.0, 0, 0], [0, 0, 0.5], [0, 0.5, 1]]), "degenerate"),  # a line and the line at infinity
        (np.outer([3.0, 4, 1], [3.0, 4, 1]), "line"),
    ],
)
def test_kinds_of_conics(matrix: Array, kind: str) -> None:
    assert Conic.from_matrix(matrix).kind == kind
    assert Conic.from_matrix(-2 * matrix).kind == kind


def test_distance_from_a_double_line_is_exact() -> None:
    conic = Conic.from_matrix(np.outer([3.0, 4, 1], [3.0, 4, 1]))
    assert np.abs(conic.sampson(np.array([[0.0, 0], [1, 1]]))) == pytest.approx([1 / 5, 8 / 5])


def test_a_conic_has_no_distance_from_its_centre() -> None:
    assert np.isinf(Conic.from_matrix(CANONICAL["ellipse"]).sampson(np.zeros((1, 2)))).all()
