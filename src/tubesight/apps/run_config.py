"""The options of ``run`` in a file: ``run.yaml`` written by hand, or the ``run.json`` of an earlier run."""

from __future__ import annotations

from dataclasses import fields
from pathlib import Path
from typing import Any, Literal, get_type_hints

from pydantic import BaseModel, create_model

from tubesight.apps.run import RunOptions
from tubesight.core import InputError
from tubesight.files.safe import Strict, load_json, load_yaml, unknown_name, validate
from tubesight.methods import METHODS

_HINTS = get_type_hints(RunOptions)
_FIELDS: dict[str, Any] = {option.name: (_HINTS[option.name] | None, None) for option in fields(RunOptions)}
_RunConfig: type[Strict] = create_model("_RunConfig", __base__=Strict, **_FIELDS)


class _RunJson(BaseModel):
    """What is read of ``run.json``; the rest is a record of what happened."""

    format: Literal["tubesight-run/1"]
    configuration: dict[str, Any]


def load_run_config(path: Path) -> dict[str, Any]:
    """Read options of a run: the fields of `RunOptions` that the file gives.

    Paths in a YAML file start at its folder. Those in a ``run.json`` start where that run was started, as they were
    given to it.

    Raises
    ------
    InputError
        If a key is not an option, a value of the wrong kind, or the method not known.
    """
    path = Path(path)
    if path.suffix.lower() == ".json":
        recorded = load_json(path, _RunJson).configuration
        # The tube as it was read, a record beside `tube_path`.
        config = validate({key: value for key, value in recorded.items() if key != "tube"}, _RunConfig, path)
        start = Path()
    else:
        config = load_yaml(path, _RunConfig)
        start = path.parent
    given = {name: value for name in _FIELDS if (value := getattr(config, name)) is not None}
    if given.get("method", "silhouette") not in METHODS:
        raise InputError(f"{path}: {unknown_name('method', given['method'], METHODS)}")
    return {name: start / value if isinstance(value, Path) else value for name, value in given.items()}
