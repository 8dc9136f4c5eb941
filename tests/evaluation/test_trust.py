"""Whether a result can be trusted."""

import pytest
import torch

from rewild4d.evaluation.trust import body_facts, result_verdict
from rewild4d.metrics.score import Score
from rewild4d.types import Splats


def body(count: int = 4000, *, torn: int = 0, needles: int = 0, opacity: float = 0.9) -> Splats:
    """Gaussians that fill a sheet of 2 x 1; some stand two lengths above it, some are long."""
    means = torch.rand(count, 3, generator=torch.Generator().manual_seed(0)) * torch.tensor((2.0, 1.0, 0.05))
    scales = torch.full((count, 3), 0.02)
    means[:torn, 1] += 4
    scales[:needles, 0] = 1.0
    quats = torch.tensor((1.0, 0, 0, 0)).expand(count, 4)
    return Splats(means, quats, scales, torch.full((count,), opacity), torch.zeros(count, 1, 3))


class Still:
    """A reconstruction of one moment."""

    def __init__(self, splats: Splats) -> None:
        self.splats = splats

    def at(self, time: float) -> Splats:
        return self.splats


def iou(value: float | None) -> dict[str, Score]:
    return {"iou": Score(value, "1", "higher", 1, [])}


def judged(splats: Splats, value: float | None = 0.9) -> str:
    return str(result_verdict(Still(splats), [0.0, 0.5, 1.0], iou(value)))  # type: ignore[arg-type]


def test_shares_are_counted() -> None:
    assert body_facts(body()) == (0.0, 0.0)
    assert body_facts(body(torn=400, needles=40)) == pytest.approx((400 / 4000, 40 / 4000), abs=0.002)
    assert body_facts(body(opacity=0.1)) == (0.0, 0.0), "what nobody sees counts for nothing"


def test_a_result_is_judged_by_its_body_and_by_held_out_masks() -> None:
    assert judged(body()) == "result: green: it hangs together and covers the animal in held-out images (IoU 0.90)"
    assert judged(body(), None) == "result: green: it hangs together"
    assert judged(body(torn=400)).startswith(
        "result: red: 10% of the visible Gaussians are apart from the body: a limb"
    )
    assert judged(body(torn=120)).startswith("result: yellow: 3% of the visible Gaussians are apart from the body;")
    assert judged(body(needles=80)).startswith("result: yellow: 2.0% of the visible Gaussians are long needles")
    assert judged(body(), 0.4).startswith("result: red: it covers the animal in held-out images with IoU 0.40 only")
    assert judged(body(), 0.6).startswith("result: yellow: it covers the animal in held-out images with IoU 0.60 only")
    assert judged(body(0)) == "result: red: there are no Gaussians"
