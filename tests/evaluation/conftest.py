"""`score` with small networks in place of the real ones, which need their weights."""

import json

import pytest
from calling import output
from extractors import LinearNetwork, LinearVideoNetwork, SquaredError
from pictures import Call

from rewild4d.evaluation.networks import Networks


@pytest.fixture
def networks(monkeypatch: pytest.MonkeyPatch) -> Networks:
    """Small networks that `score` loads."""
    made = Networks({"lpips_alex": SquaredError(), "lpips_vgg": SquaredError()}, LinearNetwork(), LinearVideoNetwork())
    monkeypatch.setattr("rewild4d.evaluation.networks.load_networks", lambda families, device: made)
    return made


@pytest.fixture
def score(networks: Networks, capsys: pytest.CaptureFixture[str]) -> Call:
    """Call `score --json` and give what it prints."""

    def call(*words: object) -> dict:  # type: ignore[type-arg]
        return json.loads(output(capsys, "score", *words, "--json"))

    return call
