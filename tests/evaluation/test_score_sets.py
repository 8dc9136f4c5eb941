"""`score`: sets that are not paired, and clouds of Gaussians; what stands on two draws from one side."""

import math
from collections.abc import Sequence
from pathlib import Path

import pytest
import torch
from extractors import LinearNetwork
from torch import Tensor

from rewild4d.evaluation.cloud_scoring import score_clouds
from rewild4d.evaluation.folders import image_distances
from rewild4d.evaluation.networks import Networks
from rewild4d.io.ply import write_splats
from rewild4d.metrics.samples import Conditions
from rewild4d.types import Splats


def test_the_interval_of_unpaired_sets_does_not_hang_on_their_order() -> None:
    draw = torch.Generator().manual_seed(0)
    clips = [[torch.rand(3, 32, 32, generator=draw) * (0.2 + 0.08 * i) for _ in range(3)] for i in range(10)]
    networks = Networks({}, LinearNetwork(), None)

    def interval(truth: Sequence[Sequence[Tensor]], paired: bool) -> tuple[float, float]:
        (found, *_) = image_distances(
            (clips[:5], truth), paired, ["kid"], networks, Conditions(), lambda title: lambda done, total: None
        )
        assert found.interval is not None
        return found.interval

    given, turned = clips[5:], clips[:4:-1]
    assert interval(given, False) == pytest.approx(interval(turned, False), rel=0.1)
    assert interval(given, True) != pytest.approx(interval(turned, True), rel=0.1)  # here the order says who is whose


def test_the_floor_of_gaussians_stands_on_points_that_share_none(tmp_path: Path) -> None:
    def ball(seed: int) -> Path:
        given = torch.randn(400, 3, generator=torch.Generator().manual_seed(seed))
        means, turns = torch.nn.functional.normalize(given, dim=1), torch.tensor([[1.0, 0, 0, 0]]).expand(400, 4)
        path = tmp_path / f"{seed}.ply"
        write_splats(path, Splats(means, turns, torch.full((400, 3), 0.01), torch.full((400,), 0.9), means[:, None]))
        return path

    found = score_clouds(ball(1), ball(2), points=300)
    (said,) = [note for note in found.notes if "floor of each" in note]
    floor = float(said.split("chamfer ")[1].split(",")[0])
    # 200 points a half against 300 a side: sqrt(300 / 200) times the distance that another sampling of the ball has
    assert floor == pytest.approx(math.sqrt(300 / 200) * (found.scores["chamfer"].value or 0), rel=0.15)
    assert any("two disjoint samples of the truth with 200 points each" in note for note in found.notes)
