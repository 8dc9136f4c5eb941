"""Competitors held to the skin that they start from, each by its own settings, as `ours` can be."""

from typing import Any

import msgspec
import pytest
import torch

from rewild4d.baselines.d3dgs import D3dgsStarConfig
from rewild4d.baselines.gart_config import GartConfig
from rewild4d.ours.losses.config import Skin
from rewild4d.registry import load_method
from rewild4d.running.conformance import tiny_case
from rewild4d.types import Case

pytestmark = pytest.mark.usefixtures("one_thread")

SHORT: dict[str, Any] = {"image_size": 64, "canonical": {"samples": 150}, "density": {"start": 1.0}}
TINY = {
    "gart": msgspec.convert(SHORT | {"skinning": {"resolution": 8, "sweeps": 1}, "mirrored": 0.5}, GartConfig),
    "d3dgs-star": msgspec.convert(SHORT | {"network": {"width": 16, "time_width": 8}}, D3dgsStarConfig),
}


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case()


def fitted(name: str, case: Case, skin: Skin, steps: int) -> tuple[torch.Tensor, dict[str, float]]:
    """Return canonical centres [n, 3] after some steps, and the last figures of the log."""
    figures: dict[str, float] = {}
    config = msgspec.structs.replace(TINY[name], iterations=steps, skin=skin)
    made = load_method(name).fit(
        case.clip, case.prior, config=config, seed=0, device=torch.device("cpu"),
        log=lambda _done, _total, values: figures.update(values), workdir=None,
    )  # fmt: skip
    own = made.gaussians if name == "gart" else made.model.gaussians
    return own.means.detach(), figures


@pytest.mark.parametrize("name", TINY)
def test_settings_of_the_skin_act(name: str, case: Case) -> None:
    start, _ = fitted(name, case, Skin(), 0)
    free, plain = fitted(name, case, Skin(), 3)
    assert not torch.equal(free, start) and {"disc", "bind"}.isdisjoint(plain), "off by default"
    # Without evidence no place is told: centres stay, whatever the images ask for.
    still, _ = fitted(name, case, Skin(follow=True), 3)
    assert torch.equal(still, start)
    held = Skin(disc=0.05, bind=0.02, evidence=0.02, follow=True, heights=1e-3)
    moved, figures = fitted(name, case, held, 3)
    assert figures["disc"] > 0 and "bind" in figures
    assert 0 < float((moved - start).norm(dim=-1).max()) < 3 * (1e-3 + 8e-4 * 3**0.5)
