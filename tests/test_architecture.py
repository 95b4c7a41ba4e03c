"""The rules of docs/architecture.md, held by machine."""

import ast
import subprocess
import sys
from pathlib import Path

import pytest

from tubesight.methods import METHODS

ROOT = Path(__file__).resolve().parents[1]
PACKAGE = ROOT / "src" / "tubesight"
MODULES = sorted(PACKAGE.rglob("*.py"))
HEADLESS = ("core", "geometry", "vision", "methods", "sensor")


def name_of(path: Path) -> str:
    parts = path.relative_to(PACKAGE.parent).with_suffix("").parts
    return ".".join(parts[:-1] if parts[-1] == "__init__" else parts)


def imports(path: Path, top_level: bool = False) -> set[str]:
    """Modules a file imports; with `top_level` only those that importing it imports too."""
    tree = ast.parse(path.read_text(encoding="utf-8"))
    nodes = tree.body if top_level else list(ast.walk(tree))
    found = set()
    for node in nodes:
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found |= {f"{node.module}.{alias.name}" for alias in node.names} | {str(node.module)}
    return found


def test_import_contracts_hold() -> None:
    done = subprocess.run(
        [Path(sys.executable).with_name("lint-imports"), "--no-cache"], cwd=ROOT, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stdout


def test_core_to_sensor_run_headless() -> None:
    """Neither screen, command line nor file formats are needed to measure."""
    names = [name_of(path) for path in MODULES if path.relative_to(PACKAGE).parts[0].removesuffix(".py") in HEADLESS]
    assert "tubesight.sensor" in names
    script = f"""
import importlib, sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in {{"matplotlib", "typer", "rich", "pydantic", "yaml", "tkinter"}}:
            raise ImportError("blocked: " + name)
sys.meta_path.insert(0, Block())
for name in {names}:
    importlib.import_module(name)
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_modules_and_functions_are_short(path: Path) -> None:
    text = path.read_text(encoding="utf-8")
    assert len(text.splitlines()) <= 400
    functions = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    long = [f"{n.name}: {n.end_lineno - n.lineno + 1} lines" for n in functions if n.end_lineno - n.lineno >= 60]
    assert not long


@pytest.mark.parametrize("path", MODULES, ids=name_of)
def test_heavy_and_optional_modules_stay_where_they_belong(path: Path) -> None:
    anywhere, at_import = imports(path), imports(path, top_level=True)
    roots = {name.split(".")[0] for name in anywhere}
    assert "numba" not in roots or path.name.endswith("kernels.py")
    assert "pydicom" not in roots or path.parent.name == "sources"
    assert not any(name.startswith("matplotlib") for name in at_import), "an extra: import it in a function"
    if path.parent.name == "cli":
        heavy = {"numpy", "scipy", "cv2", "pydantic", "numba"} & {name.split(".")[0] for name in at_import}
        assert not heavy, "`tubesight --help` has to answer at once: import in the command"


def test_no_method_imports_another() -> None:
    """A method that starts from another takes the starter as a field; the registry wires them."""
    modules = {method.solve.__module__ for method in METHODS.values()}
    assert len(modules) > 1
    for path in MODULES:
        if name_of(path) in modules:
            assert not imports(path) & modules, name_of(path)


def test_every_module_says_what_it_is_for() -> None:
    silent = [name_of(path) for path in MODULES if not ast.get_docstring(ast.parse(path.read_text(encoding="utf-8")))]
    assert not silent
