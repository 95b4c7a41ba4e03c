"""The paper's pipeline, literally: its errors, its refusals, and the steps of its image processing."""

import math
import time
from collections.abc import Callable

import cv2
import numpy as np
import pytest

from conftest import MOCKUP_TUBE, SimulatedPair
from shared_data import shared
from tubesight.core import FramePair, Status, Tip, Tube, Unmeasurable
from tubesight.files.images import read_image
from tubesight.files.rig import load_rig
from tubesight.files.truth import load_truth
from tubesight.sensor import Reconstruction, ShapeSensor
from tubesight.simulate import Arc, EllipseArc, Phantom, Scene, render_background, rig_around, straight
from tubesight.vision.reference_picture import crop_box, isolate, threshold, undistort_box, without_background
from tubesight.vision.reference_tip import find_tip
from tubesight.vision.reference_walk import erase_tip, mask_radius_px, walk_arcs

Simulate = Callable[..., SimulatedPair]

# The paper's figures: largest and mean errors of x, y and z of the tip, and of both angles.
PAPER_MM, PAPER_DEG = 0.6, 0.5
PAPER_MEAN_MM, PAPER_MEAN_DEG = 0.24, 0.21
ORIENTATIONS = (30, 60, 120, 150, 210, 240, 300, 330)
BENDINGS = (10, 30, 50, 70)


def experiment_1() -> dict[str, Phantom]:
    """Tubes of the paper's first experiment by name."""
    tubes: dict[str, Phantom] = {}
    for phi in ORIENTATIONS:
        for theta in BENDINGS:
            tubes[f"circle {theta} at {phi}"] = Arc(np.radians(theta), np.radians(phi), 160.0)
        tubes[f"ellipse 40 at {phi}"] = EllipseArc(np.radians(40), 2.0, np.radians(phi), 160.0)
    return tubes


def angle_off(a_deg: float, b_deg: float) -> float:
    return abs((a_deg - b_deg + 180) % 360 - 180)


def tip_off(result: Reconstruction, tip_mm: list[float]) -> float:
    """Largest error of x, y and z of the tip, as the paper states it."""
    assert result.shape is not None
    return float(np.abs(result.shape.tip_mm - tip_mm).max())


def test_experiment_1_has_the_errors_of_the_paper(simulated_pair: Simulate) -> None:
    """Circular tubes of 10 to 70 degrees and an elliptic one of 40 degrees, at eight orientations.

    The pictures have two thirds of the paper's resolution and the errors come from whole pixels: 1.5 times the paper's
    means, 0.24 mm and 0.21 degrees. The largest of so many scatters more: 2.5 times the paper's. The paper does not
    state the elliptic tube's bending apart; an ellipse through 16 points of 0.3 px knows it to 2 degrees.
    """
    tip, angle = [], []
    for name, phantom in experiment_1().items():
        s = simulated_pair(phantom, name=name)
        result = ShapeSensor(s.rig, s.tube, "reference")(s.pair)
        assert result.status is Status.OK, f"{name}: {result.notes}"
        assert result.shape is not None and result.curve is not None
        elliptic = name.startswith("ellipse")
        assert result.curve.model == ("ellipse" if elliptic else "circle"), name
        tip.append(np.abs(result.shape.tip_mm - s.truth["tip"]))
        bending_off = abs(math.degrees(result.shape.bending_rad) - s.truth["theta"])
        angle.append(angle_off(math.degrees(result.shape.orientation_rad), s.truth["phi"]))
        assert bending_off < 3.0, name
        if not elliptic:
            angle.append(bending_off)
        assert abs(result.shape.length_mm - 160.0) < 2.5 * PAPER_MM, name
    assert np.mean(tip) < 1.5 * PAPER_MEAN_MM and np.max(tip) < 2.5 * PAPER_MM
    assert np.mean(angle) < 1.5 * PAPER_MEAN_DEG and max(angle) < 2.5 * PAPER_DEG


def test_mockup_photographs() -> None:
    """Every pair of 1080p photographs has a row, the quadratic ones within the paper's error of the tip."""
    folder = shared("mockup")
    rig = load_rig(folder / "rig_true.yaml").rig
    sensor = ShapeSensor(rig, MOCKUP_TUBE, "reference")
    cropped = ShapeSensor(rig, MOCKUP_TUBE, "reference_crop")
    ok = 0
    for frame, true in load_truth(folder / "truth.json").items():
        pair = FramePair({n: read_image(folder / n / f"{frame}.jpg") for n in rig.names}, frame)
        result, same = sensor(pair), cropped(pair)
        assert (same.status, same.notes) == (result.status, result.notes)
        if not result:
            assert result.notes
            continue
        ok += 1
        assert result.shape is not None and same.shape is not None
        np.testing.assert_array_equal(result.shape.tip_mm, same.shape.tip_mm)
        assert tip_off(result, list(true.tip_mm)) < PAPER_MM
    # All but the S-shape, which no quadratic curve describes.
    assert ok == 11


def test_a_pair_takes_less_than_60_ms_of_one_thread(simulated_pair: Simulate) -> None:
    """CPU time of a 1080p pair, the best of five: 30 ms measured, and twice that where a hyperthread is shared."""
    s = simulated_pair(Arc(np.radians(50), np.radians(60), 160.0), size_px=(1920, 1080))
    sensor = ShapeSensor(s.rig, s.tube, "reference")
    threads = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        took = []
        for _ in range(6):
            start = time.thread_time()
            assert sensor(s.pair)
            took.append(time.thread_time() - start)
    finally:
        cv2.setNumThreads(threads)
    # The first call makes the maps.
    assert min(took[1:]) < 0.060


def test_rounding_of_the_distance_transform_does_not_decide(monkeypatch: pytest.MonkeyPatch) -> None:
    """OpenCV's distances differ by 2e-6 px from call to call; where pixels are equally deep that chose one of them."""
    y, x = np.mgrid[:500, :500]
    # The middle of this ball is the corner of four pixels, equally deep.
    inside = (np.hypot(x - 249.5, y - 300.5) <= 40) | ((abs(x - 249.5) < 30) & (y < 300))
    binary = np.where(inside, 255, 0).astype(np.uint8)
    catheter = isolate(binary, from_base=True)
    rng, exact = np.random.default_rng(0), cv2.distanceTransform
    monkeypatch.setattr(cv2, "distanceTransform", lambda *a: (d := exact(*a)) + rng.uniform(0, 4e-6, d.shape))
    for _ in range(4):
        np.testing.assert_allclose(find_tip(catheter, binary, Tip("ball", 16.0), 4 / 3).rough_px, [249.5, 300.5])


def test_straight_tube_is_triangulated(simulated_pair: Simulate) -> None:
    s = simulated_pair(straight(160.0))
    result = ShapeSensor(s.rig, s.tube, "reference")(s.pair)
    assert result.shape is not None and result.curve is not None
    assert result.curve.model == "line" and result.shape.bending_rad == 0.0
    assert tip_off(result, s.truth["tip"]) < 1.5 * PAPER_MM


def test_rounded_end_is_found(simulated_pair: Simulate) -> None:
    """Without a ball the tip is the centre of the tube's own rounded end; the padded transform finds it."""
    s = simulated_pair(Arc(np.radians(40), np.radians(60), 150.0), tube=Tube(12.0, Tip("round"), clamped=True))
    result = ShapeSensor(s.rig, s.tube, "reference")(s.pair)
    assert result.status is Status.OK, result.notes
    # The two points beside the tip lie on the tube, whose width differs from the cap's by a pixel of 0.42 mm.
    assert tip_off(result, s.truth["tip"]) < 1.5


@pytest.mark.parametrize(
    ("tube", "phantom", "status"),
    [
        (Tube(12.0, Tip("flat"), clamped=True), Arc(np.radians(30), 1.0, 150.0), Status.TIP_NOT_FOUND),
        (MOCKUP_TUBE, Arc(np.radians(20), 1.0, 300.0), Status.TIP_AT_BORDER),
        (Tube(12.0, Tip("ball", 40.0), clamped=True), Arc(np.radians(30), 1.0, 150.0), Status.TIP_NOT_FOUND),
    ],
    ids=["flat end", "out of the picture", "other ball"],
)
def test_refusals(simulated_pair: Simulate, tube: Tube, phantom: Phantom, status: Status) -> None:
    s = simulated_pair(phantom)
    assert ShapeSensor(s.rig, tube, "reference")(s.pair).status is status


def test_a_wrong_curve_is_refused(simulated_pair: Simulate) -> None:
    """Views of two different tubes; without the check of the residual that would be a shape centimetres off."""
    one, other = (simulated_pair(Arc(np.radians(50), np.radians(phi), 160.0)) for phi in (60, 240))
    mixed = FramePair({"left": one.pair.images["left"], "right": other.pair.images["right"]})
    result = ShapeSensor(one.rig, one.tube, "reference")(mixed)
    assert result.status in (Status.RESIDUAL_TOO_LARGE, Status.NEAR_DEGENERATE)


def test_empty_and_upside_down_pictures_are_refused(simulated_pair: Simulate) -> None:
    s = simulated_pair(Arc(np.radians(30), 1.0, 150.0))
    bare = render_background(s.rig, Arc(np.radians(30), 1.0, 150.0), Scene(holder_diameter_mm=0.0))
    assert ShapeSensor(s.rig, s.tube, "reference")(bare).status is Status.TUBE_NOT_FOUND
    camera = s.rig.cameras["left"]
    with pytest.raises(Unmeasurable, match="hangs down"):
        crop_box(camera, np.array([640.0, 400.0]), np.array([0.1, -0.99]))
    with pytest.raises(Unmeasurable, match="outside"):
        crop_box(camera, np.array([640.0, 5000.0]), np.array([0.0, 1.0]))


def test_undistorted_picture_is_that_of_a_pinhole() -> None:
    """A pixel of the undistorted picture shows what the camera saw along that pixel's pinhole ray.

    On a smooth pattern, linear interpolation errs by a gray level (second derivative / 8), and the fixed point maps by
    1 / 32 px of a slope of 1.3 levels.
    """
    camera = rig_around().cameras["left"]
    x, y = np.meshgrid(np.arange(1920.0), np.arange(1080.0))

    def pattern(px: np.ndarray) -> np.ndarray:
        return np.asarray(128 + 50 * np.sin(px[..., 0] / 40) + 50 * np.cos(px[..., 1] / 55))

    image = np.rint(pattern(np.stack([x, y], -1))).astype(np.uint8)
    box = (500, 300, 1400, 1000)
    whole, crop = (undistort_box(image, camera, box, w) for w in (True, False))
    np.testing.assert_array_equal(whole, crop)
    inside = np.stack(np.meshgrid(np.arange(500.0, 1400.0), np.arange(300.0, 1000.0)), -1)
    rays = np.concatenate([inside, np.ones((*inside.shape[:2], 1))], -1) @ np.linalg.inv(camera.matrix).T
    assert np.abs(crop - pattern(camera.project(rays))).max() < 1.5


def test_background_goes_with_its_shadows() -> None:
    """Cloth of one colour at any brightness is dark, gray of any brightness keeps its level."""
    cloth = np.outer(np.linspace(0.2, 1.0, 200), [200, 90, 40])
    picture = np.tile(np.rint(cloth).astype(np.uint8)[:, None], (1, 300, 1))
    picture[50:150, 140:160] = [[[90]], [[200]]][0][0][0]
    signal = without_background(picture)
    # Rounding of three channels whose weights sum to one and are at most 2 each.
    assert signal[:, :130].max() <= 3
    assert np.abs(signal[50:150, 140:160].astype(int) - 90).max() <= 1
    gray = np.full((100, 100), 60, np.uint8)
    gray[40:60] = 200
    assert without_background(gray)[50, 50] == 140 and without_background(gray)[0, 0] == 0


def hanging(radius_px: float, half_px: float, size: tuple[int, int] = (700, 900)) -> np.ndarray:
    """Binary picture of a tube bent with an image radius to the right, drawn exactly: white where inside."""
    y, x = np.mgrid[: size[0], : size[1]].astype(float)
    centre = np.array([200.0 + radius_px, 0.0])
    off = np.hypot(x - centre[0], y - centre[1]) - radius_px
    end = np.arctan2(y, centre[0] - x)
    return np.where((np.abs(off) <= half_px) & (end <= np.radians(70)) & (end >= 0), 255, 0).astype(np.uint8)


def with_ball(tube: np.ndarray, radius_px: float, ball_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Add a ball at the end of `hanging`; returns the picture and the ball's centre."""
    angle = np.radians(70)
    centre = np.array([200.0 + radius_px * (1 - np.cos(angle)), radius_px * np.sin(angle)])
    y, x = np.mgrid[: tube.shape[0], : tube.shape[1]]
    tube = tube.copy()
    tube[np.hypot(x - centre[0], y - centre[1]) <= ball_px] = 255
    return tube, centre


def test_steps_on_an_exact_arc() -> None:
    """Origin, ball and centreline of a drawn tube; the centre of mass of an arc lies w^2 / (6 R) outside.

    Half width w, image radius R, mask radius a w: the arc's ends lie at the angles where it meets the circles R +- w,
    their middle is (w^2 - a^2 w^2) / (2 R a w cos(alpha)) off the way with sin(alpha) = 1 / a, the centre of mass is
    a w sin(alpha) / alpha ahead, and the centreline has turned away by the square of that over 2 R: in sum 0.34 w^2 /
    (2 R) outward for a = 1.5. Points of 100 whole pixels scatter by 0.1 px, their mean of 15 by 0.03 px; the mean is
    taken to three of those.
    """
    radius, half = 500.0, 30.0
    binary, centre = with_ball(hanging(radius, half), radius, 40.0)
    catheter = isolate(binary, from_base=True)
    np.testing.assert_allclose(catheter.origin_px, [200, 0], atol=0.5)
    assert catheter.width_px == pytest.approx(2 * half + 1, abs=1)
    tip = find_tip(catheter, binary, Tip("ball", 16.0), 40 / 30)
    # Whole pixels, and half of one since Canny's edges of a binary picture lie to the upper left.
    np.testing.assert_allclose(tip.centre_px, centre, atol=1.2)
    assert tip.radius_px == pytest.approx(40.0, abs=1.0)
    mask_px = mask_radius_px(catheter, tip, 40 / 30)
    assert mask_px > half
    tube = erase_tip(catheter, tip)
    away = np.hypot(*(np.indices(tube.shape)[::-1] - tip.centre_px[:, None, None]))
    assert not tube[away < tip.radius_px + 1].any()
    np.testing.assert_array_equal(tube[away > tip.radius_px + 5], catheter.mask[away > tip.radius_px + 5])
    walk = walk_arcs(tube, catheter.origin_px, tip, mask_px)
    outward = radius - np.linalg.norm(walk.points_px - [200 + radius, 0], axis=1)
    # Bent to the right, the outside is left: farther from the centre of the arc than the radius.
    assert -outward[1:].mean() == pytest.approx(half**2 / (6 * radius), abs=0.1)
    # It stops at the ball: nothing on it, and no gap before it.
    away = np.linalg.norm(walk.points_px - centre, axis=1)
    assert away.min() > tip.radius_px and away.min() < tip.radius_px + 2 * mask_px


def test_tip_that_is_no_circle_is_refused() -> None:
    """A block of 80 x 60 px: little more than 30 px fit inside, the circle through three points has 42."""
    binary = np.zeros((500, 500), np.uint8)
    binary[:300, 235:266] = 255
    binary[300:361, 210:291] = 255
    catheter = isolate(binary, from_base=True)
    with pytest.raises(Unmeasurable, match=r"a circle of 42 px where 3\d px fit") as caught:
        find_tip(catheter, binary, Tip("ball", 16.0), 2.0)
    assert caught.value.status is Status.TIP_NOT_FOUND


def test_base_that_is_covered_is_refused() -> None:
    binary = hanging(500.0, 20.0)
    binary[:60] = 0
    with pytest.raises(Unmeasurable) as caught:
        isolate(binary, from_base=True)
    assert caught.value.status is Status.BASE_HIDDEN
    assert isolate(binary, from_base=False).origin_px[1] == 60


def test_noise_alone_is_no_tube() -> None:
    noise = np.random.default_rng(1).normal(3, 2, (400, 400)).clip(0, 255).astype(np.uint8)
    with pytest.raises(Unmeasurable):
        threshold(noise)
