"""Names to objects: lazy "module:object" strings, plus what installed packages add by entry points.

A package scan would miss the mapped folders of an editable install; a table cannot.
"""

from __future__ import annotations

import importlib
from functools import cache
from importlib import metadata
from typing import TYPE_CHECKING, Any

from rewild4d.errors import UserError, unknown_name

if TYPE_CHECKING:
    import msgspec

    from rewild4d.contracts import MethodInfo, Metric

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
SETTINGS = {
    "ours": ("rewild4d.ours", "INFO", "Config"),
    "d3dgs": ("rewild4d.baselines.d3dgs_config", "INFO", "D3dgsConfig"),
    "d3dgs-star": ("rewild4d.baselines.d3dgs_config", "STAR_INFO", "D3dgsStarConfig"),
    "gart": ("rewild4d.baselines.gart_config", "INFO", "GartConfig"),
    "gart-star": ("rewild4d.baselines.gart_config", "STAR_INFO", "GartStarConfig"),
    "prior-only": ("rewild4d.baselines.floors_config", "PRIOR_ONLY_INFO", "PriorOnlyConfig"),
    "empty": ("rewild4d.baselines.floors_config", "EMPTY_INFO", "EmptyConfig"),
    "external": ("rewild4d.baselines.external_config", "INFO", "ExternalConfig"),
}
"""Modules without torch that hold `info` and `Config` of our methods: all that lists and flags need of a method."""
DATASETS = {
    "artemis": "rewild4d.datasets.artemis.reader:Artemis",
    "davis": "rewild4d.datasets.video.davis:Davis",
    "aptv2": "rewild4d.datasets.video.aptv2:AptV2",
    "online": "rewild4d.datasets.video.online:Online",
    "aim": "rewild4d.datasets.aim.reader:Aim",
    "cop3d": "rewild4d.datasets.cop3d.reader:Cop3d",
}
TITLES = {
    "artemis": "Artemis / DFA folders: one animal, or a folder of animals",
    "davis": "DAVIS 2016 and 2017: real videos with true masks",
    "aptv2": "APTv2 and APT-36K: short real clips with keypoints",
    "online": "A person's own video, with masks",
    "aim": "Animal-in-Motion (AiM): crops of 23 species out of films, with masks and predicted keypoints",
    "cop3d": "CoP3D: films of cats and dogs with cameras and soft masks",
}
"""What our data sets are: the first line of each reader's docstring, readable without importing it."""
BUILTIN = {"artemis": "rewild4d.datasets.builtin.synthetic:ensure"}
"""Data sets that make themselves on first use: a function that returns their folder."""


def names(kind: str) -> list[str]:
    """Return every known name of a kind ("methods", "datasets" or "metrics"), ours first; imports nothing.

    Metrics are those of other packages; ours are listed in `metrics.names`.
    """
    return list(_table(kind))


def load_method(name: str) -> Any:
    """Return an instance of the method called ``name`` (contracts.Method).

    Raises:
        UserError: no such method, with the nearest name; one of another package that cannot be imported.
    """
    return _load("methods", name)()


def method_info(name: str) -> MethodInfo:
    """Return the `info` of a method, without importing the method if it is ours.

    Raises:
        UserError: as `load_method`.
    """
    module, info, _ = SETTINGS.get(name, ("", "", ""))
    return _resolve(f"{module}:{info}") if module else load_method(name).info


def load_config(name: str) -> type[msgspec.Struct]:
    """Return the `Config` of a method, without importing the method if it is ours.

    Raises:
        UserError: as `load_method`.
    """
    module, _, config = SETTINGS.get(name, ("", "", ""))
    return _resolve(f"{module}:{config}") if module else load_method(name).Config


def dataset_title(name: str) -> str:
    """Return what a data set is in one line, without importing its reader if it is ours.

    One of another package says it by an attribute ``title``, or by the first line of its docstring.

    Raises:
        UserError: as `load_dataset`.
    """
    if name in TITLES:
        return TITLES[name]
    reader = load_dataset(name)
    first, *_ = (getattr(reader, "title", "") or reader.__doc__ or "no description").strip().splitlines()
    return first.rstrip(".")


def require_name(kind: str, name: str) -> None:
    """Fail on a name that no method or data set has, before anything is imported.

    Raises:
        UserError: no such name; with the nearest one.
    """
    table = _table(kind)
    if name not in table:
        raise unknown_name(kind.removesuffix("s"), name, table)


def load_dataset(name: str) -> Any:
    """Return the reader class of the data set called ``name``: reader(root) -> contracts.DatasetReader.

    Raises:
        UserError: no such data set, with the nearest name; one of another package that cannot be imported.
    """
    return _load("datasets", name)


def load_metric(name: str) -> Metric:
    """Return an instance of the metric of another package that is called ``name``.

    Raises:
        UserError: no such metric, with the nearest name; one whose package cannot be imported.
    """
    metric: Metric = _load("metrics", name)()
    return metric


def package_of(kind: str, name: str) -> dict[str, str]:
    """Return "package" and "version" of what adds a name of a kind; nothing where it is ours."""
    own = _OWN.get(kind, {})
    entry = next((entry for entry in plugged_in(kind) if entry.name == name and name not in own), None)
    if entry is None:
        return {}
    if entry.dist is None:
        return {"package": entry.module.partition(".")[0], "version": "unknown"}
    return {"package": entry.dist.name, "version": entry.dist.version}


def load_builtin(name: str) -> Any:
    """Return the function that makes a data set's built-in folder, or None where there is none."""
    target = BUILTIN.get(name)
    return _resolve(target) if target else None


def _load(kind: str, name: str) -> Any:
    require_name(kind, name)
    target, said = _table(kind)[name], f"{kind.removesuffix('s')} '{name}'"
    if name not in _OWN[kind] and len({entry.value for entry in plugged_in(kind) if entry.name == name}) > 1:
        raise UserError(f"{said}: expected one package that adds this name, got several; uninstall all but one.")
    try:
        return _resolve(target)
    except Exception as error:
        if name in _OWN[kind] and not isinstance(error, ImportError | AttributeError):
            raise
        kind_of_error = "" if isinstance(error, ImportError | AttributeError) else f"{type(error).__name__}: "
        raise UserError(f"{said}: expected an object at {target}, but {kind_of_error}{error}.") from error


_OWN: dict[str, dict[str, str]] = {"methods": METHODS, "datasets": DATASETS, "metrics": {}}


def _table(kind: str) -> dict[str, str]:
    plugged = {entry.name: entry.value for entry in plugged_in(kind)}
    return _OWN[kind] | {name: target for name, target in plugged.items() if name not in _OWN[kind]}


@cache
def plugged_in(kind: str) -> tuple[metadata.EntryPoint, ...]:
    """Return what installed packages add to "methods", "datasets", "metrics" or "protocols".

    Read once a process: it opens a file of every package in the environment.
    """
    return tuple(metadata.entry_points(group=f"rewild4d.{kind}"))


def _resolve(target: str) -> Any:
    module, _, attribute = target.partition(":")
    return getattr(importlib.import_module(module), attribute)
