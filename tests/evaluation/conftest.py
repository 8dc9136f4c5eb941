"""`score` with small networks in place of the real ones, which need their weights."""

import json

import pytest
from extractors import LinearNetwork, LinearVideoNetwork, SquaredError
from pictures import Call

from rewild4d import cli
from rewild4d.commands import score as command
from rewild4d.evaluation.networks import Networks


@pytest.fixture
def networks(monkeypatch: pytest.MonkeyPatch) -> Networks:
    """Small networks that `score` loads."""
    made = Networks({"lpips_alex": SquaredError(), "lpips_vgg": SquaredError()}, LinearNetwork(), LinearVideoNetwork())
    monkeypatch.setattr(command, "load_networks", lambda families, device: made)
    return made


@pytest.fixture
def score(networks: Networks, capsys: pytest.CaptureFixture[str]) -> Call:
    """Call `score --json` and give what it prints."""

    def call(*words: object) -> dict:  # type: ignore[type-arg]
        with pytest.raises(SystemExit) as stop:
            cli.main(["score", *map(str, words), "--json"])
        out, err = capsys.readouterr()
        assert stop.value.code == 0, err
        return json.loads(out)

    return call
