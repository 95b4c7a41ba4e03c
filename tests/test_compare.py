"""`tubesight compare`: identical pictures for all methods, errors by the truth, criteria by measurement."""

import json
import re
import sys
import textwrap
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from tubesight.apps.compare import cases, measure
from tubesight.apps.compare.comparison import compare
from tubesight.apps.compare.criteria import CRITERIA, best_arc_mm, judged, stated
from tubesight.apps.compare.measure import Row, errors
from tubesight.apps.reproduce.mockup import phantom_of
from tubesight.apps.simulate import DatasetPlan, write_dataset
from tubesight.cli.main import app
from tubesight.core import InputError
from tubesight.geometry.curve import Arc
from tubesight.methods import METHODS, Method
from tubesight.methods.plugins import GROUP, Registry
from tubesight.simulate import rig_around

DOCS = Path(__file__).resolve().parents[1] / "docs"
RIG = rig_around(size_px=(960, 540))


@pytest.fixture(scope="module")
def photos(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("compare") / "photos"
    phantoms = {"round": phantom_of(60, 180), "elliptic": phantom_of(40, 60, 2.0)}
    write_dataset(folder, DatasetPlan(phantoms, RIG, board_views=0))
    return folder


def test_the_command_writes_page_rows_and_summary(photos: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    names = "cone_ray,silhouette,triangulate"
    done = CliRunner().invoke(app, ["compare", str(photos), "--methods", names, "--json", "-o", str(out)])
    assert done.exit_code == 0, done.output
    data = json.loads(done.stdout)
    assert data == json.loads((out / "summary.json").read_text())
    assert list(data["methods"]) == names.split(",")
    for entry in data["methods"].values():
        assert entry["n"] == 2 and entry["failures"] == 0
        assert entry["given"] == [] and set(entry["criteria"]) == set(CRITERIA)
        assert 0 < entry["tip_mean_mm"] <= entry["tip_max_mm"]
        assert 0 < entry["curve_mean_mm"] <= entry["curve_max_mm"]
        assert entry["ms_per_pair"] > 0
    own, naive = data["methods"]["silhouette"], data["methods"]["triangulate"]
    # A pixel is 0.54 mm here, edges are known to a fifth of it; pairing by length is 2 mm off in the mean.
    assert own["tip_max_mm"] < 0.3 and own["curve_mean_mm"] < 0.1
    assert own["criteria"]["2"] and own["criteria"]["7"]
    assert naive["curve_max_mm"] > 1 and not naive["criteria"]["2"]
    page = (out / "report.html").read_text()
    assert not re.search(r'(?:src|href)="(?!data:|#)', page), "the page needs no other file"
    assert page.count("data:image/jpeg") == 3 and "Research use only" in page
    assert len((out / "data" / "rows.csv").read_text().splitlines()) == 1 + 3 * 2


def test_every_method_has_an_entry_also_when_all_its_rows_fail(photos: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*_: object) -> Arc:
        raise ZeroDivisionError("no luck")

    method = Method("broken", "raises", "nobody", {}, broken, given=("markers",))
    registry: Mapping[str, Method] = {"cone_ray": METHODS["cone_ray"], "broken": method}
    for module in ("sensor", "apps.compare.measure", "apps.compare.comparison"):
        monkeypatch.setattr(f"tubesight.{module}.METHODS", registry)
    made = compare([photos])
    entry = made.as_dict()["methods"]["broken"]
    assert entry["failures"] == entry["n"] == 2
    assert entry["reasons"] == {measure.CRASHED: 2}
    assert entry["given"] == ["markers"] and entry["criteria"]["4"] is False
    assert entry["criteria"]["2"] is entry["criteria"]["9"] is False
    assert {row.reason for row in made.of("broken")} == {"ZeroDivisionError: no luck"}
    assert made.worst["broken"].picture.size


def test_the_table_is_printed(photos: Path) -> None:
    done = CliRunner().invoke(app, ["compare", str(photos), "--quick", "--methods", "cone_ray"])
    assert done.exit_code == 0, done.output
    assert re.search(r"cone_ray +0\.\d{3} .* 0/2 ", done.stdout)


@pytest.mark.parametrize("lacking", ["truth.json", "tube.yaml", "rig_true.yaml"])
def test_folders_without_truth_rig_or_tube_are_refused(lacking: str, photos: Path, tmp_path: Path) -> None:
    for path in photos.iterdir():
        if path.name != lacking:
            (tmp_path / path.name).symlink_to(path)
    with pytest.raises(InputError, match=r"missing; methods are compared on pictures with rig, tube\.yaml and truth"):
        compare([tmp_path], ["cone_ray"])


def test_unknown_names_are_refused() -> None:
    with pytest.raises(InputError, match="did you mean 'cone_ray'"):
        compare([], ["cone_rey"])
    with pytest.raises(InputError, match="no such folder"):
        compare([Path("nowhere")], ["cone_ray"])


def test_rendered_cases_are_those_of_the_experiment() -> None:
    assert len(cases.experiment(quick=False)) == 5 * 8
    quick = cases.experiment(quick=True)
    assert len(quick) == 5 * 2
    case = replace(quick[-1], rig=RIG)  # type: ignore[type-var]
    assert case.true.kind == "ellipse"
    plain, again, many = case.shot("plain"), case.shot("plain"), case.shot("four cameras")
    for name in RIG.names:
        np.testing.assert_array_equal(plain.pair.images[name], again.pair.images[name])
    assert len(many.pair.images) == 4
    assert sorted({row.shot("plain").rig.cameras["left"].size_px[0] for row in cases.by_resolution(True)[::3]}) == list(
        cases.QUICK_WIDTHS_PX
    )


def test_errors_count_what_a_curve_leaves_out() -> None:
    """Half of the tube lies on the truth and misses the other half."""
    case = cases.Rendered("straight", phantom_of(0, 0), RIG, 0)
    length = case.true.length_mm
    half = errors(Arc(np.zeros(2), length / 2), case.true, 1.0, 359.0)
    assert half["length_mm"] == pytest.approx(-length / 2)
    assert half["tip_mm"] == half["curve_max_mm"] == pytest.approx(length / 2)
    # Mean of 0 to L / 2 over half of the points.
    assert half["curve_mean_mm"] == pytest.approx(length / 8, rel=0.02)
    assert (half["bending_deg"], half["orientation_deg"]) == (1.0, -1.0)


def row(**changes: object) -> Row:
    known: dict[str, object] = {
        "method": "m",
        "case": "c",
        "kind": "circle",
        "width_px": 960,
        "cameras": 2,
        "status": "ok",
        "tip_mm": 0.1,
        "curve_mean_mm": 0.1,
        "curve_max_mm": 0.2,
        "ms": 5.0,
    }
    return Row(**(known | changes))  # type: ignore[arg-type]


def test_criteria_are_decided_by_measurement() -> None:
    good = [row(), row(kind="ellipse")]
    assert all(judged((), good, 6.0, 0.5).values())
    assert set(judged((), good, 6.0, 0.5)) == set(CRITERIA)
    given = ("8 views", "markers", "physical grid", "initial guess")
    assert [judged(given, good, 6.0, 0.5)[k] for k in "3456"] == [False] * 4
    assert judged((), [row(ms=40.0)], 6.0, 0.5)["1"] is False
    assert judged((), [row(tip_mm=1.1), row()], 6.0, 0.5)["2"] is False
    assert judged((), [row(status="tip_not_found")] * 2 + [row()] * 8, 6.0, 0.5)["2"] is False
    assert judged((), [row(kind="ellipse", curve_mean_mm=0.4)], 6.0, 0.5)["7"] is False
    assert judged((), [row()], 6.0, float("nan"))["7"] is None
    assert judged((), [row(tip_mm=3.0)], 6.0, 0.5)["8"] is False
    assert judged((), [row(curve_mean_mm=7.0)], 6.0, 0.5)["9"] is False


def test_an_arc_leaves_nothing_on_a_circle_and_much_on_an_ellipse() -> None:
    """The centreline has chords of 1.6 mm, 0.003 mm inside an arc of 130 mm radius."""
    assert best_arc_mm(cases.Rendered("", phantom_of(70, 30), RIG, 0).true) < 0.01
    assert 0.1 < best_arc_mm(cases.Rendered("", phantom_of(40, 30, 2.0), RIG, 0).true) < 2


def test_what_the_paper_states_covers_its_table() -> None:
    assert stated("silhouette") == {}
    assert all(stated("reference").values())
    assert stated("carving") == {k: k not in "13" for k in CRITERIA}


def write_package(folder: Path, code: str, point: str) -> None:
    """Lay out a package as installers leave it: a module and the entry points beside it."""
    (folder / "our_package").mkdir()
    (folder / "our_package" / "__init__.py").write_text("")
    (folder / "our_package" / "chord.py").write_text(code)
    about = folder / "our_package-1.dist-info"
    about.mkdir()
    (about / "METADATA").write_text("Metadata-Version: 2.1\nName: our-package\nVersion: 1\n")
    (about / "entry_points.txt").write_text(f"[{GROUP}]\n{point}\n")


def documented() -> tuple[str, str]:
    page = (DOCS / "how-to" / "methods.md").read_text()
    code = re.findall(r"```python\n(.*?)```", page, re.DOTALL)[-1]
    (point,) = re.findall(r"^chord = .*$", page, re.MULTILINE)
    return code, point.replace('"', "")


def test_a_method_of_another_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The example of the documentation, installed."""
    write_package(tmp_path, *documented())
    monkeypatch.syspath_prepend(tmp_path)
    registry = Registry({"cone_ray": METHODS["cone_ray"]})
    assert list(registry) == ["cone_ray", "chord"] and "nothing" not in registry
    for module in ("sensor", "apps.compare.measure"):
        monkeypatch.setattr(f"tubesight.{module}.METHODS", registry)
    case = cases.Rendered("straight", phantom_of(0, 0), RIG, 0)
    (made,) = measure.measured(case, ["chord"])
    # The tip of a straight tube is as high as the tube is long; a tenth of a pixel off.
    assert made.row.ok and made.row.curve_max_mm < 0.2


@pytest.mark.parametrize(
    ("code", "point", "reason"),
    [
        ("1 / 0", "chord = our_package.chord:METHOD", "ZeroDivisionError"),
        ("METHOD = 1", "chord = our_package.chord:METHOD", "TypeError: expected a tubesight.methods.Method, got int"),
        ("", "cone_ray = our_package.chord:METHOD", "ValueError: the name is taken"),
        (documented()[0], "other = our_package.chord:METHOD", "ValueError: the method calls itself 'chord'"),
    ],
)
def test_broken_packages_are_left_out(
    code: str, point: str, reason: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write_package(tmp_path, code, point)
    monkeypatch.syspath_prepend(tmp_path)
    for name in [name for name in sys.modules if name.startswith("our_package")]:
        monkeypatch.delitem(sys.modules, name)
    registry = Registry({"cone_ray": METHODS["cone_ray"]})
    with pytest.warns(RuntimeWarning, match=f"of our-package is left out: {re.escape(reason)}"):
        assert list(registry) == ["cone_ray"]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert list(registry) == ["cone_ray"], "it is told once"


def test_icp_reconstructor_that_is_not_there_is_told(photos: Path) -> None:
    with pytest.raises(InputError, match=r"has no icpReconstructor .*--external-python"):
        compare([photos], ["cone_ray"], external_python=sys.executable)
    with pytest.raises(InputError, match=r"cannot be run .*--external-python"):
        compare([photos], ["cone_ray"], external_python="no-such-python")


@pytest.mark.parametrize("works", [True, False])
def test_icp_reconstructor_is_called_in_its_own_process(works: bool, photos: Path, tmp_path: Path) -> None:
    """An interpreter that stands in for the real one: it checks the job and answers as the worker does."""
    fake = tmp_path / "python"
    answer = """
        line = [[0.0, 0.0, float(job["length_m"]) * k / 100] for k in range(101)]
        result = {"as_shipped": {"error": "NameError: name 'verbose' is not defined"},
                  "patched": {"points_m": line, "seconds": 2.0}}
    """
    code = f"""#!{sys.executable}
import json, sys
if sys.argv[1:3] != ["-E", "-c"]:
    import numpy as np
    job = np.load(sys.argv[3])
    assert int(job["cameras"]) == 2 and job["projection0"].shape == (3, 4) and job["pixels1"].shape[1] == 2
    if {works}:
{textwrap.indent(textwrap.dedent(answer), " " * 8)}
        json.dump(result, open(sys.argv[4], "w"))
    else:
        sys.exit("out of luck")
"""
    fake.write_text(code)
    fake.chmod(0o755)
    made = compare([photos], ["cone_ray"], external_python=str(fake)).as_dict()["methods"]
    shipped, patched = made["icpReconstructor"], made["icpReconstructor_patched"]
    assert shipped["failures"] == shipped["n"] == 2
    assert shipped["given"] == patched["given"] == ["length", "masks of the other methods"]
    assert patched["failures"] == (0 if works else 2)
    if works:
        # The line that the stand-in returns has the true length and misses the bend.
        assert patched["length_max_mm"] < 0.1 and patched["tip_max_mm"] > 50
        assert patched["ms_per_pair"] == 2000
