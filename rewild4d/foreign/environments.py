"""Where a program of others runs: here, in a virtual environment (venv:PATH), or in a container (docker:IMAGE)."""

import contextlib
import os
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

from rewild4d.errors import UserError
from rewild4d.files import digest
from rewild4d.foreign.programs import run_foreign

VENV, DOCKER = "venv:", "docker:"
CLIP, OUT = "/clip", "/out"
"""Where the two folders of a program are in its container."""
MINUTE = 60.0
_BIN, _PYTHON = ("Scripts", "python.exe") if sys.platform == "win32" else ("bin", "python")


class Call(NamedTuple):
    """What is started.

    Attributes:
        words: the program and its arguments.
        variables: of its environment; None for this process's.
    """

    words: list[str]
    variables: dict[str, str] | None


@dataclass(frozen=True)
class Here:
    """No environment: the program runs as this process does."""

    name = ""

    def require(self, program: str) -> None:
        """Fail on a program that cannot be started.

        Raises:
            UserError: so it is.
        """
        if shutil.which(program) is None:
            raise UserError(
                f"--command: expected a program that can be started, but '{program}': No such file or program."
            )

    def places(self, clip: Path, out: Path) -> tuple[str, str]:
        """Return what the program calls its two folders."""
        return str(clip), str(out)

    def call(self, words: Sequence[str], clip: Path, out: Path, gpu: bool) -> Call:
        """Return what is started; pure, nothing is looked up in containers.

        Args:
            words: of the command, with `places` in them.
            clip: folder that the program reads.
            out: folder that it writes.
            gpu: whether it may use the GPU.
        """
        return Call([*words], None)

    def identity(self) -> str:
        """Return a digest of what is installed in the environment; "" where nobody knows."""
        return ""

    @contextmanager
    def watched(self, out: Path) -> Iterator[None]:
        """Leave nothing behind of a program that was killed."""
        yield


@dataclass(frozen=True)
class Venv(Here):
    """A virtual environment, or a conda environment by its path; `activate` scripts of packages are not run."""

    folder: Path

    @property
    def name(self) -> str:  # type: ignore[override]
        return f"{VENV}{self.folder}"

    def require(self, program: str) -> None:
        python = self.folder / _BIN / _PYTHON
        if not python.is_file():
            found = "no such interpreter" if self.folder.is_dir() else "no such folder"
            raise UserError(f"{self.name}: expected an environment with {_BIN}/{_PYTHON}, but there is {found}.")
        if shutil.which(program, path=self._path) is None:
            raise UserError(f"{self.name}: expected a program that can be started in it, but there is no '{program}'.")

    def call(self, words: Sequence[str], clip: Path, out: Path, gpu: bool) -> Call:
        kept = {name: value for name, value in os.environ.items() if name not in ("PYTHONHOME", "PYTHONPATH")}
        program = shutil.which(words[0], path=self._path) or words[0]
        return Call([program, *words[1:]], {**kept, "PATH": self._path, "VIRTUAL_ENV": str(self.folder)})

    def identity(self) -> str:
        patterns = ("lib/python*/site-packages/*.dist-info", "Lib/site-packages/*.dist-info", "conda-meta/*.json")
        installed = sorted(path.name for pattern in patterns for path in self.folder.glob(pattern))
        about = self.folder / "pyvenv.cfg"
        return digest(about.read_bytes() if about.is_file() else b"", *installed)

    @property
    def _path(self) -> str:
        return os.pathsep.join((str(self.folder / _BIN), os.environ.get("PATH", "")))


@dataclass(frozen=True)
class Docker(Here):
    """A container of an image; what a command names is looked for in it."""

    image: str

    @property
    def name(self) -> str:  # type: ignore[override]
        return f"{DOCKER}{self.image}"

    def require(self, program: str) -> None:
        if shutil.which("docker") is None:
            raise UserError(f"{self.name}: expected docker, but there is no such program here.")
        found, said = _inspected(self.image)
        if not found:
            advice = f"; `docker pull {self.image}` or `docker build` brings it" if "No such image" in said else ""
            raise UserError(f"{self.name}: expected an image that docker has, but docker says: '{said}'{advice}.")

    def places(self, clip: Path, out: Path) -> tuple[str, str]:
        return CLIP, OUT

    def call(self, words: Sequence[str], clip: Path, out: Path, gpu: bool) -> Call:
        user = [f"--user={os.getuid()}:{os.getgid()}"] if hasattr(os, "getuid") else []  # else root owns what it writes
        return Call(
            ["docker", "run", "--rm", "--init", f"--name={_container(out)}", *user, "--env=HOME=/tmp",
             f"--mount={_mount(clip, CLIP)},readonly", f"--mount={_mount(out, OUT)}",
             *(["--gpus=all"] if gpu else []), self.image, *words],
            None,
        )  # fmt: skip

    def identity(self) -> str:
        return _inspected(self.image)[0]

    @contextmanager
    def watched(self, out: Path) -> Iterator[None]:
        # Who kills the client does not kill the container, neither now nor when a killed run begins anew.
        remove = ["docker", "rm", "--force", _container(out)]
        try:
            run_foreign(remove, timeout=MINUTE)
            yield
        finally:
            with contextlib.suppress(UserError):
                run_foreign(remove, timeout=MINUTE)


def environment_of(word: str) -> Here:
    """Return the environment that the first word of a command names; `Here` where it names none.

    Raises:
        UserError: a prefix without a path or an image behind it.
    """
    for prefix, kind in ((VENV, lambda rest: Venv(Path(rest).expanduser().absolute())), (DOCKER, Docker)):
        if word.startswith(prefix):
            if not (rest := word.removeprefix(prefix)) or rest.startswith("-"):
                raise UserError(f"--command: expected venv:PATH or docker:IMAGE before the program, got '{word}'.")
            return kind(rest)
    return Here()


def _mount(source: Path, target: str) -> str:
    """Write a bind mount as docker reads it: comma-separated, quoted where a path has commas or quotes."""
    part = f"source={source.absolute()}"
    quoted = '"' + part.replace('"', '""') + '"' if set(part) & {",", '"'} else part
    return f"type=bind,{quoted},target={target}"


def _container(out: Path) -> str:
    return f"rewild4d-{digest(str(out.absolute()))[:16]}"


@cache
def _inspected(image: str) -> tuple[str, str]:
    """Ask docker for an image's id; "" and its last words where there is none."""
    import tempfile

    with tempfile.TemporaryFile("w+", encoding="utf-8") as said:
        try:
            ended = run_foreign(
                ["docker", "image", "inspect", "--format={{.Id}}", image], timeout=MINUTE, stdout=said, flag=DOCKER
            )
        except UserError as error:
            return "", str(error)
        said.seek(0)
        return (said.read().strip(), "") if ended.status == 0 else ("", ended.said)
