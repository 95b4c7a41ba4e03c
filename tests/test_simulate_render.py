"""Photographs of phantoms: where their edges are, how bright they are, and what does not change."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from tubesight.core import Tip, Tube
from tubesight.geometry.camera import Camera
from tubesight.geometry.pose import Pose
from tubesight.simulate import (
    Arc,
    Phantom,
    Pieces,
    Placed,
    Scene,
    render,
    render_background,
    render_pair,
    rig_around,
    straight,
)
from tubesight.simulate.rays import Window, coverage, plane_points
from tubesight.simulate.scene import light_from_srgb, srgb_from_light
from tubesight.simulate.sweep import Body, Surface, see

BALL = Tube(12.0, Tip("ball", 16.0), clamped=True)
SIZE = (640, 360)
RIG = rig_around(size_px=SIZE)
# Light alone: what the geometry does, without grain, noise, blur or fall of light.
BARE = Scene(texture=0, gradient=0, vignetting=0, noise_levels=0, blur_px=0, shadow=0, specular=0)


def surface(phantom: Phantom, tube: Tube, name: str = "left") -> Surface:
    seen = see(Body.of(phantom, tube), RIG.cameras[name], RIG.camera_from_base[name])
    assert seen is not None
    return seen


def brute_force_coverage(phantom: Phantom, tube: Tube, name: str, pixels: NDArray[np.float64], n: int = 20):
    """Share of n x n rays per pixel that meet the tube, by their distance from a dense centreline.

    Flat ends: of the ray's stretch inside a ball near the end, some point has to lie on the tube's side of the cut.
    """
    camera, pose = RIG.cameras[name], RIG.camera_from_base[name]
    s = np.arange(0, phantom.length_mm + 1e-9, 0.05)
    centres, tangents = pose.apply(phantom.at(s)), pose.rotate(phantom.tangent(s))
    projected = camera.project(centres)
    radius = tube.diameter_mm / 2
    offsets = (np.arange(n) + 0.5) / n - 0.5
    grid = np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
    shares = []
    for pixel in pixels:
        rays = camera.unproject(pixel + grid)
        rays /= np.linalg.norm(rays, axis=1, keepdims=True)
        near = np.linalg.norm(projected - pixel, axis=1) < 30
        c = centres[near]
        along = rays @ c.T
        square = radius**2 - ((c**2).sum(1) - along**2)
        inside = square > 0
        half = np.sqrt(np.maximum(square, 0))
        cuts = [(0, -1, s[near] < 2 * radius)]
        if tube.tip.shape == "flat":
            cuts.append((-1, 1, s[near] > phantom.length_mm - 2 * radius))
        for end, sign, mask in cuts:
            axis = sign * tangents[end]
            slope, level = (rays @ axis)[:, None], centres[end] @ axis
            kept = ((along - half) * slope <= level) | ((along + half) * slope <= level)
            inside &= kept | ~mask
        hit = inside.any(1)
        if tube.tip.shape == "ball":
            tip = centres[-1]
            hit |= tip @ tip - (rays @ tip) ** 2 < (tube.tip.diameter_mm / 2) ** 2
        shares.append(hit.mean())
    return np.array(shares)


@pytest.mark.parametrize(
    ("phantom", "tube"),
    [
        (Arc(0.9, 1.2, 160.0), BALL),
        (Arc(1.4, -1.7, 160.0), Tube(6.0)),
        (Arc(1.0, 2.1, 160.0), Tube(10.0, Tip("flat"))),
        (Arc(1.0, 0.2, 160.0), Tube(10.0, Tip("flat"))),
        (Pieces((Arc(0.8, 0.7, 80.0), Arc(0.7, 3.5, 80.0))), BALL),
    ],
    ids=["ball", "round", "flat", "flat-towards-camera", "s-shape"],
)
def test_silhouette_against_brute_force(phantom: Phantom, tube: Tube) -> None:
    seen = surface(phantom, tube)
    share = coverage(seen.edge)
    rows, columns = np.nonzero((share > 0) & (share < 1))
    pick = np.random.default_rng(0).choice(len(rows), 120, replace=False)
    pixels = np.stack([columns[pick] + seen.window.left, rows[pick] + seen.window.top], -1).astype(float)
    error = share[rows[pick], columns[pick]] - brute_force_coverage(phantom, tube, "left", pixels)
    ends = RIG.project("left", phantom.at(np.array([0.0, phantom.length_mm])))
    # Half a ball's diameter: there corners and creases lie, and a pixel is not cut by one straight line.
    at_end = (np.linalg.norm(pixels[:, None] - ends, axis=2) < 12).any(1)
    # Counting 20 x 20 rays errs by up to 1 / 40 along the grid and 0.003 rms on a slanted edge; an edge 0.01 px off
    # changes the mean by 0.01.
    assert np.abs(error[~at_end]).max() < 0.03
    assert error[~at_end].std() < 0.004
    assert abs(error[~at_end].mean()) < 0.001
    assert np.abs(error[at_end]).max() < 0.15
    assert abs(error[at_end].mean()) < 0.01


def test_ball_covers_its_solid_angle() -> None:
    """Area of a ball's image under a lens-free camera that looks at it: pi f^2 r^2 / (d^2 - r^2)."""
    camera = Camera(np.array([[400.0, 0, 320], [0, 400, 180], [0, 0, 1]]), SIZE)
    pose = Pose(np.eye(3), np.array([0.0, 0.0, 300.0]))
    # The tube hides behind the ball.
    tube = Placed(straight(30.0), Pose.from_rotvec((np.pi, 0, 0), (0, 0, 30.0)))
    seen = see(Body.of(tube, Tube(4.0, Tip("ball", 20.0))), camera, pose)
    assert seen is not None
    area = np.pi * 400**2 * 100 / (300**2 - 100)
    # Each pixel is cut by a straight line, not by the arc: 1 / (24 radius) more per pixel of edge, pi / 12 in all. An
    # edge 0.001 px off would add 0.08.
    assert coverage(seen.edge).sum() == pytest.approx(area + np.pi / 12, abs=0.03)


@pytest.mark.parametrize(
    ("lens", "distortion"),
    [
        ("brown", (-0.3, 0.12, 1e-3, -1e-3, 0.0)),
        ("rational", (0.1, -0.05, 0.0, 0.0, 0.01, 0.15, 0.0, 0.0)),
        ("equidistant", (0.01, -0.02, 0.0, 0.0)),
    ],
)
def test_every_lens_projects_where_it_is_drawn(lens: str, distortion: tuple[float, ...]) -> None:
    """The tube's midline, drawn through rays, against the centreline projected forwards; with skew."""
    matrix = np.array([[380.0, 3.0, 322], [0, 340, 178], [0, 0, 1]])
    camera = Camera(matrix, SIZE, np.array(distortion), lens)
    pose = RIG.camera_from_base["left"]
    # Upright: a row of pixels crosses it at a right angle.
    seen = see(Body.of(straight(160.0), Tube(3.0)), camera, pose)
    assert seen is not None
    share = coverage(seen.edge)
    expected = camera.project(pose.apply(straight(160.0).at(np.linspace(0, 160, 400))))
    for row in range(seen.window.top + 12, seen.window.bottom - 12, 9):
        covered = share[row - seen.window.top]
        full = int(np.flatnonzero(covered > 0.999)[0])
        left, right = full - 0.5 - covered[:full].sum(), full + 0.5 + covered[full + 1 :].sum()
        middle = seen.window.left + (left + right) / 2
        # Perspective and lens move the middle of a chord of 4 px by less than 0.002 px; two edges err by 0.003.
        assert middle == pytest.approx(np.interp(row, expected[:, 1], expected[:, 0]), abs=0.005)


def test_rays_come_from_a_spline_as_exact_as_the_lens() -> None:
    camera = RIG.cameras["right"]
    window = Window(100, 140, 300, 360)
    columns, rows = np.meshgrid(np.arange(300, 360), np.arange(100, 140))
    exact = camera.unproject(np.stack([columns, rows], -1).astype(float))[..., :2]
    # 1e-4 px, a hundredth of what an edge may be off.
    np.testing.assert_allclose(plane_points(camera, window), exact, rtol=0, atol=1e-4 / camera.focal_px)


@given(st.floats(-0.7, 0.7), st.floats(0, 2 * np.pi))
def test_coverage_is_the_area_of_a_cut_pixel(distance: float, direction: float) -> None:
    """Against a count of 100 x 100 points of the pixel."""
    nx, ny = np.cos(direction), np.sin(direction)
    x, y = np.meshgrid(*2 * [(np.arange(100) + 0.5) / 100 - 0.5])
    counted = ((nx * x + ny * y + distance) < 0).mean()
    # The count errs by one row of points in a hundred.
    assert coverage(np.array([distance, nx, ny])) == pytest.approx(counted, abs=0.011)


def test_srgb_there_and_back() -> None:
    levels = np.linspace(0, 255, 256)
    # The knee of the standard is given to 5 digits: both branches meet to 1e-5 of full scale there.
    np.testing.assert_allclose(srgb_from_light(light_from_srgb(levels)), levels, rtol=0, atol=2e-3)
    assert srgb_from_light(np.array([0.5]))[0] == pytest.approx(187.5, abs=0.1)


def test_lit_side_is_brighter_and_shaded_side_not_black() -> None:
    scene = replace(BARE, light=(0.0, 1.0, 0.0), holder_diameter_mm=0.0)
    picture = render(RIG.cameras["left"], RIG.camera_from_base["left"], straight(160.0), Tube(12.0), scene)
    middle = RIG.project("left", np.array([0.0, 0.0, 80.0]))
    column, row = np.rint(middle).astype(int)
    # The left camera stands on +x, its image x runs along -y: the lamp on +y lights the left side.
    left, right = (picture[row, column + d].astype(float).mean() for d in (-5, 5))
    assert left > right + 30
    cloth = picture[row, column - 100].astype(float)
    assert right > 40
    # Full light on the cloth without grain: the colour asked for, to rounding.
    np.testing.assert_allclose(cloth, scene.cloth_bgr, atol=0.51)


def test_blur_widens_edges_and_keeps_their_place() -> None:
    """In linear light the blurred edge stays where it was: total light is kept."""
    sharp, soft = (replace(BARE, blur_px=b, holder_diameter_mm=0.0) for b in (0.0, 1.5))
    lights = []
    for scene in (sharp, soft):
        picture = render(RIG.cameras["left"], RIG.camera_from_base["left"], Arc(0.5, 1.0, 160.0), BALL, scene)
        lights.append(light_from_srgb(picture[..., 2]))
    # Rounding to 8 bits errs by up to 0.5 levels (0.0045 in bright light) per pixel of some 5000, at random.
    assert lights[1].sum() == pytest.approx(lights[0].sum(), rel=1e-4)
    assert np.abs(np.diff(lights[1], axis=1)).max() < 0.5 * np.abs(np.diff(lights[0], axis=1)).max()


def test_noise_has_its_deviation() -> None:
    scene = replace(BARE, noise_levels=3.0)
    picture = render(RIG.cameras["left"], RIG.camera_from_base["left"], straight(160.0), BALL, scene)
    corner = picture[:60, :200].astype(float)
    # Rounding adds 1 / 12; 12000 draws determine a deviation to 0.7 %.
    np.testing.assert_allclose(corner.std((0, 1)), np.sqrt(9 + 1 / 12), rtol=0.03)
    # Equally likely values: nothing beyond 2.9 deviations.
    assert np.abs(corner - corner.mean((0, 1))).max() < 3 * 3 + 1


def test_pictures_repeat_and_differ_by_name_and_seed() -> None:
    def picture(name: str, seed: int) -> NDArray[np.uint8]:
        return render_pair(RIG, Arc(0.5, 1.0, 160.0), BALL, Scene(seed=seed), name).images["left"]

    first = picture("a", 0)
    np.testing.assert_array_equal(first, picture("a", 0))
    for other in (picture("b", 0), picture("a", 1)):
        assert (first != other).mean() > 0.5


def test_background_differs_from_the_photograph_only_at_tube_and_shadow() -> None:
    scene = Scene(clutter=30, noise_levels=0, shadow=0, blur_px=1.0)
    phantom = Arc(0.8, 1.0, 160.0)
    pair, empty = render_pair(RIG, phantom, BALL, scene), render_background(RIG, phantom, scene)
    for name in RIG.names:
        changed = (pair.images[name] != empty.images[name]).any(-1)
        seen = surface(phantom, BALL, name)
        around = seen.window.grown(5, SIZE)
        tube = np.zeros(changed.shape, bool)
        tube[around.slices] = True
        assert changed[tube].sum() > 0.5 * coverage(seen.edge).sum()
        assert not changed[~tube].any()


def test_holder_covers_the_base_from_above() -> None:
    """A camera above the clamp looks at the holder; from below the tube comes out of its face."""
    above = rig_around(size_px=SIZE, elevation_deg=60.0, target_mm=(0.0, 0.0, 0.0))
    counts = []
    for scene in (BARE, replace(BARE, holder_diameter_mm=0.0)):
        picture = render(above.cameras["left"], above.camera_from_base["left"], straight(60.0), Tube(12.0), scene)
        counts.append((picture[..., 2] > 90).sum())
    hidden, open_ = counts
    assert open_ > 300
    assert hidden < 0.5 * open_


def test_tube_at_the_camera_is_refused() -> None:
    near = rig_around(size_px=SIZE, distance_mm=60.0)
    with pytest.raises(ValueError, match="camera's plane"):
        render_pair(near, Arc(1.2, 0.0, 160.0), BALL)
    with pytest.raises(ValueError, match="needs its diameter_mm"):
        render_pair(RIG, Arc(1.2, 0.0, 160.0), Tube())


def test_scene_refuses_nonsense() -> None:
    with pytest.raises(ValueError, match="light: expected a direction"):
        Scene(light=(0.0, 0.0, 0.0))
    with pytest.raises(ValueError, match=r"noise_levels: expected zero or more, got -1"):
        Scene(noise_levels=-1)


def test_shared_fixture_photographs_what_its_truth_says(simulated_pair) -> None:
    made = simulated_pair(Arc(0.7, 0.4, 150.0), angle_deg=60.0, size_px=SIZE)
    assert made is simulated_pair(Arc(0.7, 0.4, 150.0), angle_deg=60.0, size_px=SIZE)
    for name, image in made.pair.images.items():
        assert image.shape == (SIZE[1], SIZE[0], 3)
        column, row = np.rint(made.rig.project(name, np.array(made.truth["tip"]))).astype(int)
        # The ball is the white thing on the blue cloth.
        assert image[row, column, 2] > 80 > image[row, column + 40, 2]
