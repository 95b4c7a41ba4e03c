"""Methods of other packages: found by their entry points when a name is not one of ours, or all are asked for."""

from __future__ import annotations

import warnings
from collections.abc import Iterator, Mapping
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points

from tubesight.methods.method import Method

GROUP = "tubesight.methods"


class Registry(Mapping[str, Method]):
    """Methods by name: the package's own, then those of installed packages.

    A package registers a method by an entry point of the group ``tubesight.methods`` whose object is a `Method` of the
    same name. One that cannot be loaded, is no `Method`, or has a name that is taken is left out with a warning.

    Parameters
    ----------
    own
        Methods of this package by name.
    """

    def __init__(self, own: Mapping[str, Method]) -> None:
        self._own = own

    @cached_property
    def _all(self) -> Mapping[str, Method]:
        methods = dict(self._own)
        for point in entry_points(group=GROUP):
            try:
                methods[point.name] = _loaded(point, methods)
            # Of code from elsewhere nothing is known; the other methods work without it.
            except Exception as error:
                source = point.dist.name if point.dist is not None else point.value
                text = f"method {point.name!r} of {source} is left out: {type(error).__name__}: {error}"
                warnings.warn(text, RuntimeWarning, stacklevel=2)
        return methods

    def __getitem__(self, name: str) -> Method:
        return self._own[name] if name in self._own else self._all[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._all)

    def __len__(self) -> int:
        return len(self._all)


def _loaded(point: EntryPoint, taken: Mapping[str, Method]) -> Method:
    if point.name in taken:
        raise ValueError("the name is taken")
    method = point.load()
    if not isinstance(method, Method):
        raise TypeError(f"expected a tubesight.methods.Method, got {type(method).__name__}")
    if method.name != point.name:
        raise ValueError(f"the method calls itself {method.name!r}")
    return method
