"""Share what several commands do: choose a subcommand, check flags, open data, plan lower bounds."""

from __future__ import annotations

import importlib.util
import sys
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rewild4d.config import load_preset, preset_names
from rewild4d.errors import UserError, unknown_name
from rewild4d.priors.config import PRESETS, STANDARD, Use
from rewild4d.registry import load_builtin, load_config, load_dataset

if TYPE_CHECKING:
    import torch

    from rewild4d.commands.options import RunFlags
    from rewild4d.contracts import DatasetReader
    from rewild4d.evaluation.protocol import Protocol
    from rewild4d.leaderboard.records import RunRecord
    from rewild4d.priors.choose import PriorChoice
    from rewild4d.running.runner import Entry, Plan

SOURCE_FLAGS = ("masks", "parts", "start", "end", "fps", "keypoints")
"""Flags that a reader takes if its `options` name them."""


def call_subcommand(
    arguments: list[str], usage: str, kind: str, commands: Mapping[str, Callable[[list[str]], int]]
) -> int:
    """Call the subcommand that the first argument names with the other arguments; print ``usage`` if none is named.

    Raises:
        UserError: no such subcommand; ``kind`` says what its name stands for.
    """
    if not arguments or arguments[0] in ("-h", "--help"):
        print(usage)
        return 0 if arguments else 2
    if arguments[0] not in commands:
        raise unknown_name(kind, arguments[0], commands)
    return commands[arguments[0]](arguments[1:])


def open_dataset(dataset: str, data: Path | None, options: Any = None) -> tuple[Path, DatasetReader]:
    """Open a folder or file, or the built-in data, which is made on first use.

    Args:
        dataset: name of the data set.
        data: its folder or file; None for built-in data.
        options: of a command, with `video` and the `SOURCE_FLAGS`.

    Returns:
        The folder or file, and a reader of it.

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
    """Combine `--prior` and the flags of keypoints, whose defaults are the reader's.

    Args:
        name: of the prior, as in `PriorChoice`.
        preset: of the method; it decides the effort of the prior's fit under known cameras.
        reader: of the data set.
        options: of a command, with `keypoints`, `mapping` and `use_keypoints`.

    Raises:
        UserError: a prior file or a noise that cannot be used; keypoints without a mapping, a mapping without
            keypoints, or an unknown mapping.
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
    """Fail before hours of work on a folder that cannot be made or written."""
    probe = folder / ".writable"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink(missing_ok=True)  # another run may have removed it
    except OSError as error:
        raise UserError(f"--out {folder}: expected a folder that can be written, but: {error.strerror}.") from error


def require_writable_file(path: Path) -> None:
    """Fail before hours of work on a file that cannot be written."""
    if path.is_dir():
        raise UserError(f"--out {path}: expected the name of a file to write, but it is a folder.")
    require_writable(path.parent)


def check_numbers(options: Any) -> None:
    """Fail on `jobs`, `threads` or `seeds` of a command that are out of range."""
    for flag, value, least in (("--jobs", options.jobs, 0), ("--threads", options.threads, 1)):
        if value < least:
            raise UserError(f"{flag}: expected a number of at least {least}, got {value}.")
    for seed in options.seeds:
        if not 0 <= seed < 2**63:
            raise UserError(f"--seeds: expected numbers from 0 to 2^63 - 1, got {seed}.")


def check_timeout(seconds: float) -> None:
    """Fail on a time in which nothing can end."""
    if seconds <= 0:
        raise UserError(f"--timeout: expected more than 0 seconds, got {seconds:g}.")


def check_executor(options: RunFlags) -> None:
    """Fail on flags of a cluster that do not fit each other, before anything is imported."""
    given = [flag for flag in ("scheduler", "cluster") if getattr(options, flag)]
    if options.executor == "dask":
        if len(given) > 1:
            raise UserError("--cluster: expected either this or --scheduler, got both.")
        if importlib.util.find_spec("distributed") is None:
            raise UserError("--executor dask: expected the package distributed, run: pip install -e '.[cluster]'.")
    elif given or options.records != "shared":
        raise UserError(f"--{(*given, 'records')[0]}: expected --executor dask with it, got {options.executor}.")


def run_plans(plans: Sequence[Plan], options: RunFlags, title: str) -> list[RunRecord]:
    """Run plans where the flags say; return their records in order.

    Args:
        plans: what to run.
        options: of the command.
        title: of the plans, for people.

    Raises:
        UserError: as `runner.execute` and `remote.execute_remotely`.
    """
    if options.executor == "local":
        from rewild4d.running.runner import execute

        return [record for plan in plans for record in execute(plan)]
    from rewild4d.running.cluster import LOCAL, ClusterFile, Site, read_cluster_file
    from rewild4d.running.remote import execute_remotely

    if options.cluster:
        file = read_cluster_file(options.cluster)
    else:
        file = ClusterFile(LOCAL, workers=max((plan.jobs for plan in plans), default=1))
    site = Site(options.records, options.scheduler, file, f"--cluster {options.cluster}" if options.cluster else LOCAL)
    return execute_remotely(plans, site, title)


def _device(options: RunFlags) -> tuple[torch.device, str]:
    """Return device and rasterizer: of this machine, or those that workers with GPUs shall have."""
    import torch

    from rewild4d.machine import pick_device
    from rewild4d.rasterizer import pick_rasterizer
    from rewild4d.rasterizer.backends import MODULES

    elsewhere = options.executor == "dask" and options.device.split(":")[0] == "cuda" and not torch.cuda.is_available()
    if not elsewhere:
        device = pick_device(options.device)
        return device, pick_rasterizer(options.rasterizer, device)
    if options.rasterizer not in MODULES:
        raise UserError(
            f"--device {options.device}: expected --rasterizer triton or gsplat with it: this machine has no GPU to "
            "tell which one the workers have."
        )
    return torch.device(options.device), options.rasterizer


def plan_fields(options: RunFlags) -> dict[str, Any]:
    """Choose the kernels, check that `--out` can be written, and return the fields of a plan that these flags set."""
    from rewild4d.kernels.switch import choose_kernels
    from rewild4d.running.workers import usable_cores

    choose_kernels(options.kernels)
    device, rasterizer = _device(options)
    require_writable(options.out)
    jobs, out = options.jobs or usable_cores(device), options.out.absolute()
    return {"device": device, "rasterizer": rasterizer, "jobs": jobs, "threads": options.threads, "out": out}


def lower_bounds(protocol: Protocol, methods: Collection[str]) -> list[Entry]:
    """Return the lower bounds of a protocol beside ``methods`` as rows of a plan: first preset, one seed."""
    from rewild4d.running.runner import Entry

    found = []
    for name in protocol.floors:
        if name not in methods:
            presets, config_type = preset_names(name), load_config(name)
            config = load_preset(name, config_type, presets[0]) if presets else config_type()
            found.append(Entry(name, "default", config, (0,)))
    return found


def exit_code(plans: Sequence[Plan], records: Sequence[RunRecord]) -> int:
    """Return 0 where every run has scores, 1 where one failed, 2 where a case cannot be read, which is printed."""
    done = {record.case for record in records}
    lacking = list(dict.fromkeys(name for plan in plans for name in plan.cases if name not in done))
    if lacking:
        total = len({name for plan in plans for name in plan.cases})
        print(f"{len(lacking)} of {total} cases cannot be read and have no rows: {', '.join(lacking)}", file=sys.stderr)
        return 2
    return 0 if all(record.status == "ok" for record in records) else 1
