"""`list`: methods, data sets, protocols, presets and tables."""

from dataclasses import dataclass

from rewild4d.config import parse_flags, preset_names
from rewild4d.leaderboard.specs import load_specs
from rewild4d.protocol import find_protocol, load_protocols
from rewild4d.registry import BUILTIN, load_dataset, load_method, names


@dataclass(frozen=True)
class Options:
    """`list` has no flags."""


def main(arguments: list[str]) -> int:
    parse_flags(Options, arguments, prog="rewild4d-bench list", description="List all that can be named in a run.")
    print("methods")
    for name in names("methods"):
        info = load_method(name).info
        presets = ", ".join(preset_names(name))
        print(f"  {name:<12} {info.title}" + (f" ({info.paper})" if info.paper else "") + f"; licence {info.licence}")
        if presets:
            print(f"  {'':<12} presets: {presets}")
    print("data sets")
    for name in names("datasets"):
        made = "; built-in animals are made where --data is left out" if name in BUILTIN else ""
        print(f"  {name:<12} {(load_dataset(name).__doc__ or '').strip().splitlines()[0].rstrip('.')}{made}")
    print("protocols")
    for name, protocol in load_protocols().items():
        chosen = protocol.default and find_protocol(protocol.dataset, None).name == name
        print(f"  {name:<24} {protocol.title}" + (" (default)" if chosen else ""))
    print("tables")
    for name, spec in load_specs().items():
        print(f"  {name:<24} {spec.title}")
    return 0
