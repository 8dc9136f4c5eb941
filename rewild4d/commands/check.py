"""`check`: a data set's folder, or a method's contract."""

from dataclasses import dataclass
from pathlib import Path

from rewild4d.commands.shared import open_dataset
from rewild4d.config import parse_flags
from rewild4d.conformance import check_method
from rewild4d.contracts import Finding
from rewild4d.errors import UserError

DESCRIPTION = """Verify a data set's folder (every fault named, not only the first), or that a method keeps its
contract: same seed same result, save and load same pixels, resume, a clear error on an empty mask."""
SIGNS = {"ok": "ok     ", "warning": "warning", "error": "ERROR  "}


@dataclass(frozen=True)
class Options:
    """Flags of `check`.

    Attributes:
        dataset: whose layout to verify.
        data: the folder; the built-in data where it is left out.
        method: verify this method instead.
        preset: settings to verify the method with.
    """

    dataset: str | None = None
    data: Path | None = None
    method: str | None = None
    preset: str = "quick"


def main(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench check", description=DESCRIPTION)
    if (options.dataset is None) == (options.method is None):
        raise UserError("check: expected either --dataset (with --data) or --method.")
    if options.dataset is not None:
        findings = open_dataset(options.dataset, options.data)[1].check()
    else:
        findings = check_method(str(options.method), options.preset)
    return report(findings)


def report(findings: list[Finding]) -> int:
    """Print the findings; 2 where one is an error."""
    for finding in findings:
        print(f"{SIGNS[finding.level]} {finding.path}: {finding.message}")
    errors = sum(finding.level == "error" for finding in findings)
    warnings = sum(finding.level == "warning" for finding in findings)
    print(f"{errors} errors, {warnings} warnings")
    return 2 if errors else 0
