"""`check`: verify a data set's folder, or the contract of a method or of another package's metric."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rewild4d.commands.options import DataFlags
from rewild4d.commands.shared import open_dataset
from rewild4d.config import parse_flags
from rewild4d.contracts import Finding
from rewild4d.errors import UserError
from rewild4d.registry import require_name

DESCRIPTION = """Verify a data set's folder and list every fault, or verify that a method keeps its contract: the same
result from the same seed, the same pixels after saving and loading, resuming, a clear error on an empty mask; or that
a metric of another package keeps its own."""
SIGNS = {"ok": "ok     ", "warning": "warning", "error": "ERROR  "}


@dataclass(frozen=True, kw_only=True)
class CheckChoice:
    """Flags that only `check` has.

    Attributes:
        dataset: data set to verify.
        case: names or patterns of the videos to check; the first few where it is left out.
        sheets: folder for contact sheets, pictures of the masks over their frames.
        method: verify this method instead.
        preset: settings to verify the method with.
        metric: verify this metric of another package instead.
    """

    dataset: str | None = None
    case: tuple[str, ...] = ()
    sheets: Path = Path("check")
    method: str | None = None
    preset: str = "quick"
    metric: str | None = None


@dataclass(frozen=True, kw_only=True)
class Options(DataFlags, CheckChoice):
    """Flags of `check`."""


def main(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench check", description=DESCRIPTION)
    if [options.dataset, options.method, options.metric].count(None) != 2:
        raise UserError("check: expected one of --dataset (with --data), --method and --metric.")
    if options.dataset is not None:
        findings = _check_data(options.dataset, options)
    elif options.metric is not None:
        require_name("metrics", options.metric)
        from rewild4d.running.conformance import check_metric

        findings = check_metric(options.metric)
    else:
        from rewild4d.running.conformance import check_method

        findings = check_method(str(options.method), options.preset)
    return report(findings)


def _check_data(dataset: str, options: Options) -> list[Finding]:
    from rewild4d.datasets.video.mask_check import SPLIT
    from rewild4d.running.runner import choose_cases

    reader: Any = open_dataset(dataset, options.data, options)[1]
    if not hasattr(reader, "video"):
        if options.case:
            raise UserError(f"--case: expected a data set of videos with it; {dataset} is checked whole.")
        return reader.check()
    cases = choose_cases(reader.cases(SPLIT), options.case) if options.case else ()
    return reader.check(cases, options.sheets)


def report(findings: list[Finding]) -> int:
    """Print the findings; return 2 where one is an error, else 0."""
    for finding in findings:
        print(f"{SIGNS[finding.level]} {finding.path}: {finding.message}")
    errors = sum(finding.level == "error" for finding in findings)
    warnings = sum(finding.level == "warning" for finding in findings)
    print(f"{errors} errors, {warnings} warnings")
    return 2 if errors else 0
