"""Apply the command line to a named table: another protocol with its data set, the cases that the data has."""

from collections.abc import Sequence
from fnmatch import fnmatchcase

import msgspec

from rewild4d.config import preset_names
from rewild4d.errors import UserError, unknown_name
from rewild4d.evaluation.protocol import load_protocols, versions
from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.specs import Condition, Spec
from rewild4d.running import planning


def chosen(name: str, spec: Spec, choice: planning.Choice) -> Spec:
    """Apply the command line's changes to a table; a protocol of another data set selects all cases of that data set.

    Raises:
        UserError: a preset that no row has, or as `planning.with_choice`.
    """
    presets = {preset for row in spec.rows if not row.preset for preset in preset_names(row.method)}
    if choice.preset and presets and choice.preset not in presets:
        raise unknown_name("preset", choice.preset, presets)
    known = load_protocols().get(planning.newest_protocol(choice.protocol)) if choice.protocol else None
    return planning.with_choice(name, spec if known is None else _on(spec, known.dataset), choice)


def printed(name: str, spec: Spec, protocol: str, records: Sequence[RunRecord]) -> tuple[Spec, list[str]]:
    """Fit a table that is printed, after `chosen`, to records that may be of older protocols.

    A condition under whose newest protocol no row has a record takes the newest one under which a row has, and a note
    says so; the version that the command line names (``protocol``) stays.
    """
    recorded = {record.protocol["name"] for record in records}
    conditions, notes = [], {}
    for one in spec.conditions:
        family = one.protocol.rpartition("-v")[0]
        tried = [one.protocol] if one.protocol == protocol else [one.protocol, *versions(family, recorded)]
        each = [msgspec.structs.replace(one, protocol=version) for version in tried]
        found = next((condition for condition in each if _has_rows(name, spec, condition, records)), one)
        if found != one:
            notes[one.protocol] = f"By protocol {found.protocol}, as no row has a record of {one.protocol} here."
        conditions.append(found)
    return msgspec.structs.replace(spec, conditions=tuple(conditions)), list(notes.values())


def _has_rows(name: str, spec: Spec, condition: Condition, records: Sequence[RunRecord]) -> bool:
    """Tell whether a row of the table, no lower bound, has a record under a condition."""
    rows, _ = planning.entrants(name, msgspec.structs.replace(spec, conditions=(condition,)), records)
    return any(any(row.records) for row in rows[: len(spec.rows)])


def _on(spec: Spec, dataset: str) -> Spec:
    """Leave of a table the condition on a data set, or its first one with all cases of that data set; a table whose
    conditions share a data set stays as it is."""
    own = [one for one in spec.conditions if (one.dataset or spec.dataset) == dataset]
    if len({one.dataset or spec.dataset for one in spec.conditions}) < len(spec.conditions):
        return spec
    condition = own[0] if own else msgspec.structs.replace(spec.conditions[0], cases=())
    condition = msgspec.structs.replace(condition, dataset=dataset)
    return msgspec.structs.replace(spec, conditions=(condition,), dataset=dataset)


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
