"""Which views a fit draws: groups and frames that may be trained from, and the times of their code."""

from collections import Counter
from dataclasses import replace

import pytest
import torch

from rewild4d.ours.motion import Root
from rewild4d.ours.symmetry import Key, Supervision, frame_positions
from rewild4d.running.conformance import tiny_case
from rewild4d.types import Case

CPU = torch.device("cpu")
STEADY = torch.tensor([[True, False, True, True], [False, True, True, True]])
DRAWS = 4000


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case()


def drawn(case: Case, cameras: str, steady: torch.Tensor | None) -> Counter[Key]:
    supervision = Supervision(case.clip, replace(case.prior, steady=steady), 64, CPU)
    generator = torch.Generator().manual_seed(0)
    return Counter(supervision.draw(generator, 0.5, cameras) for _ in range(DRAWS))


@pytest.mark.parametrize("cameras", ["both", "own"])
@pytest.mark.parametrize("steady", [None, STEADY])
def test_views_are_drawn_evenly_from_the_steady_frames_of_each_group(
    case: Case, cameras: str, steady: torch.Tensor | None
) -> None:
    found = drawn(case, cameras, steady)
    marks = torch.ones(2, 4) if steady is None else steady
    wanted = {
        Key(group, view, frame)
        for group in (1, -1)
        for view in ((group,) if cameras == "own" else (1, -1))
        for frame in range(4)
        if marks[int(group < 0), frame]
    }
    assert set(found) == wanted
    for key, count in found.items():
        share = 1 / (2 * (1 if cameras == "own" else 2) * marks[int(key.group < 0)].sum().item())
        assert count / DRAWS == pytest.approx(share, abs=4 * (share / DRAWS) ** 0.5)


def test_a_sequence_without_steady_frames_is_not_drawn_from(case: Case) -> None:
    alone = torch.tensor([[False] * 4, [True] * 4])
    for cameras in ("both", "own"):
        assert {key.group for key in drawn(case, cameras, alone)} == {-1}


def test_times_of_the_code_are_seconds_of_the_clip(case: Case) -> None:
    """Frames 0, 1, 2, 4 of a video at 10 a second: the last gap is twice as long."""
    times = (0.0, 0.1, 0.2, 0.4)
    frames = tuple(replace(frame, time=time) for frame, time in zip(case.clip.frames, times, strict=True))
    clip = replace(case.clip, frames=frames, fps=10.0)
    prior = replace(case.prior, times=torch.tensor(times, dtype=torch.float64))
    supervision = Supervision(clip, prior, 64, CPU)
    codes = supervision.code_times([Key(1, 1, frame) for frame in range(4)])
    assert codes.tolist() == pytest.approx([1 / 5, 2 / 5, 3 / 5, 5 / 5])
    assert float(supervision.code_times([Key(1, 1, 0)], noise=0.5)) == pytest.approx(1.5 / 5)
    root = Root.of(clip, prior)
    assert [root.code_time(time) for time in (-1, 0, 0.2, 0.3, 0.4, 9)] == pytest.approx([0.2, 0.2, 0.6, 0.8, 1, 1])
    assert frame_positions(torch.tensor(times)).tolist() == pytest.approx([0, 1, 2, 4])
