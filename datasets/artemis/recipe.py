"""What a rendered folder was made of: it is known by that on every processor, although the last digits of arithmetic,
and with them some pixels, differ from one to the next."""

import json
from pathlib import Path
from typing import Any

from rewild4d.files import digest

FILE = "recipe.json"
RENDERER = "render-v1"
"""Raised, like the version of the built-in animals, by an edit that changes pictures or truth by more than rounding."""


def write_recipe(folder: Path, made_of: dict[str, Any]) -> None:
    """Write the recipe of a finished folder, with a digest of the files that it gave.

    Args:
        folder: holds all files, but no recipe yet.
        made_of: everything that decides what is rendered, except the processor.
    """
    text = {"ingredients": {"renderer": RENDERER, **made_of}, "files": _files(folder)}
    (folder / FILE).write_text(json.dumps(text, indent=1) + "\n", encoding="utf-8")


def read_recipe(folder: Path) -> str:
    """Return the digest of the recipe; "" where there is none, or where the files are no longer those rendered."""
    made_of, files = _read(folder)
    return digest(json.dumps(made_of, sort_keys=True))[:16] if files and files == _files(folder) else ""


def ingredients(folder: Path) -> dict[str, Any]:
    """Return what a rendered folder says that it was made of; nothing where it has no recipe."""
    return _read(folder)[0]


def _read(folder: Path) -> tuple[dict[str, Any], str]:
    """Return the ingredients and the digest of the files; empty where there is no recipe."""
    try:
        recipe = json.loads((folder / FILE).read_text(encoding="utf-8"))
        return dict(recipe["ingredients"]), str(recipe["files"])
    except (OSError, ValueError, KeyError, TypeError):
        return {}, ""


def _files(folder: Path) -> str:
    """Return the digest of the names and the bytes of all files but the recipe."""
    files = (path for path in folder.rglob("*") if path.is_file() and path != folder / FILE)
    paths = sorted(files, key=lambda path: path.parts)  # Windows would sort without case
    return digest(*(part for path in paths for part in (path.relative_to(folder).as_posix(), path.read_bytes())))
