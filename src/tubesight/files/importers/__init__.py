"""Rigs of other tools: one module a foreign format, one registry, and the checks that all pass."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType

from tubesight.core import InputError
from tubesight.files.importers import bouguet, kalibr, matlab, opencv, ros
from tubesight.files.importers.checks import assemble
from tubesight.files.importers.document import Document, read_document
from tubesight.files.importers.foreign import UNITS, ForeignRig, Settings
from tubesight.geometry.rig import Rig

__all__ = ["IMPORTERS", "UNITS", "Importer", "Settings", "import_rig"]


@dataclass(frozen=True, slots=True)
class Importer:
    """A foreign format: how to tell it, and how to read it."""

    recognise: Callable[[Document], bool]
    read: Callable[[Sequence[Document], Settings], ForeignRig]


def _importer(module: ModuleType) -> Importer:
    return Importer(module.recognise, module.read)


# In the order in which they are asked: the more a format's keys tell, the earlier.
IMPORTERS: Mapping[str, Importer] = {
    "kalibr": _importer(kalibr),
    "ros": _importer(ros),
    "opencv": _importer(opencv),
    "bouguet": _importer(bouguet),
    "matlab": _importer(matlab),
}


def import_rig(
    paths: Sequence[Path], settings: Settings | None = None, name: str | None = None
) -> tuple[Rig, str, tuple[str, ...]]:
    """Read a rig of another tool.

    Parameters
    ----------
    paths
        The files of the rig: one or more, the first camera's first.
    settings
        What the user says where the files are silent.
    name
        The format, one of `IMPORTERS`; None tells it from the content.

    Returns
    -------
    Rig
        Lengths in mm, the base frame that of the first camera; without poses where the files know the lenses alone.
    str
        The format.
    tuple[str, ...]
        Remarks for the user: what was assumed.

    Raises
    ------
    InputError
        If a file is of no known format, is damaged, or describes something that no rig can be.
    """
    if not paths:
        raise InputError("no file to import; name the files of the other tool")
    settings = settings or Settings()
    documents = [read_document(Path(path)) for path in paths]
    if name is None:
        names = [_recognise(document) for document in documents]
        for document, other in zip(documents, names, strict=True):
            if other != names[0]:
                raise InputError(
                    f"{document.path}: this file is of {other}, {documents[0].path.name} of {names[0]}; import one "
                    "format at a time, or name it with --format"
                )
        name = names[0]
    foreign = IMPORTERS[name].read(documents, settings)
    rig, notes = assemble(foreign, settings)
    return rig, name, notes


def _recognise(document: Document) -> str:
    for name, importer in IMPORTERS.items():
        if importer.recognise(document):
            return name
    keys = ", ".join(list(document.data)[:4])[:60]
    raise InputError(
        f"{document.path}: of none of the formats {', '.join(IMPORTERS)} (its keys: {keys}); name it with --format"
    )
