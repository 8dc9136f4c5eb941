"""`run`: fit a method on a data set and score it on held-out views."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rewild4d.commands.options import RunFlags
from rewild4d.commands.shared import (
    check_executor,
    check_numbers,
    choose_prior,
    exit_code,
    lower_bounds,
    open_dataset,
    plan_fields,
    run_plans,
)
from rewild4d.config import load_preset, parse_flags
from rewild4d.errors import UserError
from rewild4d.evaluation.protocol import find_protocol
from rewild4d.priors.config import Use
from rewild4d.registry import load_config, load_method, require_name

if TYPE_CHECKING:
    import msgspec

    from rewild4d.leaderboard.records import RunRecord
    from rewild4d.running.runner import Plan

DESCRIPTION = """Fit a method on every case of a data set and score it on held-out views.
Finished runs are skipped and a killed one resumes. Without --data the built-in animals are made on first use.
`run --table NAME` runs all that a table needs instead; its flags: `run --table NAME --help`."""


@dataclass(frozen=True, kw_only=True)
class RunChoice:
    """Flags that only `run` has.

    Attributes:
        method: which method (see `list`), or a method file of somebody else's program, FILE.toml.
        dataset: which data set (see `list`).
        case: names or patterns of cases ("wolf/Run", "wolf/*"); all (of real videos: quadrupeds) where it is left out.
        protocol: what is held out and measured (see `list`); the data set's default where it is left out.
        preset: settings and length of the fit: quick, standard or paper; of `ours` also beyond, which is standard with
            terms that the paper does not have.
        seeds: one run for each.
        prior: "template" (fitted to the clip's masks and colours: a quadruped, biped or primate, whichever fits best),
            "template:<which>" (one of these, or a rig of your own, FILE.glb), "masks" (the same from masks alone),
            "learned:<weights>" (a quadruped, also to points that a network finds; `prior train` makes weights),
            "coarse:<noise>" (from the truth plus noise, for studies), "rig" (the data set's own shape and skeleton, an
            upper bound) or a file (of a real video, by `prior fit` or `prior import`).
        keypoints: of a real video (davis, online): BADJA or COCO-like .json, DeepLabCut or SLEAP .csv.
        mapping: from names of keypoints to points of the template: aptv2, badja, superanimal-quadruped or a .toml file.
        use_keypoints: frames whose keypoints the prior's fit sees: all; half (the rest is scored); none (all are
            scored). Where it is left out: all of aptv2 and of a file, none of BADJA beside davis.
    """

    method: str = "ours"
    dataset: str = "artemis"
    case: tuple[str, ...] = ()
    protocol: str | None = None
    preset: str = "quick"
    seeds: tuple[int, ...] = (0,)
    prior: str = "template"
    keypoints: Path | None = None
    mapping: str | None = None
    use_keypoints: Use | None = None


@dataclass(frozen=True, kw_only=True)
class Options(RunFlags, RunChoice):
    """Flags of `run`."""


def main(arguments: list[str]) -> int:
    """Run the command; 0 where every run has scores, 1 where one failed, 2 where a case cannot be read."""
    if any(word.split("=")[0] == "--table" for word in arguments):
        from rewild4d.commands import run_table

        return run_table.main(arguments)
    arguments = _with_method_file(arguments)
    wanted = _peek(arguments, "--method") or Options.method
    preset = _peek(arguments, "--preset") or Options.preset
    options: Any = parse_flags(
        Options, arguments, prog="rewild4d-bench run", description=DESCRIPTION,
        config=load_preset(wanted, load_config(wanted), preset), also=["--table"],
    )  # fmt: skip
    check_executor(options)
    plan = make_plan(options, options.config)
    from rewild4d.commands.verdicts import print_verdicts
    from rewild4d.leaderboard.records import to_json
    from rewild4d.leaderboard.tables import markdown

    records = run_plans([plan], options, f"{options.method} on {options.dataset}")
    if options.json:
        print("[" + ",\n".join(to_json(record) for record in records) + "]")
    else:
        print_verdicts(records, options.method)
        print(markdown(records))
        _print_pictures(records, options)
    return exit_code([plan], records)


def make_plan(options: Options, config: msgspec.Struct) -> Plan:
    """Resolve names, folders and settings into a plan.

    Raises:
        UserError: an unknown name, a folder that is not there or cannot be written.
    """
    require_name("datasets", options.dataset)
    protocol = find_protocol(options.dataset, options.protocol)
    check_numbers(options)
    if not options.seeds:
        raise UserError("--seeds: expected at least one number, got none.")
    from rewild4d.running.runner import Entry, Plan, choose_cases

    chosen = plan_fields(options)
    root, reader = open_dataset(options.dataset, options.data, options)
    names = reader.cases(protocol.selection)
    preferred = getattr(reader, "default_cases", None)
    cases = choose_cases(names, options.case or (preferred(protocol.selection) if preferred else ()))
    if require := getattr(load_method(options.method), "require", None):
        require(config, cases)
    entry = Entry(options.method, options.preset, config, tuple(dict.fromkeys(options.seeds)))
    prior = choose_prior(options.prior, options.preset, reader, options)
    return Plan(
        dataset=options.dataset,
        reader=reader,
        root=root,
        cases=cases,
        protocol=protocol,
        entries=(*lower_bounds(protocol, (options.method,)), entry),
        prior=prior,
        **chosen,
    )


def _with_method_file(arguments: list[str]) -> list[str]:
    """Return the arguments with `--method external --file FILE.toml` for `--method FILE.toml`."""
    named = _peek(arguments, "--method") or ""
    if not named.endswith(".toml"):
        return arguments
    if f"--method={named}" in arguments:
        at = arguments.index(f"--method={named}")
        return [*arguments[:at], "--method", "external", "--file", named, *arguments[at + 1 :]]
    at = arguments.index("--method")
    return [*arguments[:at], "--method", "external", "--file", named, *arguments[at + 2 :]]


def _peek(arguments: list[str], flag: str) -> str | None:
    """Return the value of a flag before flags are parsed: method and preset decide which flags there are."""
    for i, word in enumerate(arguments):
        if word == flag and i + 1 < len(arguments):
            return arguments[i + 1]
        if word.startswith(f"{flag}="):
            return word.partition("=")[2]
    return None


def _print_pictures(records: list[RunRecord], options: Options) -> None:
    from rewild4d.running.folders import run_folder

    print()
    for record in records:
        if record.pictures and record.method == options.method:
            run = record.method, record.preset, record.seed, record.run_id
            folder = run_folder(options.out, record.protocol["name"], record.case, *run)
            print(f"{record.case}, seed {record.seed}:", *(folder / name for name in record.pictures), sep="\n  ")
    print(f"\nrecords: {options.out}", file=sys.stderr)
