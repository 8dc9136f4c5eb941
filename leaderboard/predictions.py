"""What a run saved of its reconstruction, to be handed on: copied without links and without paths of a machine."""

import json
import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from rewild4d.errors import UserError, shown
from rewild4d.files import load_tensors, regular_inside
from rewild4d.foreign.reading import read_arrays, read_bytes
from rewild4d.leaderboard.privacy import texts_with_paths

FOLDER = "reconstruction"
"""Beside a record: what `Reconstruction.save` wrote."""
_HOME = re.compile(rb"/(?:home|Users)/[\w.-]+|/root/[\w.-]+|[A-Za-z]:[\\/]Users[\\/][\w.-]+")
"""A person's folder in bytes of a kind that nobody can parse here."""


def copy_predictions(run: Path, target: Path) -> bool:
    """Copy a run's reconstruction, and tell whether it has one.

    Args:
        run: folder of the run.
        target: folder of its copy.

    Raises:
        UserError: a file in it is no regular one, leads out of it, or names a path of this machine.
    """
    saved = run / FOLDER
    if not saved.is_dir():
        return False
    for source in sorted(path for path in saved.rglob("*") if path.is_symlink() or not path.is_dir()):
        regular_inside(source, saved)
        if found := next(paths_in(source), ""):
            raise UserError(
                f"{source}: expected predictions without paths of this machine, got '{shown(found)}'; leave "
                "--predictions out, or fit again with relative paths."
            )
        copy = target / FOLDER / source.relative_to(saved)
        copy.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(source, copy)
    return True


def paths_in(path: Path) -> Iterator[str]:
    """Find texts in a file that name an absolute path: of tensors and arrays their texts, of others what is text.

    Raises:
        UserError: the file is damaged.
    """
    if path.suffix in (".pt", ".pth"):
        yield from texts_with_paths(load_tensors(path))
    elif path.suffix == ".npz":
        arrays = read_arrays(path, "arrays of a reconstruction (npz)")
        yield from texts_with_paths({name: array.tolist() for name, array in arrays.items() if array.dtype.kind == "U"})
    else:
        data = read_bytes(path, "a file of a reconstruction")
        try:
            yield from texts_with_paths(_parsed(data.decode()))
        except UnicodeDecodeError:
            yield from (found[0].decode() for found in _HOME.finditer(data))


def _parsed(text: str) -> Any:
    """Return what JSON holds, whose texts may be paths with spaces; of other texts the lines."""
    try:
        return json.loads(text)
    except (ValueError, RecursionError):
        return text.splitlines()
