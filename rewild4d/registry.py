"""Names to objects: lazy "module:object" strings, plus what installed packages add by entry points.

A package scan would miss the mapped folders of an editable install; a table cannot.
"""

import importlib
from importlib import metadata
from typing import Any

from rewild4d.errors import UserError, unknown_name

METHODS = {
    "ours": "rewild4d.ours.method:Ours",
    "d3dgs": "rewild4d.baselines.d3dgs:D3dgs",
    "d3dgs-star": "rewild4d.baselines.d3dgs:D3dgsStar",
    "gart": "rewild4d.baselines.gart:Gart",
    "gart-star": "rewild4d.baselines.gart:GartStar",
    "prior-only": "rewild4d.baselines.prior_only:PriorOnly",
    "empty": "rewild4d.baselines.empty:Empty",
    "external": "rewild4d.baselines.external:External",
}
DATASETS = {
    "artemis": "rewild4d.datasets.artemis.reader:Artemis",
    "davis": "rewild4d.datasets.video.davis:Davis",
    "aptv2": "rewild4d.datasets.video.aptv2:AptV2",
    "online": "rewild4d.datasets.video.online:Online",
}
BUILTIN = {"artemis": "rewild4d.datasets.builtin.synthetic:ensure"}
"""Data sets that make themselves on first use: a function that returns their folder."""


def names(kind: str) -> list[str]:
    """Every known name of a kind ("methods" or "datasets"), ours first; imports nothing."""
    return list(_table(kind))


def load_method(name: str) -> Any:
    """An instance of the method called ``name`` (contracts.Method).

    Raises:
        UserError: no such method, with the nearest name; one of another package that cannot be imported.
    """
    return _load("methods", name)()


def load_dataset(name: str) -> Any:
    """The reader class of the data set called ``name``: reader(root) -> contracts.DatasetReader.

    Raises:
        UserError: no such data set, with the nearest name; one of another package that cannot be imported.
    """
    return _load("datasets", name)


def load_builtin(name: str) -> Any:
    """The function that makes a data set's built-in folder, or None where there is none."""
    target = BUILTIN.get(name)
    return _resolve(target) if target else None


def _load(kind: str, name: str) -> Any:
    table = _table(kind)
    if name not in table:
        raise unknown_name(kind.removesuffix("s"), name, table)
    try:
        return _resolve(table[name])
    except (ImportError, AttributeError) as error:
        raise UserError(
            f"{kind.removesuffix('s')} '{name}': expected an object at {table[name]}, but {error}."
        ) from error


def _table(kind: str) -> dict[str, str]:
    own = {"methods": METHODS, "datasets": DATASETS}[kind]
    plugged = {entry.name: entry.value for entry in metadata.entry_points(group=f"rewild4d.{kind}")}
    return own | {name: target for name, target in plugged.items() if name not in own}


def _resolve(target: str) -> Any:
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)
