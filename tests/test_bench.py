"""The benchmark: what a program reads of it."""

import json

import pytest
from typer.testing import CliRunner

from tubesight.apps.bench import PAPER_US, run_benchmark
from tubesight.cli.main import app


def test_every_pair_is_timed() -> None:
    measured = run_benchmark(2, ("cone_ray",))
    timing = measured.methods["cone_ray"]
    assert timing.failures == 0
    assert 0 < timing.median_us <= timing.p99_us
    assert set(timing.stages_us) == {"see left", "see right", "solve"}
    assert measured.ratios("cone_ray")["paper"] == pytest.approx(PAPER_US / timing.median_us)
    assert measured.yuyv_us["cone_ray"] > 0
    assert set(measured.decoding_us) == {"jpeg_colour", "jpeg_gray", "yuyv_to_bgr", "yuyv_gray_view"}


def test_command_prints_json_alone() -> None:
    result = CliRunner().invoke(app, ["bench", "--pairs", "1", "--method", "cone_ray", "--json"])
    assert result.exit_code == 0
    printed = json.loads(result.stdout)
    assert printed["pairs"] == 1
    assert printed["size_px"] == [1920, 1080]
    assert set(printed["methods"]) == {"cone_ray"}
    assert {"median_us", "p99_us", "stages_us"} <= set(printed["methods"]["cone_ray"])


def test_unknown_method_is_refused() -> None:
    with pytest.raises(ValueError, match="silhouette"):
        run_benchmark(1, ("nothing",))
