"""Numbers among the flags: a NaN, an infinite one or one out of its range is one sentence, before anything is made."""

from pathlib import Path

import pytest

from rewild4d import cli

FINITE = "expected a finite number, got"


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("run --method external --timeout nan", f"--timeout: {FINITE} nan; see rewild4d-bench run --help."),
        ("run --method external --timeout inf", f"--timeout: {FINITE} inf"),
        ("run --method external --timeout 0", "--timeout: expected `float` > 0.0, got 0.0"),
        ("run --method external --points 0", "--points: expected `int` >= 1, got 0"),
        ("run --method external --points -5", "--points: expected `int` >= 1, got -5"),
        ("run --method ours --rates.means 1 nan", f"--rates.means[1]: {FINITE} nan"),
        ("run --method ours --pose.anchor-std inf", f"--pose.anchor-std: {FINITE} inf"),
        ("run --table wild --start nan", f"--start: {FINITE} nan"),
        ("leaderboard collect --out kept --limit-mb nan", f"--limit-mb: {FINITE} nan"),
        ("leaderboard collect --out kept --limit-mb -inf", f"--limit-mb: {FINITE} -inf"),
        ("score --pred a --truth b --background nan", f"--background: {FINITE} nan"),
        ("score --pred a --truth b --fps 1e999", f"--fps: {FINITE} inf"),
        ("masks --video a.mp4 --out kept --end nan", f"--end: {FINITE} nan"),
        ("prior fit --frames a --masks b --out kept --fps nan", f"--fps: {FINITE} nan"),
        ("check --dataset online --fps inf", f"--fps: {FINITE} inf"),
    ],
)
def test_a_number_that_cannot_be_is_one_sentence(words: str, sentence: str, capsys: pytest.CaptureFixture[str],
                                                 tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as stop:
        cli.main(words.split())
    out, said = capsys.readouterr()
    assert (stop.value.code, out, len(said.strip().splitlines())) == (2, "", 1)
    assert sentence in said and not list(tmp_path.iterdir())
