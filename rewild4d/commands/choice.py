"""Apply the command line to a named table: another protocol with its data set, the cases that the data has."""

from collections.abc import Sequence
from fnmatch import fnmatchcase

import msgspec

from rewild4d.config import preset_names
from rewild4d.errors import UserError, unknown_name
from rewild4d.evaluation.protocol import load_protocols
from rewild4d.leaderboard.specs import Spec
from rewild4d.running import planning


def chosen(name: str, spec: Spec, choice: planning.Choice) -> Spec:
    """Apply the command line's changes to a table; a protocol of another data set selects all cases of that data set.

    Raises:
        UserError: a preset that no row has, or as `planning.with_choice`.
    """
    presets = {preset for row in spec.rows if not row.preset for preset in preset_names(row.method)}
    if choice.preset and presets and choice.preset not in presets:
        raise unknown_name("preset", choice.preset, presets)
    if choice.protocol and len(spec.conditions) == 1:
        known = load_protocols().get(planning.newest_protocol(choice.protocol))
        if known is not None and known.dataset != spec.dataset:
            condition = msgspec.structs.replace(spec.conditions[0], cases=())
            spec = msgspec.structs.replace(spec, conditions=(condition,), dataset=known.dataset)
    return planning.with_choice(name, spec, choice)


def cases_of(name: str, known: Sequence[str], patterns: Sequence[str]) -> tuple[tuple[str, ...], str]:
    """Return the cases of a table that the data has, and a sentence on those that it has not.

    Args:
        name: of the table.
        known: cases of the data.
        patterns: names or patterns of the table, () for all.

    Raises:
        UserError: the data has none of them.
    """
    absent = [pattern for pattern in patterns if not any(fnmatchcase(case, pattern) for case in known)]
    found = tuple(case for case in known if not patterns or any(fnmatchcase(case, pattern) for pattern in patterns))
    if not found:
        raise UserError(
            f"table '{name}': expected data with cases among {', '.join(patterns)}, got {', '.join(known[:8])}"
            f"{', ...' if len(known) > 8 else ''}."
        )
    return found, f"table '{name}': the data has no {', '.join(absent)}" if absent else ""
