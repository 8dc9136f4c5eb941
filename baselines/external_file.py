"""Method files: a program of others described once, in TOML, and run by `run --method FILE.toml`."""

import shlex
from pathlib import Path

import msgspec

from rewild4d.baselines.external_config import ExternalConfig
from rewild4d.errors import UserError
from rewild4d.foreign.texts import read_toml

READING = ("profile", "placed", "up", "points", "timeout")
"""Settings that a method file may give; a flag that differs from its default wins."""


class MethodFile(msgspec.Struct, frozen=True, forbid_unknown_fields=True, kw_only=True):
    """What a method file says; {here} in it stands for the file's folder.

    Attributes:
        name: of the method, for tables and records.
        command: as `ExternalConfig.command`.
        folder: as `ExternalConfig.folder`, instead of a command.
        environment: "venv:PATH" or "docker:IMAGE"; "" where the command runs as it is.
        description: one sentence.
        licence: of the program.
        citation: how to cite it.
        authors: their names.
        links: addresses of its page, paper or code.
        settings: how its files are read, by the names of `READING`.
    """

    name: str
    command: str = ""
    folder: str = ""
    environment: str = ""
    description: str = ""
    licence: str = ""
    citation: str = ""
    authors: tuple[str, ...] = ()
    links: tuple[str, ...] = ()
    settings: dict[str, str | int | float] = {}


def resolved(config: ExternalConfig) -> ExternalConfig:
    """Return settings with what their method file says in its place; without a file they stay as they are.

    Raises:
        UserError: the file cannot be read or does not fit, or a command or folder is given beside it.
    """
    if not config.file:
        return config
    if config.command or config.folder:
        raise UserError("external: expected either --file (a method file) or --command or --folder, got both.")
    path, said = Path(config.file), read_method_file(config)
    if bool(said.command) == bool(said.folder):
        raise UserError(f"{path}: expected either 'command' or 'folder' in a method file.")
    if said.environment and not said.environment.startswith(("venv:", "docker:")):
        raise UserError(f"{path}: expected 'environment' to be venv:PATH or docker:IMAGE, got '{said.environment}'.")
    here = str(path.absolute().parent)
    command = said.command.replace("{here}", shlex.quote(here))
    if said.environment:
        command = f"{shlex.quote(said.environment.replace('{here}', here))} {command}"
    if unknown := sorted({*said.settings} - {*READING}):
        raise UserError(f"{path}: expected settings among {', '.join(READING)}, got {', '.join(unknown)}.")
    default = ExternalConfig()
    given = {name: getattr(config, name) for name in READING if getattr(config, name) != getattr(default, name)}
    found = {"program": config.program or said.name, "command": command, "folder": said.folder.replace("{here}", here)}
    try:
        return msgspec.convert({**said.settings, **given, **found}, ExternalConfig)
    except msgspec.ValidationError as error:
        raise UserError(f"{path}: expected a method file, but in 'settings': {error}.") from error


def read_method_file(config: ExternalConfig) -> MethodFile:
    """Read the method file of some settings.

    Raises:
        UserError: missing, no TOML, or not what `MethodFile` says.
    """
    return read_toml(Path(config.file), "a method file", MethodFile)


def facts(config: ExternalConfig) -> dict[str, str]:
    """Return what a method file says of its program, for the record."""
    if not config.file:
        return {}
    said = read_method_file(config)
    found = {
        "description": said.description, "licence": said.licence, "citation": said.citation,
        "authors": ", ".join(said.authors), "links": " ".join(said.links), "environment": said.environment,
    }  # fmt: skip
    return {name: text for name, text in found.items() if text}
