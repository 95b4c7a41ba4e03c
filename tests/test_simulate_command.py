"""``tubesight simulate``: a scene file to a data set that the other commands take."""

from pathlib import Path

import pytest
from typer.testing import CliRunner

from tubesight.cli.main import app, main
from tubesight.files.truth import load_truth

SCENE = """\
shapes:
  arc: {kind: circle, theta_deg: 40, phi_deg: 30, length_mm: 150}
  rod: {kind: straight, length_mm: 150}
  s: {kind: segments, segments: [{theta_deg: 40, phi_deg: 10, length_mm: 70}, {theta_deg: 30, length_mm: 70}]}
rig: {angle_deg: 80, size_px: [960, 540]}
look: {blur_px: 1.0, cloth_bgr: [60, 120, 60], clutter: 4}
board_views: 1
"""


def test_a_scene_becomes_a_data_set(tmp_path: Path) -> None:
    (tmp_path / "scene.yaml").write_text(SCENE)
    out = tmp_path / "set"
    result = CliRunner().invoke(app, ["simulate", str(tmp_path / "scene.yaml"), "-o", str(out)])
    assert result.exit_code == 0, result.output
    assert sorted(p.name for p in (out / "left").iterdir()) == ["arc.jpg", "rod.jpg", "s.jpg"]
    assert (out / "background" / "right").is_dir()
    assert {"arc", "rod", "s"} == set(load_truth(out / "truth.json"))
    run = [
        "run",
        str(out),
        "--rig",
        str(out / "rig_true.yaml"),
        "--tube",
        str(out / "tube.yaml"),
        "-o",
        str(tmp_path / "r"),
    ]
    assert CliRunner().invoke(app, run).exit_code == 0
    again = CliRunner().invoke(app, ["simulate", str(tmp_path / "scene.yaml"), "-o", str(out)])
    assert again.exit_code == 1


@pytest.mark.parametrize(
    ("change", "word"),
    [
        (("theta_deg: 40, phi_deg: 30", "thetadeg: 40"), "theta_deg"),
        (("kind: straight", "kind: spiral"), "circle"),
        (("cloth_bgr", "cloth"), "cloth_bgr"),
        (("angle_deg: 80", "angle_deg: 180"), "angle_deg"),
        (("length_mm: 150", "length_mm: .nan"), "length_mm"),
    ],
)
def test_mistakes_are_named(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], change: tuple[str, str], word: str
) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE.replace(*change))
    with pytest.raises(SystemExit) as left:
        main(["simulate", str(path), "-o", str(tmp_path / "set")])
    assert left.value.code == 1
    printed = capsys.readouterr().err.strip()
    assert "\n" not in printed and str(path) in printed and word in printed
    assert not (tmp_path / "set").exists()
