"""Find what a table's file needs to run, and which records are its rows."""

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Any

import msgspec

from rewild4d.config import load_preset, merged, preset_names
from rewild4d.errors import UserError, unknown_name
from rewild4d.evaluation.protocol import load_protocols, newest_version
from rewild4d.leaderboard.records import RunRecord
from rewild4d.leaderboard.specs import Condition, Line, Reported, Spec, load_reported
from rewild4d.leaderboard.tables import Entrant, Frame
from rewild4d.leaderboard.variants import by_version, is_floor, latest
from rewild4d.priors.choose import PriorChoice
from rewild4d.priors.config import PRESETS as PRIOR_PRESETS
from rewild4d.priors.config import STANDARD
from rewild4d.registry import load_dataset, load_method, names
from rewild4d.running.older import notes_on, renewed, renewed_prior, without_older
from rewild4d.running.provenance import FROM_TRUTH
from rewild4d.running.runner import Entry


@dataclass(frozen=True)
class Choice:
    """Changes of a table by the command line.

    Attributes:
        preset: of every row that names none; "" leaves the table's.
        protocol: instead of that of a table with one condition; "" leaves it.
    """

    preset: str = ""
    protocol: str = ""


def with_choice(name: str, spec: Spec, choice: Choice) -> Spec:
    """Apply the command line's changes to a table, with full names of protocols.

    Raises:
        UserError: an unknown protocol, or one for a table of several conditions.
    """
    conditions = spec.conditions
    if choice.protocol:
        if len(conditions) > 1:
            raise UserError(f"--protocol: the table '{name}' compares {len(conditions)} conditions of its own.")
        conditions = (msgspec.structs.replace(conditions[0], protocol=known_protocol(choice.protocol)),)
    full = tuple(msgspec.structs.replace(one, protocol=newest_protocol(one.protocol)) for one in conditions)
    return msgspec.structs.replace(spec, conditions=full, preset=choice.preset or spec.preset)


def newest_protocol(name: str) -> str:
    """Return the full name of a protocol: of a family ("artemis-sweep-256") the highest version; others unchanged."""
    return newest_version(name, load_protocols())


def known_protocol(name: str, recorded: Iterable[str] = ()) -> str:
    """Return the full name of an available protocol or family, or of one in the records; UserError where unknown."""
    full, known = newest_protocol(name), {*load_protocols(), *recorded}
    if full not in known:
        raise unknown_name("protocol", name, known)
    return full


def row_entry(table: str, row: Line, spec: Spec, seeds: tuple[int, ...]) -> Entry:
    """Return method and full settings of a row.

    Raises:
        UserError: an unknown method or preset, or settings that do not fit the method.
    """
    if row.method not in names("methods"):
        raise UserError(f"table '{table}', row '{row.label}': {unknown_name('method', row.method, names('methods'))}")
    config_type = load_method(row.method).Config
    preset = (row.preset or spec.preset) if preset_names(row.method) else "default"
    base = msgspec.to_builtins(load_preset(row.method, config_type, preset))
    try:
        config = msgspec.convert(merged(base, row.settings), type=config_type)
    except msgspec.ValidationError as error:
        raise UserError(
            f"table '{table}', row '{row.label}': the settings do not fit '{row.method}': {error}."
        ) from error
    return Entry(row.method, preset, config, seeds)


def entries(name: str, spec: Spec, seeds: tuple[int, ...]) -> tuple[Entry, ...]:
    """List what to run for the rows of a table, equal ones once."""
    found: list[Entry] = []
    for row in spec.rows:
        entry = row_entry(name, row, spec, seeds)
        if all((entry.method, entry.config) != (other.method, other.config) for other in found):
            found.append(entry)
    return tuple(found)


def cases_of_conditions(spec: Spec) -> dict[tuple[str, str], tuple[str, ...]]:
    """Return (protocol, prior) of the conditions on the table's own data set, each once, with the patterns of their
    cases, () for all."""
    found: dict[tuple[str, str], tuple[str, ...]] = {}
    for one in own_conditions(spec):
        key = one.protocol, one.prior
        whole = not one.cases or (key in found and not found[key])
        found[key] = () if whole else (*found.get(key, ()), *one.cases)
    return found


def own_conditions(spec: Spec) -> tuple[Condition, ...]:
    """Return the conditions on the table's own data set, which `run --table` runs."""
    return tuple(one for one in spec.conditions if one.dataset in ("", spec.dataset))


def is_complete(entrant: Entrant, spec: Spec) -> bool:
    """Tell whether a row has records under each condition on the table's own data set."""
    own = own_conditions(spec)
    return all(found for found, one in zip(entrant.records, spec.conditions, strict=True) if one in own)


def frame(name: str, spec: Spec, notes: Sequence[str] = ()) -> Frame:
    """Return titles, columns and notes of a table."""
    several = len(spec.conditions) > 1
    titles = tuple(one.title or one.protocol if several else "" for one in spec.conditions)
    where = ", ".join(dict.fromkeys(f"`{one.protocol}`" for one in spec.conditions))
    caption = " ".join([*spec.description.split(), f"Preset {spec.preset}; {where}."])
    return Frame(name, spec.title, caption, titles, spec.scores, tuple(notes))


def entrants(name: str, spec: Spec, records: Sequence[RunRecord]) -> tuple[list[Entrant], list[str]]:
    """Return the rows of a table with their records, then its lower-bound rows, and notes on records left out."""
    kept, left_out = latest([r for r in records if any(_is_under(r, condition, spec) for condition in spec.conditions)])
    kept = [_beside_equals(record) for record in kept]
    under = [tuple(r for r in kept if _is_under(r, condition, spec)) for condition in spec.conditions]
    rows = []
    for row in spec.rows:
        notes: tuple[str, ...] = (row.note,) if row.note else ()
        try:
            entry = row_entry(name, row, spec, ())
        except UserError as error:
            rows.append(Entrant(row.label, ((),) * len(under), str(error), notes))
            continue
        own = tuple(
            without_older([r for r in found if r.method == entry.method and _equals(r.config, entry.config)])
            for found in under
        )
        notes += _notes(own)
        rows += [Entrant(row.label + version, part, "", notes) for version, part in by_version(own).items()]
    shown = {row.method for row in spec.rows}
    # Lower bounds are shown for the cases of the other rows.
    cases = [{r.case for row in rows for r in row.records[index]} for index in range(len(under))]
    floors = dict.fromkeys(r.method for found in under for r in found if is_floor(r) and r.method not in shown)
    for floor in floors:
        own = tuple(
            tuple(r for r in found if r.method == floor and r.case in cases[index]) for index, found in enumerate(under)
        )
        if any(own):
            config = max((run for found in own for run in found), key=lambda run: run.timing.started).config
            own = tuple(tuple(run for run in found if run.config == config) for found in own)
            rows += [Entrant(floor + version, part, "", _notes(part)) for version, part in by_version(own).items()]
    return rows, [*left_out, *_missing(spec, cases)]


def _notes(conditions: Sequence[Sequence[RunRecord]]) -> tuple[str, ...]:
    """Return what was mended since the runs of a row, each once."""
    return tuple(dict.fromkeys(note for found in conditions for run in found for note in notes_on(run)))


def reported(spec: Spec) -> Reported | None:
    """Load the paper's own numbers for this table, or None; of a single condition those under its title."""
    if not spec.paper:
        return None
    found, single = load_reported(spec.paper), len(spec.conditions) == 1
    start = f"{spec.conditions[0].title}/" if single else ""
    rows = tuple(
        msgspec.structs.replace(row, cells={name.removeprefix(start): value for name, value in row.cells.items()})
        for row in found.rows
    )
    return msgspec.structs.replace(found, rows=rows)


def _is_under(record: RunRecord, condition: Condition, spec: Spec) -> bool:
    choice = record.prior.get("choice", record.prior.get("name"))
    dataset = condition.dataset or spec.dataset
    wanted = dataset, condition.protocol, condition.prior, getattr(load_dataset(dataset), "keypoint_use", "none")
    fits = not condition.cases or any(fnmatchcase(record.case, pattern) for pattern in condition.cases)
    effort = record.prior.get("config")  # records from before it was written have none
    known_cameras = record.protocol.get("selection", {}).get("cameras") != "unknown"
    asked = PriorChoice(condition.prior, PRIOR_PRESETS.get(spec.preset, STANDARD)).settings_under(known_cameras)
    same_effort = effort is None or _equals(renewed_prior(effort, asked), asked)
    found = record.dataset, record.protocol["name"], choice, record.prior.get("keypoints", "none")
    return found == wanted and fits and same_effort


def _missing(spec: Spec, cases: Sequence[Collection[str]]) -> list[str]:
    """Say which patterns of cases fit none of the rows' cases; conditions without any case say so in the cells."""
    absent = [
        pattern
        for condition, found in zip(spec.conditions, cases, strict=True)
        for pattern in condition.cases
        if found and not any(fnmatchcase(case, pattern) for case in found)
    ]
    names = ", ".join(dict.fromkeys(absent))
    return [f"Missing: there is no record here of {names}, which the table's file names too."] if absent else []


def _beside_equals(record: RunRecord) -> RunRecord:
    """Drop the mark of a prior made from the truth, which all rows of a condition have."""
    return msgspec.structs.replace(record, marks=[mark for mark in record.marks if mark != FROM_TRUTH])


def _equals(settings: Any, wanted: msgspec.Struct) -> bool:
    """Compare a record's settings; those newer than the record have their defaults in it."""
    try:
        return msgspec.convert(renewed(settings, wanted), type=type(wanted)) == wanted
    except msgspec.ValidationError:
        return False
