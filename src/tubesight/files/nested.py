"""Nested text: YAML and brackets, capped in depth before a parser sees them."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
import yaml

from tubesight.core import InputError

# Our deepest file, a rig with its observations, nests 8 deep.
_MAX_DEPTH = 32

_BRACKET = re.compile(r"[\[\]{}]")


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """YAML's safe loader with the plain scalars of YAML 1.2 (1e-3 is a number, a date is text), no key twice."""

    yaml_implicit_resolvers: dict[str, Any] = {}  # noqa: RUF012  (PyYAML's protocol)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        seen = set()
        for key, _ in node.value:
            text = key.value if isinstance(key, yaml.ScalarNode) else None
            if text is None or text in seen:
                problem = "a key has to be plain text" if text is None else f"the key {text[:40]!r} is there twice"
                raise yaml.constructor.ConstructorError(None, None, problem, key.start_mark)
            seen.add(text)
        return dict(super().construct_mapping(node, deep))


for _tag, _pattern, _first in (
    ("null", r"^(?:~|null|Null|NULL|)$", ["~", "n", "N", ""]),
    ("bool", r"^(?:true|True|TRUE|false|False|FALSE)$", list("tTfF")),
    ("int", r"^[-+]?[0-9]+$", list("-+0123456789")),
    (
        "float",
        r"^(?:[-+]?(?:\.[0-9]+|[0-9]+(?:\.[0-9]*)?)(?:[eE][-+]?[0-9]+)?|[-+]?\.(?:inf|Inf|INF)|\.(?:nan|NaN|NAN))$",
        list("-+.0123456789"),
    ),
):
    _Loader.add_implicit_resolver(f"tag:yaml.org,2002:{_tag}", re.compile(_pattern), _first)
_Loader.add_constructor("tag:yaml.org,2002:int", lambda loader, node: int(loader.construct_scalar(node)))


class _Dumper(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """YAML's safe dumper without aliases, which our loader refuses."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def parse_yaml(text: str, path: Path) -> Any:
    """Parse YAML with nesting capped before the parser sees it, and without aliases.

    PyYAML takes seconds on a few thousand open brackets, and an alias bomb of ten lines expands to gigabytes.
    """
    refuse_nesting(_BRACKET.finditer(text), path)
    try:
        depth = 0
        for event in yaml.parse(text, Loader=_Loader):
            if isinstance(event, yaml.AliasEvent):
                raise InputError(f"{path}: aliases (*{str(event.anchor)[:20]}) are not allowed; write the value out")
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if depth > _MAX_DEPTH:
                _too_deep(path)
        return yaml.load(text, Loader=_Loader)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = f"line {mark.line + 1}: " if mark else ""
        raise InputError(
            f"{path}: {line}{one_line(error.problem or error.context or 'not YAML')}; mend that line"
        ) from error
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        if isinstance(error, InputError):
            raise
        raise InputError(f"{path}: not YAML ({one_line(str(error))}); mend it or write it again") from error


def dump_yaml(data: Mapping[str, Any]) -> str:
    """Write plain data and arrays as YAML: keys in their order, rows of numbers on one line, floats that round-trip."""
    return str(
        yaml.dump(
            plain(data), Dumper=_Dumper, sort_keys=False, default_flow_style=None, width=2**20, allow_unicode=True
        )
    )


def plain(data: Any) -> Any:
    """Turn mappings, sequences, arrays and NumPy scalars into dicts, lists and Python scalars."""
    if isinstance(data, Mapping):
        return {str(key): plain(value) for key, value in data.items()}
    if isinstance(data, np.ndarray | np.generic):
        return data.tolist()
    if isinstance(data, list | tuple):
        return [plain(value) for value in data]
    if isinstance(data, Path):
        return str(data)
    return data


def refuse_nesting(tokens: Iterable[re.Match[str]], path: Path) -> None:
    """Raise `InputError` where brackets nest deeper than any file of ours."""
    depth = 0
    for token in tokens:
        bracket = token.group()
        depth = depth + 1 if bracket in "[{" else max(depth - 1, 0) if bracket in "]}" else depth
        if depth > _MAX_DEPTH:
            _too_deep(path)


def _too_deep(path: Path) -> NoReturn:
    raise InputError(f"{path}: nested more than {_MAX_DEPTH} deep; is it the right file?")


def one_line(text: str) -> str:
    """Put a message on one line of bounded length."""
    return " ".join(text.split())[:200]
