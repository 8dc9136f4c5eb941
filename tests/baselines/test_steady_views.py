"""No fit looks at a frame through a camera that was marked as unsteady."""

from dataclasses import replace
from typing import Any

import msgspec
import pytest
import torch
from toys import TINY

from rewild4d.baselines.d3dgs_config import D3dgsConfig, D3dgsStarConfig
from rewild4d.baselines.gart_config import GartConfig
from rewild4d.ours.symmetry import Key, Supervision, Target
from rewild4d.registry import load_method
from rewild4d.running.conformance import tiny_case

pytestmark = pytest.mark.usefixtures("one_thread")

SHORT: dict[str, Any] = {"image_size": 48, "iterations": 30, "canonical": {"samples": 100, "sh_degree": 0}}
NETWORK = {"network": {"width": 16, "time_width": 8, "time_features": 4}}
GRID = {"skinning": {"resolution": 8, "neighbours": 4, "sweeps": 1}}
CONFIGS: dict[str, Any] = {
    "ours": msgspec.structs.replace(TINY, iterations=30, image_size=48),
    "d3dgs": msgspec.convert(SHORT | NETWORK, D3dgsConfig),
    "d3dgs-star": msgspec.convert(SHORT | NETWORK, D3dgsStarConfig),
    "gart": msgspec.convert(SHORT | GRID | {"mirrored": 0.5}, GartConfig),
}
PLAIN, FLIPPED = [True, False, True, True], [False, True, True, True]


@pytest.mark.parametrize("name", CONFIGS)
def test_every_method_uses_steady_views_alone(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    case, seen = tiny_case(), set[Key]()
    original = Supervision.target

    def target(self: Supervision, key: Key) -> Target:
        seen.add(key)
        return original(self, key)

    monkeypatch.setattr(Supervision, "target", target)
    prior = replace(case.prior, steady=torch.tensor([PLAIN, FLIPPED]))
    options = {"config": CONFIGS[name], "seed": 0, "device": torch.device("cpu"), "log": lambda *_: None}
    load_method(name).fit(case.clip, prior, workdir=None, **options)
    groups = (1, -1) if name == "ours" else (1,)
    wanted = {(m, t) for m, marks in ((1, PLAIN), (-1, FLIPPED)) for t in range(4) if m in groups and marks[t]}
    assert {(key.group, key.frame) for key in seen} == wanted
    assert {key.view for key in seen} == ({1} if name == "d3dgs" else {1, -1})
