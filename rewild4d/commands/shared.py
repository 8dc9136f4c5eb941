"""What several commands ask of folders, numbers and floors."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rewild4d.config import load_preset, preset_names
from rewild4d.errors import UserError
from rewild4d.priors.config import PRESETS, STANDARD, Use
from rewild4d.registry import load_builtin, load_config, load_dataset

if TYPE_CHECKING:
    from rewild4d.contracts import DatasetReader
    from rewild4d.leaderboard.records import RunRecord
    from rewild4d.priors.choose import PriorChoice
    from rewild4d.running.runner import Entry, Plan

SOURCE_FLAGS = ("masks", "parts", "start", "end", "fps", "keypoints")
"""Flags that a reader takes if its `options` name them."""


def open_dataset(dataset: str, data: Path | None, options: Any = None) -> tuple[Path, DatasetReader]:
    """Return the folder or file and a reader on it; without one the built-in data, made where it is not there yet.

    Args:
        dataset: whose reader.
        data: its folder.
        options: of a command, with `video` and the `SOURCE_FLAGS`.

    Raises:
        UserError: no folder, two of them, or a flag that the data set's reader does not take.
    """
    reader = load_dataset(dataset)
    given = {name: value for name in SOURCE_FLAGS if (value := getattr(options, name, None)) is not None}
    for name in given:
        if name not in getattr(reader, "options", ()):
            raise UserError(f"--{name}: the data set '{dataset}' does not take it.")
    video = getattr(options, "video", None)
    if video is not None and data is not None:
        raise UserError("--video: expected either this or --data, got both.")
    if video is not None and dataset != "online":
        raise UserError(f"--video: expected --dataset online with it, got {dataset}.")
    data = data or video
    if data is not None:
        return data.absolute(), reader(data.absolute(), **given)
    make_builtin = load_builtin(dataset)
    if make_builtin is None:
        named = "--video" if dataset == "online" else "--data"
        raise UserError(f"{named}: the data set '{dataset}' has no built-in data; name its file or folder.")
    from rewild4d.progress import Progress

    progress = Progress("built-in animals")
    root = make_builtin(progress)
    progress.close()
    return root, reader(root)


def choose_prior(name: str, preset: str, reader: DatasetReader, options: Any = None) -> PriorChoice:
    """What `--prior` and the flags beside it say; keypoints as the data set's reader has them where nothing is said.

    Args:
        name: of the prior, as in `PriorChoice`.
        preset: of the method; the prior's effort under known cameras goes with it.
        reader: of the data set.
        options: of a command, with `keypoints`, `mapping` and `use_keypoints`.

    Raises:
        UserError: a prior file that cannot be used or a noise that is none; a file of keypoints without a mapping, a
            mapping without keypoints, or one that is not known.
    """
    from rewild4d.priors.choose import PriorChoice
    from rewild4d.priors.landmarks import load_mapping

    file, mapping, use = (getattr(options, flag, None) for flag in ("keypoints", "mapping", "use_keypoints"))
    own = getattr(reader, "keypoint_mapping", None)
    if (file is not None and mapping is None) or (file is None and mapping is not None and own is None):
        raise UserError("--keypoints and --mapping: expected both or neither.")
    chosen = mapping or own
    if chosen:
        load_mapping(chosen)
    elif use is not None:
        raise UserError(f"--use-keypoints {use}: expected keypoints, but there are none (--keypoints FILE gives some).")
    default: Use = "all" if file is not None else getattr(reader, "keypoint_use", "none")
    choice = PriorChoice(name, PRESETS.get(preset, STANDARD), chosen, use or default)
    choice.require()
    return choice


def require_writable(folder: Path) -> None:
    """Fail before hours of work, not after."""
    probe = folder / ".writable"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink(missing_ok=True)  # another run may have taken it away
    except OSError as error:
        raise UserError(f"--out {folder}: expected a folder that can be written, but: {error.strerror}.") from error


def require_writable_file(path: Path) -> None:
    """The same of one file."""
    if path.is_dir():
        raise UserError(f"--out {path}: expected the name of a file to write, but it is a folder.")
    require_writable(path.parent)


def check_numbers(jobs: int, threads: int) -> None:
    """Fail on a number of processes or threads that cannot be."""
    for flag, value, least in (("--jobs", jobs, 0), ("--threads", threads, 1)):
        if value < least:
            raise UserError(f"{flag}: expected a number of at least {least}, got {value}.")


def check_timeout(seconds: float) -> None:
    """Fail on a time in which nothing can end."""
    if seconds <= 0:
        raise UserError(f"--timeout: expected more than 0 seconds, got {seconds:g}.")


def check_seeds(seeds: Sequence[int]) -> None:
    """Fail on a seed that a random generator does not take."""
    for seed in seeds:
        if not 0 <= seed < 2**63:
            raise UserError(f"--seeds: expected numbers from 0 to 2^63 - 1, got {seed}.")


def floor_entry(name: str) -> Entry:
    """Return a lower bound as a row of a plan: its first preset, one seed."""
    from rewild4d.running.runner import Entry

    presets, config_type = preset_names(name), load_config(name)
    return Entry(name, "default", load_preset(name, config_type, presets[0]) if presets else config_type(), (0,))


def exit_code(plans: Sequence[Plan], records: Sequence[RunRecord]) -> int:
    """0 where every run of the plans has scores, 1 where one failed, 2 where a case cannot be read, which is told."""
    done = {record.case for record in records}
    lacking = list(dict.fromkeys(name for plan in plans for name in plan.cases if name not in done))
    if lacking:
        total = len({name for plan in plans for name in plan.cases})
        print(f"{len(lacking)} of {total} cases cannot be read and have no rows: {', '.join(lacking)}", file=sys.stderr)
        return 2
    return 0 if all(record.status == "ok" for record in records) else 1
