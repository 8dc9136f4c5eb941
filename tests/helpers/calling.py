"""The command line, called as a person calls it."""

import pytest

from rewild4d import cli


def call(*words: object) -> int:
    """The exit code of a command."""
    with pytest.raises(SystemExit) as stop:
        cli.main([*map(str, words)])
    return int(stop.value.code or 0)


def output(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """What a command that succeeds prints."""
    code = call(*words)
    out, err = capsys.readouterr()
    assert code == 0, err
    return out


def refusal(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    """What a command that refuses its words says."""
    assert call(*words) == 2
    return capsys.readouterr().err
