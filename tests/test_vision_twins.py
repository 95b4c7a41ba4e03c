"""Compiled stages of seeing give the numbers of their readable twins, on tubes, noise and degenerate pictures."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numba
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tubesight.core import Tip, Tube, Unmeasurable
from tubesight.core.kernels import COMPILED
from tubesight.geometry.camera import Camera
from tubesight.vision import falls, line_kernels, math_kernels, pairs
from tubesight.vision.ending import BORDER, FOUND
from tubesight.vision.fetch_kernels import fetch_line
from tubesight.vision.see import Start, see
from tubesight.vision.signal import Signal, planes, sample
from tubesight.vision.silhouette import signal_of
from tubesight.vision.stages import READABLE, Stages, stages
from tubesight.vision.walker import WALK_OFF_PX
from vision_scenes import Picture, drawn_tube

if not COMPILED:
    pytest.skip("nothing is compiled here", allow_module_level=True)

COMPILED_STAGES = stages()
# Both compute the same expressions in float64; sums in another order and solutions of small equations differ by 1e-13
# relative, which the slope of a line of some hundred pixels turns into 1e-11 px. Asked for is 1e-9.
TOLERANCE = 1e-9
START, WAY, WIDTH = np.array([105.0, 20.0]), np.array([0.0, 1.0]), 16.0


def flat(value: Any) -> Iterator[Any]:
    """Numbers and arrays of a result, in order; None counts as one."""
    if hasattr(value, "__slots__") and not isinstance(value, (float, int, tuple, str, np.ndarray, np.generic)):
        for name in value.__slots__:
            yield from flat(getattr(value, name))
    elif isinstance(value, (tuple, list)):
        for each in value:
            yield from flat(each)
    elif not isinstance(value, str):
        yield value


def assert_twins(name: str, *arguments: Any) -> Any:
    """Run a stage of both kinds and compare; returns the readable result."""
    compiled, readable = getattr(COMPILED_STAGES, name)(*arguments), getattr(READABLE, name)(*arguments)
    for a, b in zip(flat(compiled), flat(readable), strict=True):
        assert (a is None) == (b is None), name
        if a is not None:
            assert np.shape(a) == np.shape(b), name
            np.testing.assert_allclose(np.asarray(a, float), np.asarray(b, float), rtol=0, atol=TOLERANCE, err_msg=name)
    return readable


@pytest.mark.parametrize("shape", [(0, 0), (1, 1), (2, 3), (40, 30)])
def test_asking_for_pixels_asks_for_none_outside(shape: tuple[int, int]) -> None:
    """Wherever a line lies: a picture's border, nowhere, at infinity. Nothing is told, and nothing breaks."""
    ask = numba.njit(lambda *given: fetch_line(*given), error_model="numpy")
    picture = np.zeros((*shape, 3), np.uint8)[:, ::-1]
    for place in (0.0, 0.5, 39.0, -1e300, np.nan, np.inf):
        ask(picture, (place, place), (0.6, 0.8), -30.0, 30.0, 5)


def gray(picture: Picture) -> Picture:
    return np.ascontiguousarray(picture[..., 1])


def strided(picture: Picture) -> Picture:
    """Every second byte of a larger buffer: what the Y plane of a YUYV picture is."""
    buffer = np.zeros((*picture.shape[:2], 2), np.uint8)
    buffer[..., 0] = picture[..., 1]
    return buffer[..., 0]


def readonly(picture: Picture) -> Picture:
    picture.flags.writeable = False
    return picture


PICTURES: dict[str, Picture] = {
    "tube": drawn_tube(),
    "gray": gray(drawn_tube()),
    "yuyv": strided(drawn_tube()),
    "flipped": drawn_tube()[::-1][::-1],
    "readonly": readonly(drawn_tube(seed=3)),
    "dark": drawn_tube(tube=(0.05, 0.05, 0.06), cloth=(0.6, 0.6, 0.65), bend=-0.002),
    "dark and blurred": drawn_tube(tube=(0.012, 0.013, 0.014), cloth=(0.6, 0.61, 0.61), steep=1.3),
    "equally bright": drawn_tube(tube=(0.3, 0.3, 0.3), cloth=(0.05, 0.45, 0.1), noise=0.02),
    "saturated": drawn_tube(tube=(3.0, 3.0, 3.0), cloth=(0.1, 0.1, 0.1)),
    "thin": drawn_tube(width=6.0),
    "hair": drawn_tube(width=2.6),
    "at the border": drawn_tube(size=(90, 210)),
    "beside the border": drawn_tube(size=(150, 116)),
    "noise": np.random.default_rng(1).integers(0, 256, (150, 210, 3)).astype(np.uint8),
    "black": np.zeros((150, 210, 3), np.uint8),
    "white": np.full((150, 210), 255, np.uint8),
    "one pixel": np.full((1, 1, 3), 90, np.uint8),
    "one row": np.full((1, 210), 90, np.uint8),
    "nothing": np.zeros((0, 0, 3), np.uint8),
}
CAMERA = Camera(np.array([[300.0, 0.5, 105], [0, 305, 75], [0, 0, 1]]), (210, 150), np.array([-0.1, 0.02, 1e-3, 0, 0]))
SCENES = {"tube": drawn_tube(length=0.0, ball=0.0, seed=5), "noise": PICTURES["tube"], "gray": gray(drawn_tube(seed=8))}


def signal_for(picture: Picture, scene: Picture | None = None) -> Signal:
    """Make a signal with fixed colours, also for pictures that nothing can be learned from."""
    tube, cloth = np.array([0.7, 0.75, 0.8]), np.array([0.35, 0.1, 0.05])
    channels = picture.shape[2] if picture.ndim == 3 else 1
    return Signal(picture, tube[:channels], cloth[:channels], scene, np.full(channels, 1.02), "test")


@pytest.mark.parametrize("with_scene", [False, True])
@pytest.mark.parametrize("name", PICTURES)
def test_every_stage_gives_the_numbers_of_its_twin(name: str, with_scene: bool) -> None:
    if with_scene and name not in SCENES:
        pytest.skip("no picture of the empty scene")
    picture, scene = PICTURES[name], SCENES[name] if with_scene else None
    width = {"thin": 6.0, "hair": 2.6}.get(name, WIDTH)
    assert_twins("learn", picture, scene, START, WAY, width)
    signal = signal_for(picture, scene)
    assert_twins("find_pair", signal, START + 20 * WAY, WAY, width, True)
    assert_twins("find_pair", signal, START + 20 * WAY, WAY, 2 * width, False)
    assert_twins("walk", signal, START + 20 * WAY, -WAY, width)
    track = assert_twins("walk_from_base", signal, START, WAY, width)
    if track is None or len(track.middle_px) < 4:
        return
    edges, blur, _, outwards = assert_twins("measure", signal, track)
    ending = assert_twins("find_end", signal, track.middle_px, track.width_px, 6.0)
    for careful in (False, True):
        assert_twins(
            "ball", signal, ending.px - 11 * ending.heading, ending.heading, 11.2, 2.1, blur, outwards, careful
        )
    assert_twins("round_end", signal, ending.px - 8 * ending.heading, ending.heading, 8.0, blur, outwards)
    assert_twins("face", signal, ending.px, ending.heading, width, blur, outwards)
    if name == "tube":
        assert (ending.outcome, len(edges) > 10) == (FOUND, True)
    if name == "at the border":
        assert ending.outcome == BORDER


@settings(deadline=None, max_examples=60)
@given(
    x=st.floats(-50, 260), y=st.floats(-50, 200), angle=st.floats(-3.2, 3.2), width=st.floats(1.0, 60.0),
    picture=st.sampled_from(sorted(PICTURES)),
)  # fmt: skip
def test_stages_agree_anywhere(x: float, y: float, angle: float, width: float, picture: str) -> None:
    place, way, signal = np.array([x, y]), np.array([np.cos(angle), np.sin(angle)]), signal_for(PICTURES[picture])
    assert_twins("find_pair", signal, place, way, width, True)
    assert_twins("find_pair", signal, place, way, width, False)
    assert_twins("ball", signal, place, way, width / 2, 2.0, 0.9, 0.0, False)
    assert_twins("round_end", signal, place, way, width / 2, 0.9, 0.0)
    assert_twins("face", signal, place, way, width, 0.9, 0.0)
    middles = place + np.arange(8.0)[:, None] * width / 2 * way
    assert_twins("find_end", signal, middles, np.full(8, width), 4.0)


@pytest.mark.parametrize("place", [np.array([np.nan, 20.0]), np.array([np.inf, 20.0]), np.array([1e300, -1e300])])
def test_places_that_are_none_find_nothing(place: np.ndarray) -> None:
    signal = signal_for(PICTURES["tube"])
    assert assert_twins("find_pair", signal, place, WAY, WIDTH, True) is None
    assert assert_twins("walk_from_base", signal, place, WAY, WIDTH) is None
    assert np.isnan(assert_twins("learn", PICTURES["tube"], None, place, WAY, WIDTH)[0]).all()


@numba.njit(error_model="numpy")
def _sample_line(  # type: ignore[no-untyped-def]
    image, origin, way, bend, low, step, apart, at, out, row
) -> None:
    """Enter the compiled sampler from Python."""
    line_kernels.sample_line(image, origin, way, bend, low, step, apart, at, out, row)


@pytest.mark.parametrize("apart", [0.0, 0.75])
@pytest.mark.parametrize("name", ["tube", "gray", "yuyv", "one pixel", "one row", "nothing"])
def test_lines_are_sampled_as_points_are_and_never_outside(name: str, apart: float) -> None:
    picture = planes(PICTURES[name])
    rng = np.random.default_rng(0)
    height, width, channels = picture.shape
    for angle in [*np.radians([0, 45, 90, 180, 225, 270]), *rng.uniform(-np.pi, np.pi, 20)]:
        origin = rng.uniform(-2, 2, 2) + rng.uniform(0, 1, 2) * [width, height]
        way = np.array([np.cos(angle), np.sin(angle)])
        low, step, out = -30.0, rng.uniform(0.4, 1.2), np.zeros((10, 60))
        points = origin + (low + step * np.arange(60.0))[:, None] * way
        aside = apart * np.array([-way[1], way[0]])
        wanted = (sample(picture, points + aside) + sample(picture, points - aside)) / 2
        arguments = (tuple(origin), tuple(way), 0.0, low, step, apart, out, out, 3)
        _sample_line(picture, *arguments)
        np.testing.assert_allclose(out[3 : 3 + channels].T, wanted, rtol=0, atol=TOLERANCE)


@pytest.mark.parametrize(
    ("lens", "distortion"),
    [
        ("brown", [-0.28, 0.09, 1e-3, -5e-4, 0.01]),
        ("rational", [0.2, -0.1, 5e-4, 1e-3, 0.02, 0.15, 0.05, -0.01]),
        ("equidistant", [0.02, -0.01, 0.004, -0.001]),
    ],
)
def test_rays_agree_for_each_lens(lens: str, distortion: list[float]) -> None:
    camera = Camera(np.array([[800.0, 1.5, 640], [0, 810, 360], [0, 0, 1]]), (1280, 720), np.array(distortion), lens)
    rng = np.random.default_rng(2)
    angle = np.linspace(-2, 2, 30)
    for x, y in rng.uniform(0, 1, (20, 2)) * [1280, 720]:
        contour = np.array([x, y]) + 25 * np.stack([np.cos(angle), np.sin(angle)], 1) + rng.normal(0, 0.2, (30, 2))
        assert_twins("tangent_cone", camera, contour)
        middle = np.array([x, y]) + np.arange(20)[:, None] * [1.0, 9.0]
        edges = middle[:, None] + np.array([[12.0, 0], [-12, 0]]) + rng.normal(0, 0.1, (20, 2, 2))
        assert_twins("tube_rays", camera, edges, np.array([0.1, 0.99]), middle[15] + [20, 5], 60.0, 14.0, middle[0])
    outside = np.full((12, 2), 1e9)
    assert len(assert_twins("tangent_cone", camera, outside)[2]) == 0


@settings(deadline=None, max_examples=50)
@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=60))
def test_median(values: list[float]) -> None:
    array = np.array(values)
    # (a + b) / 2 either way, rounded once.
    assert math_kernels.median.py_func(array.copy(), len(array)) == pytest.approx(float(np.median(array)), rel=1e-15)


def test_wide_windows_reach_all_acceptable_pairs() -> None:
    """A pair whose edges lie outside of the window has a negative score."""
    for width in (4.0, 16.0, 80.0):
        low, high = pairs.wide(width, True)
        off, deviation = np.meshgrid(np.linspace(-width, width, 201), np.linspace(-width, width, 201))
        score = 2 - (off / (pairs.MIDDLE_OFF * width + pairs.OFF_PX)) ** 2
        score -= (deviation / (pairs.WIDTH_OFF * width + pairs.OFF_PX)) ** 2
        edge = (width + deviation) / 2 + off
        assert (score[(edge < low + pairs.END_PX) | (edge > high - pairs.END_PX)] < 0).all()


def test_falls_find_the_middle_of_a_step() -> None:
    along = falls.grid(-10, 10, 0.5)
    for place in (-3.2, 0.0, 4.4):
        share = 1 / (1 + np.exp((along - place) / 0.6))
        # A parabola through the slope of a symmetric step: right to a twentieth of a sample.
        assert falls.nearest_fall(share[None], along, 0.2)[0] == pytest.approx(place, abs=0.025)


def view_or_reason(run: Stages, picture: Picture, scene: Picture | None, tube: Tube, start: Start) -> Any:
    """What `see` gives with these stages: a view, or why there is none."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("tubesight.vision.see.stages", lambda: run)
        try:
            return see("left", picture, scene, CAMERA, tube, start)
        except Unmeasurable as failure:
            return str(failure)


@pytest.mark.parametrize("shape", ["ball", "round", "flat"])
@pytest.mark.parametrize(
    "name", ["tube", "gray", "yuyv", "dark", "dark and blurred", "thin", "at the border", "noise", "black", "nothing"]
)
def test_seeing_in_one_call_is_seeing_stage_by_stage(name: str, shape: str) -> None:
    width = 6.0 if name == "thin" else WIDTH
    balls = {"tube": drawn_tube(), "gray": gray(drawn_tube())} if shape == "ball" else {}
    picture = balls.get(name, PICTURES[name])
    tube = Tube(1.0, Tip(shape, 1.4 if shape == "ball" else None), clamped=True)
    scene = SCENES.get(name)
    for behind in [None] if scene is None or scene.shape != picture.shape else [None, scene]:
        start = Start(START, WAY, width)
        one, other = (view_or_reason(run, picture, behind, tube, start) for run in (COMPILED_STAGES, READABLE))
        assert type(one) is type(other)
        if isinstance(one, str):
            assert one == other
            continue
        assert (one.segmenter, one.notes) == (other.segmenter, other.notes)
        for a, b in zip(flat(one), flat(other), strict=True):
            assert np.shape(a) == np.shape(b)
            np.testing.assert_allclose(np.asarray(a, float), np.asarray(b, float), rtol=0, atol=TOLERANCE)
        assert not any(a.flags.writeable for a in flat(one) if isinstance(a, np.ndarray))


def test_edges_of_a_dark_tube_are_looked_for_where_its_blurred_rim_passes_for_a_shadow() -> None:
    """The walk has them more than the room of their measurement inside; measured they are as far apart as drawn."""
    picture = PICTURES["dark and blurred"]
    tube = Tube(1.0, Tip("ball", 1.4), clamped=True)
    run = COMPILED_STAGES
    signal = signal_of(picture, None, run.learn(picture, None, START, WAY, WIDTH))
    track = run.walk_from_base(signal, START, WAY, WIDTH)
    assert track is not None
    edges, _, _, outwards = run.measure(signal, track)
    assert outwards > WALK_OFF_PX
    widths = np.linalg.norm(edges[:, 0] - edges[:, 1], axis=1)
    # Gamma and the long tails of the logistic blur leave a quarter of a pixel at each edge; the walk is off by 1.7 px.
    np.testing.assert_allclose(np.median(widths), WIDTH, atol=0.6)
    assert np.median(track.width_px) < WIDTH - 2 * WALK_OFF_PX
    view = see("left", picture, None, CAMERA, tube, Start(START, WAY, WIDTH))
    np.testing.assert_allclose(view.tip.px, [105 + 0.0015 * 95**2, 113.0], atol=0.3)


def test_the_common_case_is_one_call() -> None:
    start = Start(START, WAY, WIDTH)
    tube = Tube(1.0, Tip("ball", 1.4), clamped=True)
    assert COMPILED_STAGES.see_from_base is not None
    found = COMPILED_STAGES.see_from_base("left", drawn_tube(), None, CAMERA, tube, start.px, start.way, start.width_px)
    assert found is not None


def test_readable_stages_see_without_compiling(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tubesight.vision.stages.COMPILED", False)
    stages.cache_clear()
    try:
        chosen: Stages = stages()
        assert chosen is READABLE
    finally:
        stages.cache_clear()
