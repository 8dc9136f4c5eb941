"""GART sees mirror images at time -t: with poses of their own, which results do not have."""

from pathlib import Path

import msgspec
import pytest
import torch

from rewild4d.baselines.common.splatting import surface_gaussians
from rewild4d.baselines.gart import Gart, GartModel, GartTraining
from rewild4d.baselines.gart_config import GartConfig
from rewild4d.baselines.gart_skeleton import prior_poses
from rewild4d.baselines.gart_skinning import ResidualField
from rewild4d.ours.canonical import Gaussians
from rewild4d.ours.symmetry import Supervision
from rewild4d.running.conformance import tiny_case
from rewild4d.types import Case

CPU = torch.device("cpu")
SETTINGS = {
    "iterations": 6, "image_size": 64, "checkpoint_every": 2, "canonical": {"samples": 300, "sh_degree": 0},
    "skinning": {"resolution": 8, "neighbours": 4, "sweeps": 1}, "poses": {"start": 0.0},
}  # fmt: skip


@pytest.fixture(scope="module")
def case() -> Case:
    return tiny_case()


def config(mirrored: float) -> GartConfig:
    return msgspec.convert(SETTINGS | {"mirrored": mirrored}, GartConfig)


def training(case: Case, mirrored: float) -> GartTraining:
    made, generator = config(mirrored), torch.Generator().manual_seed(0)
    values = surface_gaussians(case.prior, case.clip, None, made.canonical, generator)
    plain, flipped = (prior_poses(case.prior, [0, 1, 2, 3], mirrored=side) for side in (False, True))
    model = GartModel(Gaussians(values, 0.05), ResidualField(case.prior, made.skinning), plain, flipped)
    return GartTraining(model, made, Supervision(case.clip, case.prior, 64, CPU), generator)


def test_poses_of_mirror_images_start_at_the_priors(case: Case) -> None:
    table = prior_poses(case.prior, [0, 1, 2, 3], mirrored=True)
    for frame in range(4):
        torch.testing.assert_close(table(frame)[1], case.prior.transforms_flip[frame], atol=1e-5, rtol=1e-5)


@pytest.mark.parametrize("mirrored", [0.0, 1.0])
def test_each_image_moves_its_own_poses(case: Case, mirrored: float) -> None:
    made = training(case, mirrored)
    for step in range(4):
        made.step(step)
    assert made.model.flipped is not None
    moved = [float(table.turns.detach().abs().max()) for table in (made.model.poses, made.model.flipped)]
    assert (moved[0] > 0, moved[1] > 0) == (mirrored == 0, mirrored == 1)


def test_a_mirror_image_is_fitted_by_the_pose_of_the_flipped_frame(case: Case) -> None:
    """The prior is true here, so another pose fits the silhouettes worse."""

    def loss(mirrored: float, wrong: bool) -> float:
        made = training(case, mirrored)
        if wrong:
            made.model.poses, made.model.flipped = made.model.flipped, made.model.poses  # type: ignore[assignment]
        return sum(float(made.drawn_losses(0)[0]["ssim"].detach()) for _ in range(12))

    for mirrored in (0.0, 1.0):
        assert loss(mirrored, wrong=False) < loss(mirrored, wrong=True)


def test_results_hold_the_frames_poses_and_a_killed_fit_goes_on(case: Case, tmp_path: Path) -> None:
    def fit(workdir: Path | None, log: object = lambda *_: None) -> torch.Tensor:
        made = Gart().fit(
            case.clip,
            case.prior,
            config=config(0.5),
            seed=0,
            device=CPU,
            log=log,
            workdir=workdir,  # type: ignore[arg-type]
        )
        assert len(made.poses.turns) == 4
        made.save(tmp_path)
        assert torch.equal(Gart().load(tmp_path, CPU).at(0.1).means, made.at(0.1).means)
        return made.at(0.1).means

    class Killed(Exception):
        pass

    def dies(done: int, *_: object) -> None:
        if done == config(0.5).iterations:
            raise Killed

    work = tmp_path / "work"
    work.mkdir()
    whole = fit(None)
    with pytest.raises(Killed):
        fit(work, dies)
    assert torch.equal(fit(work), whole)
