"""What several commands ask of folders, numbers and floors."""

from pathlib import Path

from rewild4d.config import load_preset, preset_names
from rewild4d.contracts import DatasetReader
from rewild4d.errors import UserError
from rewild4d.registry import load_builtin, load_dataset, load_method
from rewild4d.runner import Entry, Progress


def open_dataset(dataset: str, data: Path | None) -> tuple[Path, DatasetReader]:
    """The folder and a reader on it; without a folder the built-in data, made where it is not there yet."""
    reader = load_dataset(dataset)
    if data is not None:
        return data.absolute(), reader(data.absolute())
    make_builtin = load_builtin(dataset)
    if make_builtin is None:
        raise UserError(f"--data: the data set '{dataset}' has no built-in data; name its folder.")
    progress = Progress("built-in animals")
    root = make_builtin(progress)
    progress.close()
    return root, reader(root)


def require_writable(folder: Path) -> None:
    """Fail before hours of work, not after."""
    probe = folder / ".writable"
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise UserError(f"--out {folder}: expected a folder that can be written, but: {error.strerror}.") from error


def check_numbers(jobs: int, threads: int) -> None:
    """Fail on a number of processes or threads that cannot be."""
    for flag, value, least in (("--jobs", jobs, 0), ("--threads", threads, 1)):
        if value < least:
            raise UserError(f"{flag}: expected a number of at least {least}, got {value}.")


def floor_entry(name: str) -> Entry:
    """A floor as a row of a plan: its first preset, one seed."""
    presets = preset_names(name)
    config_type = load_method(name).Config
    return Entry(name, "default", load_preset(name, config_type, presets[0]) if presets else config_type(), (0,))
