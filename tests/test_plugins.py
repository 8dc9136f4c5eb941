"""What other packages add by entry points: methods, data sets, protocols; a broken one is a sentence."""

from collections.abc import Callable

import pytest

from rewild4d import cli
from rewild4d.errors import UserError
from rewild4d.evaluation.image_scores import summarize
from rewild4d.evaluation.protocol import find_protocol, load_protocols
from rewild4d.metrics.names import COLOR_METRICS, IMAGES
from rewild4d.registry import load_method

PROTOCOL = """
name = "mine-64-v1"
dataset = "mine"
title = "Mine"
description = "A test."
default = true
background = 1.0
scores = ["psnr"]
floors = ["empty"]

[selection]
cameras = "sweep"
size = 64
framing = "full"
"""
Install = Callable[..., None]


def test_a_package_brings_its_data_sets_protocols(install: Install) -> None:
    files = {"their_package/__init__.py": "class Mine: pass\n", "their_package/mine.toml": PROTOCOL}
    install(("datasets", "mine", "their_package:Mine"), ("protocols", "mine", "their_package"), files=files)
    assert find_protocol("mine", None).name == "mine-64-v1"
    assert "mine-64-v1" in load_protocols() and "artemis-sweep-256-v4" in load_protocols()


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (PROTOCOL.replace("mine-64-v1", "artemis-sweep-256-v1"), "the name 'artemis-sweep-256-v1' is taken"),
        (PROTOCOL.replace('["psnr"]', '["beauty"]'), "unknown score 'beauty'"),
        ("name = ", "protocols 'mine': their_package: "),
    ],
)
def test_a_protocol_that_does_not_fit_is_a_sentence(install: Install, text: str, sentence: str) -> None:
    files = {"their_package/__init__.py": "", "their_package/mine.toml": text}
    install(("protocols", "mine", "their_package"), files=files)
    with pytest.raises(UserError, match=sentence):
        load_protocols()


@pytest.mark.parametrize("target", ["their_package:Nope", "their_other_package:Mine"])
def test_a_package_that_cannot_be_used_hides_no_other(
    install: Install, target: str, capsys: pytest.CaptureFixture[str]
) -> None:
    files = {"their_package/__init__.py": "class Mine: pass\n"}
    install(("methods", "broken", target), ("datasets", "mine", "their_package:Mine"), files=files)
    with pytest.raises(UserError, match=f"method 'broken': expected an object at {target}, but"):
        load_method("broken")
    with pytest.raises(SystemExit) as stop:
        cli.main(["list"])
    said = capsys.readouterr().out
    assert stop.value.code == 0 and "artemis-sweep-256-v4" in said
    assert f"broken       cannot be used: method 'broken': expected an object at {target}" in said
    assert "mine         no description" in said


def test_every_image_score_says_which_way_is_better() -> None:
    lower = {name for name in IMAGES if summarize(name, [0.5]).better == "lower"}
    assert lower == {name for name in IMAGES if name.startswith("lpips")}
    assert set(COLOR_METRICS) == {"psnr", "ssim", "lpips_alex", "lpips_vgg"}
    with pytest.raises(KeyError):
        summarize("rmse", [0.5])


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (["run", "--table"], "--table: expected the name of a table, got none; available: ablation, aim, artemis"),
        (["run", "--tabel", "artemis"], "unknown option '--tabel'. Did you mean '--table'?"),
        (
            ["check", "--method", "prior-only", "--preset", "standrad"],
            "unknown preset 'standrad'. Did you mean 'standard'",
        ),
    ],
)
def test_a_misspelt_word_is_a_sentence(words: list[str], sentence: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        cli.main(words)
    assert stop.value.code == 2 and sentence in capsys.readouterr().err
