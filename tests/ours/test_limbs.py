"""The search for limbs that others hide."""

from pathlib import Path

import msgspec
import pytest
import torch
from dying import Killed, kill_late
from toys import FRAMES, TINY, camera

from rewild4d.ours.config import Skinning
from rewild4d.ours.fit import Training, train
from rewild4d.ours.limbs import Limb, LimbSearch, bent, guesses, learn_poses, limbs_of
from rewild4d.ours.model import Model, build_model
from rewild4d.ours.pose import Pose, joint_transforms
from rewild4d.ours.symmetry import Key, Supervision
from rewild4d.priors.bodies.biped import BIPED
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.bodies.tetrapod import PARENTS
from rewild4d.priors.kinematics import pose
from rewild4d.priors.motion import quats_from_normals, sample_surface
from rewild4d.priors.posed import posed_prior
from rewild4d.rasterizer import rasterize
from rewild4d.transforms import skin_points
from rewild4d.types import Clip, Frame, Prior

pytestmark = pytest.mark.usefixtures("one_thread")

CPU = torch.device("cpu")
LEFT, RIGHT = Limb([10, 9, 8], True), Limb([19, 18, 17], True)
"""Forelegs, at x > 0 and x < 0."""
SIZE = 160, 120
SEARCHING = msgspec.structs.replace(
    TINY, image_size=SIZE[0], mirrored=0.25, cameras="own", pose=msgspec.structs.replace(TINY.pose, search_limbs=0.25)
)


def quiet(step: int, total: int, values: object) -> None:
    """Log nothing."""


def angles_of(bends: dict[int, float]) -> torch.Tensor:
    """Angles of the bones about x in every frame, [T, J, 3]."""
    angles = torch.zeros(FRAMES, 20, 3)
    for bone, angle in bends.items():
        angles[:, bone, 0] = angle
    return angles


def seen_from_the_left(bends: dict[int, float]) -> tuple[Clip, Prior]:
    """A clip of a quadruped with bones bent about x, from a camera at x > 0 that stands still, and a prior at rest."""
    cameras, rest = [camera(3).resized(*SIZE)] * FRAMES, QUADRUPED.build().bones[:, 0]
    still = torch.eye(4, dtype=torch.float64).repeat(FRAMES, 1, 1)
    times = torch.arange(FRAMES, dtype=torch.float64) / 10
    given = QUADRUPED.build(), pose(angles_of({}), rest, PARENTS), still, cameras, times
    prior = posed_prior(*given, name="toy", provenance="toy", digest="toy")
    surface = sample_surface(prior, 2000, torch.Generator().manual_seed(1))
    frames = []
    for index, transforms in enumerate(pose(angles_of(bends), rest, PARENTS)):
        view = cameras[index]
        image, alpha, _ = rasterize(
            skin_points(surface.points, surface.weights, transforms), quats_from_normals(surface.normals),
            torch.full((2000, 3), surface.radius), torch.full((2000,), 0.95), torch.full((2000, 3), 0.5),
            view.world_to_camera[None], view.intrinsics[None], *SIZE,
        )  # fmt: skip
        frames.append(Frame(index / 10, view, image[0].clamp(0, 1), alpha[0].clamp(0, 1), index))
    return Clip("toy/leg", "toy", tuple(frames), 10.0, "CC0", "toy"), prior


def at_rest(clip: Clip, prior: Prior) -> tuple[Model, Supervision]:
    """A model that has learned nothing, on many Gaussians."""
    canonical = msgspec.structs.replace(SEARCHING.canonical, samples=2000)
    config = msgspec.structs.replace(SEARCHING, canonical=canonical, skinning=Skinning())
    supervision = Supervision(clip, prior, config.image_size, CPU)
    return build_model(config, prior, torch.Generator().manual_seed(0), supervision.frame_times()), supervision


def rest_pose(count: int) -> Pose:
    """The rest pose of twenty bones, several times."""
    quats = torch.tensor((1.0, 0, 0, 0)).expand(count, 20, 4)
    return Pose(quats, torch.zeros(count, 20, 3), torch.zeros(count, 20, 1))


@pytest.mark.parametrize("body", [QUADRUPED, BIPED])
def test_limbs_are_chains_from_the_body_outwards(body: object) -> None:
    made = body.build()  # type: ignore[attr-defined]
    found = limbs_of(torch.tensor(made.parents), torch.tensor(made.mirror))
    for limb in found:
        assert [int(made.parents[bone]) for bone in limb.bones[1:]] == limb.bones[:-1]
        assert limb.slides == (int(made.mirror[limb.bones[0]]) != limb.bones[0])
        assert [int(made.mirror[bone]) for bone in limb.bones] in [other.bones for other in found]


def test_a_quadruped_has_four_legs_a_head_and_a_tail() -> None:
    made = QUADRUPED.build()
    legs = [[10, 9, 8], [13, 12, 11], [16, 15, 14], [19, 18, 17]]
    assert limbs_of(torch.tensor(made.parents), torch.tensor(made.mirror)) == [
        Limb([1, 0], False),
        Limb([5, 4], False),
        *(Limb(leg, True) for leg in legs),
    ]
    alone = torch.tensor((-1, 0, 0))
    assert limbs_of(alone, torch.arange(3)) == [Limb([0, 1], False), Limb([0, 2], False)]
    assert limbs_of(torch.tensor((-1, 0)), torch.tensor((0, 1)))[0].bones == [0, 1]


def test_the_first_guess_is_none_and_only_what_slides_is_shifted() -> None:
    for slides, count in ((True, 11 * 5 * 5), (False, 11 * 5)):
        tried = guesses(slides)
        assert len(tried.whole) == count and [float(each[0]) for each in tried] == [0, 0, 0]
        assert bool(tried.shift.any()) == slides
        assert tried.changes().shape == (count, count) and tried.changes().diagonal().eq(0).all()


def test_bends_of_the_rest_pose_are_those_of_the_kinematic_chain() -> None:
    made = QUADRUPED.build()
    pivots, limb = made.bones[:, 0].float(), LEFT
    tried = guesses(False)
    found = bent(rest_pose(len(tried.whole)), pivots, PARENTS, limb, tried)
    transforms = joint_transforms(found.quats, found.shifts, pivots)
    angles = torch.zeros(len(tried.whole), 20, 3)
    angles[:, 10, 0], angles[:, 9, 0] = tried.whole, tried.lower
    torch.testing.assert_close(transforms, pose(angles, pivots, PARENTS), atol=1e-5, rtol=0)
    shifted = bent(
        rest_pose(1), pivots, PARENTS, limb, guesses(False).at(torch.tensor([0]))._replace(shift=torch.tensor([0.4]))
    )
    moved = shifted.shifts[0].abs().sum(-1).nonzero()[:, 0].tolist()
    assert moved == [8, 9, 10]
    torch.testing.assert_close(shifted.shifts[0, moved], torch.tensor((0, 0, 0.4)).expand(3, 3))


def test_a_hidden_leg_is_found_and_the_near_one_stays() -> None:
    clip, prior = seen_from_the_left({RIGHT.bones[0]: 0.6})
    model, supervision = at_rest(clip, prior)
    found, bones = LimbSearch.of(model, supervision, 0.0).poses(1)
    assert bones == RIGHT.bones, "the far foreleg alone"
    pivots = model.pivots
    expected = pose(angles_of({RIGHT.bones[0]: 0.6}), pivots, PARENTS)[:, RIGHT.bones[-1]]
    foot = torch.nn.functional.pad(pivots[RIGHT.bones[-1]], (0, 1), value=1.0)
    there = joint_transforms(found.quats, found.shifts, pivots)[:, RIGHT.bones[-1]] @ foot
    assert (there - expected @ foot).norm(dim=-1).max() < 0.15 < (foot - expected[0] @ foot).norm() / 3


def test_limbs_that_are_where_the_masks_show_them_stay() -> None:
    model, supervision = at_rest(*seen_from_the_left({}))
    found, bones = LimbSearch.of(model, supervision, 0.0).poses(1)
    assert bones == [] and torch.equal(found.quats, rest_pose(FRAMES).quats) and not found.shifts.any()


def test_the_network_learns_what_was_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rewild4d.ours.limbs.BATCH", 8)
    clip, prior = seen_from_the_left({})
    model, supervision = at_rest(clip, prior)
    target = bent(rest_pose(FRAMES), model.pivots, model.parents, RIGHT, guesses(True).at(torch.full((FRAMES,), 30)))
    found = dict.fromkeys((1, -1), target)
    learn_poses(model, supervision, found, torch.Generator().manual_seed(0))
    keys = [Key(1, 1, frame) for frame in range(FRAMES)]
    now = model.pose(supervision.code_times(keys), keys)
    before, after = ((each[1] - target.shifts).norm(dim=-1).max() for each in (rest_pose(FRAMES), now))
    assert after < 0.2 * before


def test_where_nothing_is_found_a_fit_goes_on_as_without_a_search(monkeypatch: pytest.MonkeyPatch) -> None:
    clip, prior = seen_from_the_left({})
    searched: list[int] = []

    def nothing(self: LimbSearch, view: int) -> tuple[Pose, list[int]]:
        searched.append(view)
        return rest_pose(FRAMES), []

    monkeypatch.setattr(LimbSearch, "poses", nothing)
    brief = msgspec.structs.replace(SEARCHING, iterations=4)
    never = msgspec.structs.replace(brief, pose=TINY.pose)
    a, b = (train(clip, prior, config, 0, CPU, quiet, None).state_dict() for config in (brief, never))
    assert searched == [1, -1] and all(torch.equal(a[name], b[name]) for name in a)


def test_a_fit_pulls_to_what_was_found_and_resumes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("rewild4d.ours.limbs.COPIES", 10)
    clip, prior = seen_from_the_left({RIGHT.bones[0]: 0.6})
    seen = []

    class Watched(Training):
        def search_limbs(self, small: Supervision) -> None:
            before = self.supervision.prior_quats.clone()
            super().search_limbs(small)
            changed = (self.supervision.prior_quats - before).abs().amax((1, 3)) > 1e-3
            seen.append([row.nonzero()[:, 0].tolist() for row in changed])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("rewild4d.ours.fit.Training", Watched)
        whole = train(clip, prior, SEARCHING, 0, CPU, quiet, None)
    (sides,) = seen
    assert set(RIGHT.bones) <= set(sides[0]), "the film's far foreleg"
    with pytest.raises(Killed):
        train(clip, prior, SEARCHING, 0, CPU, kill_late, tmp_path)
    resumed = train(clip, prior, SEARCHING, 0, CPU, quiet, tmp_path)
    for (name, a), b in zip(whole.state_dict().items(), resumed.state_dict().values(), strict=True):
        assert torch.equal(a, b), name
