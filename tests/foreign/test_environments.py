"""Where programs of others run: command lines of containers, environments of their own, and sentences."""

import os
import sys
import venv
from pathlib import Path

import pytest

from rewild4d.errors import UserError
from rewild4d.foreign import environments
from rewild4d.foreign.environments import Docker, Here, Venv, environment_of

POSIX = pytest.mark.skipif(os.name == "nt", reason="the layout and the users of POSIX")


@pytest.fixture(scope="module")
def theirs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An environment without packages."""
    folder = tmp_path_factory.mktemp("a folder") / "theirs"
    venv.create(folder, symlinks=os.name != "nt")
    return folder


def test_a_prefix_names_the_environment(tmp_path: Path) -> None:
    assert environment_of("python") == Here()
    assert environment_of(f"venv:{tmp_path}") == Venv(tmp_path)
    assert environment_of("docker:theirs/method:1.0") == Docker("theirs/method:1.0")
    for word in ("venv:", "docker:", "docker:--privileged"):
        with pytest.raises(UserError, match="expected venv:PATH or docker:IMAGE before the program, got"):
            environment_of(word)


@POSIX
def test_the_command_line_of_a_container() -> None:
    """It is not run: no docker daemon is among what these tests need."""
    clip, out = Path("/runs/a,b/clip"), Path("/runs/work/out")
    call = Docker("theirs:1.0").call(["python", "run.py", "/clip", "/out"], clip, out, gpu=False)
    name = next(word for word in call.words if word.startswith("--name="))
    assert call.words == [
        "docker", "run", "--rm", "--init", name, f"--user={os.getuid()}:{os.getgid()}", "--env=HOME=/tmp",
        '--mount=type=bind,"source=/runs/a,b/clip",target=/clip,readonly',
        "--mount=type=bind,source=/runs/work/out,target=/out",
        "theirs:1.0", "python", "run.py", "/clip", "/out",
    ]  # fmt: skip
    assert call.variables is None and Docker("theirs:1.0").places(clip, out) == ("/clip", "/out")
    gpu = Docker("theirs:1.0").call([], clip, out, gpu=True).words
    assert gpu[gpu.index("theirs:1.0") - 1] == "--gpus=all"
    other = Docker("theirs:1.0").call([], clip, Path("/runs/other/out"), gpu=False).words
    assert name not in other, "two runs at a time have containers of their own"


@POSIX
def test_a_container_is_removed_however_its_program_ends(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """A stand-in for docker notes how it was called."""
    stub = tmp_path / "docker"
    stub.write_text(
        f'#!/bin/sh\necho "$@" >> {tmp_path}/calls.txt\n'
        'case "$1 $4" in "image here") echo sha256:12;; "image gone") echo "No such image: gone" >&2; exit 1;; esac\n'
    )
    stub.chmod(0o755)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    environments._inspected.cache_clear()
    Docker("here").require("python")
    assert Docker("here").identity() == "sha256:12"
    with pytest.raises(UserError, match="docker:gone: expected an image that docker has, .*`docker pull gone`"):
        Docker("gone").require("python")
    (tmp_path / "calls.txt").unlink()
    with pytest.raises(KeyboardInterrupt), Docker("here").watched(tmp_path / "out"):
        raise KeyboardInterrupt
    first, last = (tmp_path / "calls.txt").read_text().splitlines()
    assert first == last and first.startswith("rm --force rewild4d-")
    environments._inspected.cache_clear()


def test_without_docker_a_sentence_says_so(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(UserError, match="docker:theirs: expected docker, but there is no such program here"):
        Docker("theirs").require("python")


@POSIX
def test_an_environment_of_its_own_has_its_interpreter_and_not_our_path(
    theirs: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("PYTHONPATH", "/ours")
    environment = Venv(theirs)
    environment.require("python")
    call = environment.call(["python", "x.py"], tmp_path, tmp_path, gpu=True)
    assert call.words == [str(theirs / "bin" / "python"), "x.py"]
    assert call.variables is not None and "PYTHONPATH" not in call.variables
    assert call.variables["PATH"].startswith(str(theirs / "bin")) and call.variables["VIRTUAL_ENV"] == str(theirs)
    assert environment.places(tmp_path, tmp_path) == (str(tmp_path), str(tmp_path))
    with pytest.raises(UserError, match="expected a program that can be started in it, but there is no 'nothing'"):
        environment.require("nothing")


@POSIX
def test_a_package_more_is_another_environment(theirs: Path) -> None:
    before = Venv(theirs).identity()
    packages = theirs / f"lib/python{sys.version_info.major}.{sys.version_info.minor}/site-packages"
    (packages / "torch-2.4.dist-info").mkdir()
    assert Venv(theirs).identity() != before
    (packages / "torch-2.4.dist-info").rmdir()
    assert Venv(theirs).identity() == before


def test_an_environment_that_is_not_there_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"venv:.*nowhere: expected .*, but there is no such folder"):
        Venv(tmp_path / "nowhere").require("python")
    with pytest.raises(UserError, match="but there is no such interpreter"):
        Venv(tmp_path).require("python")
