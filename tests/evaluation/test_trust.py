"""Whether a result can be trusted."""

from dataclasses import replace

import pytest
import torch

from rewild4d.cameras.rendering import render
from rewild4d.evaluation.shown_frames import shown_facts
from rewild4d.evaluation.trust import body_facts, result_verdict
from rewild4d.metrics.score import Score
from rewild4d.transforms import look_at
from rewild4d.types import Camera, Clip, Frame, Splats


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


def film(splats: Splats) -> Clip:
    """Frames that show Gaussians as they are."""
    middle, up = torch.tensor((1.0, 0.5, 0.0)).double(), torch.tensor((0.0, 1.0, 0.0)).double()
    intrinsics = torch.tensor(((80.0, 0, 32), (0, 80, 32), (0, 0, 1))).double()
    camera = Camera(look_at(middle + torch.tensor((0.0, 0.0, 4.0)), middle, up), intrinsics, 64, 64)
    color, alpha = render(splats, camera)
    rgb = color / alpha.clamp(min=1e-6)
    frames = tuple(Frame(time, camera, rgb, alpha.reshape(1, 64, 64)) for time in (0.0, 0.5, 1.0))
    return Clip("sheet", "sheet", frames, 2.0, "CC0", "0")


def judged(splats: Splats, value: float | None = 0.9, template: float | None = None, shown: Clip | None = None) -> str:
    clip = shown or film(splats if len(splats.means) else body())
    return str(result_verdict(Still(splats), clip, iou(value), template))  # type: ignore[arg-type]


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


def test_a_result_is_held_against_the_frames_that_it_was_fitted_to() -> None:
    shown = film(body())
    assert judged(body(), template=0.9, shown=shown).startswith("result: green")
    narrow = body()
    narrow.means[:, 0] *= 0.8
    facts = shown_facts(Still(narrow), shown)  # type: ignore[arg-type]
    assert facts is not None and facts.iou == pytest.approx(0.8, abs=0.03) and facts.beyond < 0.05
    assert judged(narrow, template=0.9, shown=shown).startswith(
        f"result: yellow: it covers the animal in shown frames less well (IoU {facts.iou:.2f}) than the posed template "
        "that it started from (0.90)"
    )
    assert "less well" not in judged(narrow, template=facts.iou + 0.03, shown=shown)
    red = body()
    red.colors[:, :, 0] += 1
    assert "colours inside the masks of shown frames are off by 0." in judged(red, shown=shown)
    wide = body()
    wide.means[:, 1] = 0.5 + 1.3 * (wide.means[:, 1] - 0.5)
    assert "it spills beyond the masks of shown frames: colours around them are off by" in judged(wide, shown=shown)


def test_frames_without_an_animal_say_nothing() -> None:
    shown = film(body())
    bare = [replace(frame, mask=torch.zeros_like(frame.mask)) for frame in shown.frames]
    assert shown_facts(Still(body()), replace(shown, frames=tuple(bare))) is None  # type: ignore[arg-type]
