"""First guesses of families, and how few fits the choice of a family takes."""

import numpy as np
import pytest

from fit_scenes import curve, views_of
from test_silhouette_fit import BALL, RIG, SHAPES, measured
from tubesight.geometry.families import FAMILIES, nodes_of
from tubesight.geometry.pose import Pose
from tubesight.methods import METHODS, choice, general
from tubesight.methods.fit import Fit
from tubesight.methods.guesses import bends_once, like_ellipse, merged_pieces, pieces_like, plane_like, smooth_like

BASE = [0.1, -0.2, 0.01, 0.02]


def fit_of(family: str, parameters: list[float]) -> Fit:
    """A fit with nothing but its parameters and its curve."""
    p, none = np.array([*parameters, *BASE]), np.zeros(0)
    return Fit(FAMILIES[family], p, nodes_of(FAMILIES[family], p, Pose.identity()), none, none, none, 0.0, 0.0)


def test_guesses_keep_the_base_of_a_free_tube() -> None:
    space = fit_of("spatial2", SHAPES["spatial2"])
    arcs = fit_of("arcs3", [0.6, 0.2, 0.3, 0.1, -0.4, 0.3, np.log(2.0), 0.0, 150.0])
    for guess in (
        smooth_like(space, FAMILIES["spatial4"]),
        pieces_like(space, FAMILIES["arcs2"]),
        plane_like(space),
        like_ellipse(space),
        merged_pieces(arcs),
    ):
        assert guess is not None
        np.testing.assert_array_equal(guess[-4:], BASE)


def test_a_polynomial_of_more_coefficients_is_the_same_curve() -> None:
    for name in ("polynomial2", "spatial2"):
        rough = fit_of(name, SHAPES[name])
        p = smooth_like(rough, FAMILIES["spatial4"])
        np.testing.assert_allclose(
            nodes_of(FAMILIES["spatial4"], p, Pose.identity()).points, rough.nodes.points, atol=1e-9
        )


def test_a_plane_curve_in_space_is_told_by_its_plane() -> None:
    """The signs of azimuth and curvature may both differ: it is the curve that counts."""
    plane = fit_of("polynomial2", SHAPES["polynomial2"])
    guess = plane_like(fit_of("spatial2", smooth_like(plane, FAMILIES["spatial2"])[:-4].tolist()))
    np.testing.assert_allclose(
        nodes_of(FAMILIES["polynomial2"], guess, Pose.identity()).points, plane.nodes.points, atol=1e-9
    )


@pytest.mark.parametrize("first", [True, False])
def test_pieces_of_one_curvature_are_merged(first: bool) -> None:
    """A piece cut into two of unlike lengths comes back."""
    cut, whole = ([0.4, 0.2], [0.2, 0.1]), [-0.5, 0.3]
    # Lengths 40, 20 and 90, or 90, 40 and 20, of 150 mm.
    bends, lengths = ([*cut, whole], [40, 20, 90]) if first else ([whole, *cut], [90, 40, 20])
    logits = np.log(np.array(lengths[:2]) / lengths[2]).tolist()
    three = fit_of("arcs3", [*np.ravel(bends), *logits, 150.0])
    guess = merged_pieces(three)
    assert guess is not None
    two = nodes_of(FAMILIES["arcs2"], guess, Pose.identity())
    np.testing.assert_allclose(two.points[[24, -1]], three.nodes.points[[32 if first else 16, -1]], atol=1e-9)
    assert merged_pieces(fit_of("arcs3", SHAPES["arcs3"])) is None


@pytest.mark.parametrize(
    ("family", "parameters", "once"),
    [
        ("polynomial2", [0.4, 0.9, 0.3, 0.1, 150.0], True),
        ("polynomial2", [0.4, 0.2, 0.9, 0.0, 150.0], False),
        ("spatial2", [0.8, 0.4, 0.2, 0.1, 0.0, 0.0, 150.0], True),
        ("spatial2", SHAPES["spatial2"], False),
        ("arcs2", [0.8, 0.4, 0.4, 0.2, 0.0, 150.0], True),
        ("arcs2", [0.8, 0.4, -0.4, -0.2, 0.0, 150.0], False),
        ("arcs2", [0.8, 0.4, -0.4, 0.8, 0.0, 150.0], False),
    ],
)
def test_bends_are_told_apart(family: str, parameters: list[float], once: bool) -> None:
    assert bends_once(fit_of(family, parameters)) == once


@pytest.mark.parametrize(
    ("name", "parameters", "noise_px", "most"),
    [
        # Edges rough enough for every family to leave more than a good one does.
        ("circle", SHAPES["circle"], 0.4, 2),
        ("ellipse", SHAPES["ellipse"], 0.05, 4),
        ("arcs2", SHAPES["arcs2"], 0.05, 4),
        ("arcs3", SHAPES["arcs3"], 0.05, 7),
    ],
)
def test_few_fits_tell_the_family(
    name: str, parameters: list[float], noise_px: float, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The circle, a polynomial, and the right family twice (a few steps, then to its end); two arcs before three."""
    tried: list[str] = []
    fit_family = choice.fit_family

    def counted(problem: object, family: object, *rest: object, **more: object) -> Fit:
        tried.append(family.name)  # type: ignore[attr-defined]
        return fit_family(problem, family, *rest, **more)  # type: ignore[arg-type]

    for module in (choice, general):
        monkeypatch.setattr(module, "fit_family", counted)
    found = measured(curve(name, parameters), BALL, noise_px=noise_px, rng=np.random.default_rng(3))
    assert found.model == name
    assert len(tried) <= most, tried


def test_ellipses_that_bend_by_a_right_angle() -> None:
    """Far from every circle: 0.05 mm, as noise of 0.05 px leaves."""
    for azimuth in (0.3, 1.9, 3.5):
        e = 0.9 * np.array([np.cos(1.0), np.sin(1.0)])
        nodes = curve("ellipse", [1.5 * np.cos(azimuth), 1.5 * np.sin(azimuth), *e, 150.0])
        views = views_of(nodes, RIG, BALL, noise_px=0.05, rng=np.random.default_rng(1))
        found = METHODS["silhouette"].solve(views, RIG, BALL)
        assert found.model == "ellipse"
        assert np.linalg.norm(found.at([found.length_mm])[0] - nodes.points[-1]) < 0.05
