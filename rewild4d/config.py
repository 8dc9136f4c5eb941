"""Settings: a preset file, then flags, into one frozen msgspec.Struct per method."""

import contextlib
import dataclasses
import io
import math
import re
import typing
from collections.abc import Iterable, Iterator
from importlib import resources
from typing import Any, TypeVar

import msgspec

from rewild4d.errors import UserError, unknown_name
from rewild4d.foreign.texts import read_toml

T = TypeVar("T")
PRESETS = ("default", "quick", "standard", "paper")


def preset_names(method: str) -> list[str]:
    """Return names of a method's presets, as its file orders them."""
    return list(_preset_file(method))


def load_preset(method: str, config_type: type[T], preset: str) -> T:
    """A method's settings under a preset; a method without a preset file has its defaults under each of `PRESETS`.

    A preset that `extends` another, which itself extends none, has its values but for those that it names.

    Raises:
        UserError: no such preset, or the file does not fit the method's settings.
    """
    presets = _preset_file(method)
    if not presets:
        if preset not in PRESETS:
            raise unknown_name("preset", preset, PRESETS)
        return config_type()
    if preset not in presets:
        raise unknown_name(f"preset of '{method}'", preset, presets)
    own = dict(presets[preset])
    if base := own.pop("extends", None):
        if base not in presets:
            raise unknown_name(f"preset of '{method}'", base, presets)
        own = merged(presets[base], own)
    try:
        return msgspec.convert(own, type=config_type)
    except msgspec.ValidationError as error:
        raise UserError(f"presets/{method}.toml: [{preset}] does not fit {config_type.__name__}: {error}.") from error


def merged(base: dict[str, Any], changes: dict[str, Any]) -> dict[str, Any]:
    """Deep-merge two nested mappings; the second wins. Unknown names are kept, so that decoding refuses them."""
    made = dict(base)
    for key, value in changes.items():
        nested = isinstance(value, dict) and isinstance(base.get(key), dict)
        made[key] = merged(base[key], value) if nested else value
    return made


def _preset_file(method: str) -> dict[str, Any]:
    file = resources.files("rewild4d.baselines") / "presets" / f"{method}.toml"
    return read_toml(file, "presets") if file.is_file() else {}


def parse_flags(
    options_type: type[T],
    arguments: list[str],
    *,
    prog: str,
    description: str,
    config: msgspec.Struct | None = None,
    also: Iterable[str] = (),
) -> T:
    """Parse a command's flags; a misspelt one is a sentence with the nearest name, not a page.

    Args:
        options_type: a dataclass whose fields are the flags, documented by its docstring.
        arguments: what came after the command's name.
        prog: how the command is called, for help.
        description: shown on top of the help.
        config: settings of a method that are flags too (--loss.ssim 0.3); the result has them as ``config``.
        also: flags that the command knows under other circumstances, for the nearest name.

    Raises:
        UserError: a flag that does not exist, a value of the wrong type, or a number that is not finite.
        SystemExit: --help.
    """
    known = {*_flags(options_type), *(_flags(type(config)) if config is not None else ())}
    for flag in (word.split("=")[0] for word in arguments if word.startswith("--") and word != "--"):
        if flag.replace("_", "-") not in known and flag != "--help" and not flag.startswith("--tyro-"):
            raise unknown_name("option", flag, known.union(also))
    import tyro  # it takes a while, as does reading every setting's help: a misspelt flag is told before

    if config is not None:
        options_type = _with_settings(options_type, config)
    said = io.StringIO()
    try:
        with contextlib.redirect_stderr(said):
            options, unknown = tyro.cli(
                options_type, args=arguments, prog=prog, description=description, return_unknown_args=True
            )
    except SystemExit as stop:
        if not stop.code:
            raise
        raise UserError(f"{_first_words(said.getvalue()).rstrip('.')}; see {prog} --help.") from None
    if unknown and unknown[0].startswith("-"):
        raise unknown_name("option", unknown[0].split("=")[0], known.union(also))
    if unknown:
        raise UserError(f"{prog}: expected options only, got '{unknown[0]}'; see {prog} --help.")
    for flag, number in _floats(options):
        if not math.isfinite(number):
            raise UserError(f"--{flag}: expected a finite number, got {number}; see {prog} --help.")
    if isinstance(config := getattr(options, "config", None), msgspec.Struct):
        _require_ranges(config, prog)
    return options


def _floats(node: Any, place: str = "") -> Iterator[tuple[str, float]]:
    """Yield every float among parsed flags, with the flag that gave it ("rates.means[0]")."""
    if isinstance(node, float):
        yield place, node
    elif isinstance(node, tuple | list):
        for index, value in enumerate(node):
            yield from _floats(value, f"{place}[{index}]")
    else:
        for name in getattr(node, "__struct_fields__", getattr(node, "__dataclass_fields__", ())):
            flag = "" if name == "config" else name.replace("_", "-")
            yield from _floats(getattr(node, name), ".".join(filter(None, (place, flag))))


def _require_ranges(config: msgspec.Struct, prog: str) -> None:
    """Hold a method's settings against the ranges of their types, which a constructor does not look at."""
    try:
        msgspec.convert(msgspec.to_builtins(config), type=type(config))
    except msgspec.ValidationError as error:
        said, _, place = str(error).partition(" - at `$.")
        value: Any = config
        for part in re.findall(r"\w+", place):
            value = value[int(part)] if part.isdigit() else getattr(value, part)
        flag = place.rstrip("`").replace("_", "-")
        raise UserError(f"--{flag}: {said[0].lower()}{said[1:]}, got {value}; see {prog} --help.") from None


def _first_words(box: str) -> str:
    """Extract the parser's complaint from the box that it draws around it."""
    plain = re.sub(r"\x1b\[[0-9;]*m", "", box)
    sections = re.split(r"^.*(?:──|-----).*$", plain, flags=re.MULTILINE)
    sentences = [" ".join(section.replace("│", " ").split()) for section in sections]
    return next((sentence for sentence in sentences if len(sentence.split()) > 2), plain.strip())


def _with_settings(options_type: type, config: msgspec.Struct) -> type:
    """``options_type`` with one more field, ``config``, whose settings are flags without its name before them."""
    import tyro

    flattened: Any = typing.Annotated[type(config), tyro.conf.arg(name="")]  # type: ignore[valid-type]
    return dataclasses.make_dataclass(
        options_type.__name__,
        [("config", flattened, dataclasses.field(default=config))],
        bases=(options_type,),
        frozen=True,
        namespace={"__doc__": options_type.__doc__},
    )


def _flags(node: Any, prefix: str = "") -> Iterator[str]:
    """Yield every flag that a dataclass or Struct type gives, nested ones with dots."""
    for name, hint in typing.get_type_hints(node).items():
        if name.startswith("_"):
            continue
        inner = f"{prefix}{name.replace('_', '-')}"
        if isinstance(hint, type) and (issubclass(hint, msgspec.Struct) or dataclasses.is_dataclass(hint)):
            yield from _flags(hint, f"{inner}.")
        else:
            yield f"--{inner}"
            if hint is bool:
                yield f"--{prefix}no-{name.replace('_', '-')}"
