"""`evaluate`: score saved reconstructions again, by the protocol that they were fitted for."""

from dataclasses import dataclass
from pathlib import Path

import tyro

from rewild4d.commands.options import ComputeFlags
from rewild4d.config import parse_flags
from rewild4d.errors import UserError

DESCRIPTION = """Score saved reconstructions again, with the protocol that they were fitted for (another one could hold
out what the method has seen), draw their pictures again and write their records anew."""


@dataclass(frozen=True, kw_only=True)
class EvaluateChoice:
    """Flags that only `evaluate` has.

    Attributes:
        runs: folders of single runs, each with a record.json and a reconstruction.
        data: folder of the data, where it has moved since the fit.
    """

    runs: tyro.conf.Positional[tuple[Path, ...]]
    data: Path | None = None


@dataclass(frozen=True, kw_only=True)
class Options(ComputeFlags, EvaluateChoice):
    """Flags of `evaluate`."""


def main(arguments: list[str]) -> int:
    options = parse_flags(Options, arguments, prog="rewild4d-bench evaluate", description=DESCRIPTION)
    if not options.runs:
        raise UserError("evaluate: expected the folder of at least one run, got none.")
    from rewild4d.kernels.switch import choose_kernels
    from rewild4d.leaderboard.records import to_json
    from rewild4d.leaderboard.tables import markdown
    from rewild4d.running.rescoring import score_again

    choose_kernels(options.kernels)
    records = [score_again(folder, options.data, options.device, options.rasterizer) for folder in options.runs]
    print("[" + ",\n".join(map(to_json, records)) + "]" if options.json else markdown(records))
    return 0
