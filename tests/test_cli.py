"""The command line: help, names with a suggestion, exit codes, and bad input in one sentence."""

import subprocess
import sys
from pathlib import Path

import pytest

from rewild4d import cli


def call(*words: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from rewild4d.cli import main; main()", *words], capture_output=True, text=True
    )


def refused(capsys: pytest.CaptureFixture[str], *words: str) -> str:
    """The one sentence that a refused command leaves on standard error."""
    with pytest.raises(SystemExit) as stop:
        cli.main(list(words))
    out, err = capsys.readouterr()
    assert stop.value.code == 2
    assert out == ""
    assert "Traceback" not in err
    assert len(err.strip().splitlines()) == 1
    return err


@pytest.mark.parametrize("words", [["--help"], *([name, "--help"] for name in cli.COMMANDS)])
def test_help_exits_with_zero(words: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(words)
    assert stop.value.code == 0
    assert "usage" in capsys.readouterr().out.lower()


def test_help_of_run_shows_the_methods_settings(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        cli.main(["run", "--method", "prior-only", "--help"])
    assert "--gaussians" in capsys.readouterr().out


def test_list_names_everything(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["list"])
    out = capsys.readouterr().out
    assert stop.value.code == 0
    for name in ("ours", "prior-only", "artemis", "artemis-sweep-256-v1", "(default)"):
        assert name in out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["rnu"], "unknown command 'rnu'. Did you mean 'run'?"),
        (["run", "--method", "our"], "unknown method 'our'. Did you mean 'ours'?"),
        (["run", "--dataset", "artemi"], "unknown dataset 'artemi'. Did you mean 'artemis'?"),
        (["run", "--protocol", "artemis-swep-256-v1"], "Did you mean 'artemis-sweep-256-v1'?"),
        (
            ["run", "--method", "prior-only", "--gausians", "3"],
            "unknown option '--gausians'. Did you mean '--gaussians'?",
        ),
        (
            ["run", "--method", "prior-only", "--gaussians", "many"],
            "Error parsing --gaussians: invalid literal for int",
        ),
        (["run", "--preset", "quik"], "unknown preset of 'ours' 'quik'. Did you mean 'quick'?"),
        (["run", "--device", "tpu"], "--device: expected auto, cpu or cuda, got 'tpu'"),
        (["run", "--rasterizer", "tritn"], "unknown rasterizer 'tritn'. Did you mean 'triton'?"),
        (["evaluate", "/no/such/run", "--rasterizer", "nunba"], "unknown rasterizer 'nunba'. Did you mean 'numba'?"),
        (["run", "--threads", "0"], "--threads: expected a number of at least 1, got 0"),
        (["run", "--data", "/no/such/folder"], "/no/such/folder: expected"),
        (["table", "--runs", "/no/such/folder"], "/no/such/folder: expected a folder of runs"),
        (["check"], "check: expected one of --dataset (with --data), --method and --metric"),
        (["evaluate", "/no/such/run"], "/no/such/run/record.json: expected a run record"),
        (["make", "artemi"], "Did you mean 'artemis'?"),
        (["make", "zoo", "--seeds", "150", "--out", "x"], "zoo: expected a seed of 0 to 99 (development) or of 1000"),
        (["make", "artemis", "--rig", "/no.glb", "--clip", "Walk", "--out", "x", "--size", "640"], "got '640'"),
        (
            ["make", "artemis", "--rig", "/no.glb", "--clip", "Walk", "--out", "x", "--size", "640x99999"],
            "of 16 to 8192 ",
        ),
        (["make", "artemis", "--rig", "/no/rig.glb", "--clip", "Walk", "--out", "x"], "/no/rig.glb: expected"),
    ],
)
def test_bad_input_is_one_sentence(words: list[str], sentence: str, capsys: pytest.CaptureFixture[str],
                                   tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    assert sentence in refused(capsys, *words)
    assert not [path for path in tmp_path.rglob("*") if path.is_file()], "nothing half-written"


def test_out_that_cannot_be_written(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    assert f"--out {blocker}/runs: expected a folder that can be written" in refused(
        capsys, "run", "--out", str(blocker / "runs"), "--data", str(tmp_path)
    )


def test_entry_point_keeps_standard_output_clean() -> None:
    done = call("run", "--method", "nobody", "--json")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("rewild4d-bench: unknown method 'nobody'")


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["--canonical.sh-degree", "5"], "--canonical.sh-degree: expected `int` <= 3, got 5"),
        (["--image-size", "0"], "--image-size: expected `int` >= 16, got 0"),
        (["--rates.means", "0", "1"], "--rates.means[0]: expected `float` > 0.0, got 0.0"),
        (["--pose.width", "20", "--pose.heads", "3"], "expected a width that is a multiple of the heads, got 20 and 3"),
    ],
)
def test_a_setting_out_of_its_range_is_a_sentence(
    words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(["run", "--method", "ours", "--dataset", "artemis", *words])
    said = capsys.readouterr().err
    assert (stop.value.code, sentence in said, len(said.strip().splitlines())) == (2, True, 1)


def test_a_name_that_no_file_can_have_is_one_sentence(capsys: pytest.CaptureFixture[str]) -> None:
    said = refused(capsys, "run", "--dataset", "online", "--video", 300 * "x", "--masks", "m")
    assert "expected a shorter name: the file system takes none of this length" in said and len(said) <= 400 + 20
