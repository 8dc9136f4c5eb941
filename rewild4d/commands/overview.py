"""`list`: print methods, data sets, protocols, presets and tables."""

from collections.abc import Callable
from dataclasses import dataclass

from rewild4d.config import parse_flags, preset_names
from rewild4d.errors import UserError
from rewild4d.evaluation.protocol import default_name, load_protocols, newest_version
from rewild4d.leaderboard.specs import load_specs
from rewild4d.registry import BUILTIN, dataset_title, method_info, names, package_of


@dataclass(frozen=True)
class Options:
    """`list` has no flags."""


def main(arguments: list[str]) -> int:
    parse_flags(Options, arguments, prog="rewild4d-bench list", description="List all that can be named in a run.")
    print("methods")
    for name in names("methods"):
        print(f"  {name:<12} {_described(_method, name)}{_origin('methods', name)}")
        if presets := ", ".join(preset_names(name)):
            print(f"  {'':<12} presets: {presets}")
    print("data sets")
    for name in names("datasets"):
        made = "; built-in animals are made where --data is left out" if name in BUILTIN else ""
        print(f"  {name:<12} {_described(dataset_title, name)}{made}{_origin('datasets', name)}")
    if plugged := names("metrics"):
        print("metrics of other packages (ours: docs/protocols-and-metrics.md)")
        for name in plugged:
            print(f"  {name:<12} {_described(_metric, name)}{_origin('metrics', name)}")
    print("protocols")
    protocols = load_protocols()
    for name, protocol in protocols.items():
        newest = newest_version(name.rpartition("-v")[0], protocols)
        mark = f" (older: {newest} is the newest)" if newest != name else ""
        if name == default_name(protocol.dataset, protocols):
            mark = " (default)"
        print(f"  {name:<24} {protocol.title}{mark}")
    print("tables")
    for name, spec in load_specs().items():
        print(f"  {name:<24} {spec.title}")
    return 0


def _described(describe: Callable[[str], str], name: str) -> str:
    """Describe a name, or say that its package cannot be imported."""
    try:
        return describe(name)
    except UserError as error:
        return f"cannot be used: {error}"


def _method(name: str) -> str:
    info = method_info(name)
    about = f"; {info.description.rstrip('.')}" if info.description else ""
    return info.title + (f" ({info.paper})" if info.paper else "") + f"; licence {info.licence}{about}"


def _metric(name: str) -> str:
    from rewild4d.evaluation.plugged import find_metric  # which brings torch

    _, info = find_metric(name)
    unit = f", {info.unit}" if info.unit != "1" else ""
    paper = f" ({info.paper})" if info.paper else ""
    better = f", {info.better} is better" if info.better else ""
    return f"{info.title}{unit}{paper}{better}: {info.definition.rstrip('.')}"


def _origin(kind: str, name: str) -> str:
    """Name the package that adds something; "" where it is ours."""
    found = package_of(kind, name)
    return f" [{found['package']} {found['version']}]" if found else ""
