"""The parts of GART: chains of joints, the skinning residual, likeness of neighbours, refinement, D-SMAL files."""

import copy
import math
import pickle
from dataclasses import replace
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pytest
import torch
from scipy import sparse
from scipy.spatial.transform import Rotation, Slerp

from rewild4d.baselines.common.splatting import surface_gaussians
from rewild4d.baselines.gart import Gart, GartModel, GartTraining, spread
from rewild4d.baselines.gart_config import GartConfig, GartSkinning, GartStarConfig
from rewild4d.baselines.gart_skeleton import exponential_quats, pose_table, prior_poses, slerp
from rewild4d.baselines.gart_skinning import ResidualField, posed
from rewild4d.baselines.gart_smal import follow, template_prior
from rewild4d.errors import UserError
from rewild4d.harmonics import C0
from rewild4d.ours.canonical import REST_GAIN, Gaussians
from rewild4d.ours.symmetry import Supervision
from rewild4d.priors.bodies.tetrapod import PARENTS
from rewild4d.priors.kinematics import pose
from rewild4d.running.conformance import tiny_case
from rewild4d.transforms import matrix_to_quat, quat_to_matrix, skin_points, skin_quats
from rewild4d.types import Case, Prior

CPU = torch.device("cpu")
SETTINGS: dict[str, Any] = {
    "image_size": 64,
    "iterations": 4,
    "canonical": {"samples": 300, "sh_degree": 0},
    "skinning": {"resolution": 8, "neighbours": 4, "sweeps": 1},
    "resets": {"every": 0.0},
}


@pytest.fixture(scope="module")
def case() -> Case:
    torch.set_num_threads(1)
    return tiny_case()


def quiet(step: int, total: int, values: object) -> None:
    """Log nothing."""


def training(case: Case, config: GartConfig) -> GartTraining:
    generator = torch.Generator().manual_seed(0)
    values = surface_gaussians(case.prior, case.clip, None, config.canonical, generator)
    poses = prior_poses(case.prior, list(range(4)))
    model = GartModel(Gaussians(values, 0.05), ResidualField(case.prior, config.skinning), poses)
    return GartTraining(model, config, Supervision(case.clip, case.prior, 64, CPU), generator)


def test_the_table_starts_at_the_given_poses(case: Case) -> None:
    table = prior_poses(case.prior, [0, 1, 2, 3])
    for frame in range(4):
        quats, transforms = table(frame)
        torch.testing.assert_close(transforms, case.prior.transforms[frame], atol=1e-5, rtol=0)
        torch.testing.assert_close(quat_to_matrix(quats), case.prior.transforms[frame, :, :3, :3], atol=1e-5, rtol=0)
    # The fitted template is a true chain.
    assert table.offsets.abs().max() < 1e-5


def test_a_joint_that_hangs_loose_is_kept_so(case: Case) -> None:
    loose = case.prior.transforms.clone()
    loose[2, 9, :3, 3] += torch.tensor((0.1, -0.2, 0.3))
    table = pose_table(loose, case.prior.bones[:, 0], case.prior.parents)
    torch.testing.assert_close(table(2)[1], loose[2], atol=1e-5, rtol=0)
    assert table.offsets[2, 9].norm() > 0.3


def test_turning_a_joint_turns_all_below_it(case: Case) -> None:
    still = torch.eye(4).expand(1, 20, 4, 4)
    table = pose_table(still, case.prior.bones[:, 0], case.prior.parents)
    angles = torch.zeros(20, 3)
    angles[19], angles[18] = torch.tensor((0.5, 0.1, -0.2)), torch.tensor((-0.7, 0.0, 0.3))
    with torch.no_grad():
        table.turns[0] = angles
        table.shifts[0] = torch.tensor((0.0, 0.4, 0.0))
    expected = pose(angles, case.prior.bones[:, 0], PARENTS)
    expected[:, 1, 3] += 0.4
    torch.testing.assert_close(table(0)[1].detach(), expected, atol=1e-5, rtol=0)


def test_slerp_against_scipy() -> None:
    generator = torch.Generator().manual_seed(0)
    first, last = (torch.nn.functional.normalize(torch.randn(5, 4, generator=generator), dim=-1) for _ in range(2))
    for part in (0.0, 0.3, 1.0):
        for a, b, found in zip(first, last, slerp(first, last, part), strict=True):
            both = Rotation.from_quat(torch.stack((a, b))[:, [1, 2, 3, 0]].numpy())
            wanted = Slerp([0, 1], both)(part).as_matrix()
            np.testing.assert_allclose(quat_to_matrix(found).numpy(), wanted, atol=1e-5)
    torch.testing.assert_close(slerp(first, first, 0.5), first)


def test_between_frames_every_joint_is_half_way(case: Case) -> None:
    table = prior_poses(case.prior, [0, 1, 2, 3])
    joint = 10
    angle = [2 * math.acos(min(1.0, abs(float(table.quats[frame, joint, 0])))) for frame in (1, 2)]
    signs = [math.copysign(1, float(table.quats[frame, joint, 1] * table.quats[frame, joint, 0])) for frame in (1, 2)]
    middle = table.between(1.5)[0][joint]
    parent = table.between(1.5)[0][int(case.prior.parents[joint])]
    relative = quat_to_matrix(parent).T @ quat_to_matrix(middle)
    mean = (signs[0] * angle[0] + signs[1] * angle[1]) / 2
    expected = exponential_quats(torch.tensor((mean, 0.0, 0.0)))
    torch.testing.assert_close(relative, quat_to_matrix(expected), atol=1e-4, rtol=0)
    assert torch.equal(table.between(2.0)[1], table(2)[1])


def test_the_residual_adds_to_the_templates_weights(case: Case) -> None:
    field = ResidualField(case.prior, GartSkinning(resolution=8, neighbours=4, sweeps=1))
    points = case.prior.vertices[::40]
    base, variation = (value.detach() for value in field(points, True))
    torch.testing.assert_close(base.sum(-1), torch.ones(len(points)))
    assert float(variation) == 0 and float(field.norm().detach()) < 1e-7
    with torch.no_grad():
        field.residual[:, 3] = 0.25
    weights, variation = (value.detach() for value in field(points, True))
    expected = base.clone()
    expected[:, 3] += 0.25
    torch.testing.assert_close(weights, expected)
    # The same everywhere varies nowhere; its length is a quarter in every voxel.
    assert float(variation) == 0
    assert float(field.norm().detach()) == pytest.approx(0.25)
    # One voxel inside differs from its six neighbours: six of the 3 x 7 x 8 x 8 x 20 differences.
    with torch.no_grad():
        field.residual.zero_()
        field.residual[3 * 64 + 3 * 8 + 3, 5] = 0.5
    assert field(points, True)[1].item() == pytest.approx(6 * (0.5 - 1e-4 / 2) / (3 * 7 * 64 * 20), rel=1e-4)
    (slope,) = torch.autograd.grad(field(points, True)[1], field.residual)
    assert slope[3 * 64 + 3 * 8 + 3, 5] > 0


def test_spread_is_the_standard_deviation_among_neighbours() -> None:
    values = torch.tensor([[1.0], [2.0], [6.0]])
    near = torch.tensor([[0, 1, 2], [1, 0, 0]])
    deviations = [np.std((1, 2, 6), ddof=1), np.std((2, 1, 1), ddof=1)]
    assert float(spread(values, near)) == pytest.approx(sum(deviations) / 2)


def test_colours_are_alike_as_coefficients(case: Case) -> None:
    weights = {"quats": 0.0, "scales": 0.0, "opacities": 0.0, "small": 0.0, "colors": 1.0}
    settings = SETTINGS | {"canonical": {"samples": 300, "sh_degree": 1}, "regularisers": weights}
    made = training(case, msgspec.convert(settings, GartConfig))
    own = made.model.gaussians
    coefficients = 0.1 * torch.randn(len(own), 3, 3, generator=torch.Generator().manual_seed(0))
    with torch.no_grad():
        own.colors[:, 1:] = REST_GAIN * coefficients
    loss = float(made._alike()["alike"].detach())
    assert made.near is not None
    constant = own.colors[:, :1].detach() / C0
    assert loss == pytest.approx(
        float(spread(torch.cat((constant, coefficients), dim=1).flatten(1), made.near)), rel=1e-4
    )


def test_both_ways_of_skinning_agree(case: Case) -> None:
    made = training(case, msgspec.convert(SETTINGS, GartConfig)).model
    own = made.gaussians
    weights = made.field.still(own.means)
    quats, transforms = made.poses(2)
    shape = posed(own, weights, quats, transforms)
    rest = torch.nn.functional.normalize(own.quats, dim=-1)
    torch.testing.assert_close(shape.means, skin_points(own.means, weights, transforms), atol=1e-5, rtol=0)
    turned = skin_quats(rest, weights, quats)
    torch.testing.assert_close(quat_to_matrix(shape.quats), quat_to_matrix(turned), atol=1e-4, rtol=0)


def test_poses_and_skinning_wait_for_their_turn(case: Case) -> None:
    made = training(case, msgspec.convert(SETTINGS, GartConfig))
    assert made.rate("turns", 0.0499) == 0 and made.rate("turns", 0.05) == 1e-4
    assert made.rate("shifts", 0.5) == pytest.approx(5e-4)
    assert made.rate("skinning", 0.1999) == 0 and made.rate("skinning", 0.2) == pytest.approx(1e-4)
    assert made.rate("skinning", 1.0) == pytest.approx(1e-5)


def test_a_resumed_fit_keeps_its_neighbours(case: Case) -> None:
    """They are looked up when the set of Gaussians changes; places move on, and a resumed fit must not look again."""
    config = msgspec.convert(SETTINGS | {"density": {"end": 0.0}}, GartConfig)
    made = training(case, config)
    made.step(0)
    before, state = made.near, made.state()
    with torch.no_grad():
        made.gaussians.means.copy_(made.gaussians.means.flip(0).roll(1, 1))
    other = training(case, config)
    other.restore(state | {"model": made.model.state_dict()})
    other.step(1)
    assert before is not None and other.near is not None and torch.equal(other.near, before)


def test_refinement_moves_one_frame_back(case: Case) -> None:
    """From an animal moved away, SGD on the frame's own image brings it nearer; the other frames stay."""
    settings = SETTINGS | {"iterations": 0, "refine": {"steps": 40, "rate": 0.05}}
    made = training(case, msgspec.convert(settings, GartStarConfig))
    table = made.model.poses
    with torch.no_grad():
        table.shifts[1, 1] = 0.3
    losses = [made.step(40 + index)["loss"] for index in range(40)]
    assert made.total == 4 * 40
    assert losses[-1] < 0.7 * losses[0]
    assert float(table.shifts[1].detach().norm()) < 0.3 * 0.6
    assert table.turns[0].abs().max() == 0 and table.turns[2:].abs().max() == 0


def smal_arrays(prior: Prior) -> dict[str, np.ndarray]:
    """The prior's own template in SMAL's axes and units: x ahead, y left, z up."""
    back = torch.tensor((2, 0, 1))
    return {
        "vertices": (prior.vertices[:, back] * 0.3).double().numpy(),
        "faces": prior.faces.numpy(),
        "weights": prior.weights.double().numpy(),
        "joints": (prior.bones[:, 0][:, back] * 0.3).double().numpy(),
        "parents": prior.parents.numpy(),
    }


def test_the_priors_own_template_as_a_file_changes_nothing(case: Case, tmp_path: Path) -> None:
    np.savez(tmp_path / "own.npz", **smal_arrays(case.prior))
    found = template_prior(tmp_path / "own.npz", case.prior)
    torch.testing.assert_close(found.vertices, case.prior.vertices, atol=1e-4, rtol=0)
    moved, wanted = (skin_points(each.vertices, each.weights, each.transforms[1]) for each in (found, case.prior))
    assert float((moved - wanted).norm(dim=-1).mean()) < 0.02
    assert torch.equal(found.mirror, case.prior.mirror)


def test_follow_finds_a_chains_own_turns(case: Case) -> None:
    prior = case.prior
    hard = torch.nn.functional.one_hot(prior.weights.argmax(-1), 20).float()
    moved = skin_points(prior.vertices, hard, prior.transforms)
    found = follow(prior.vertices, moved, hard, prior.bones[:, 0], list(PARENTS))
    torch.testing.assert_close(found, prior.transforms, atol=1e-3, rtol=0)


class chumpy_like:
    """Pickles as chumpy.ch.Ch does."""


def as_smal_pickle(arrays: dict[str, np.ndarray], path: Path, extra: Any = None) -> None:
    """What SMAL's files hold, chumpy's variables by their module's name."""
    count = len(arrays["vertices"])
    regressor = sparse.csc_matrix(arrays["joints"] @ np.linalg.pinv(arrays["vertices"]))
    assert regressor.shape == (len(arrays["joints"]), count)
    parents = arrays["parents"].astype(np.int64)
    table = np.stack((np.where(parents < 0, 2**32 - 1, parents), np.arange(len(parents))))
    content = {
        "v_template": arrays["vertices"], "f": arrays["faces"].astype(np.uint32), "weights": arrays["weights"],
        "J_regressor": regressor, "kintree_table": table, "posedirs": np.zeros((2, 3, 4)), "bs_style": "lbs",
    }  # fmt: skip
    if extra is not None:
        content["extra"] = extra
    path.write_bytes(pickle.dumps(content, protocol=2))


def test_a_smal_pickle_is_read(case: Case, tmp_path: Path) -> None:
    arrays = smal_arrays(case.prior)
    as_smal_pickle(arrays, tmp_path / "smal.pkl")
    np.savez(tmp_path / "smal.npz", **arrays)
    first, second = (template_prior(tmp_path / name, case.prior) for name in ("smal.pkl", "smal.npz"))
    torch.testing.assert_close(first.vertices, second.vertices)
    torch.testing.assert_close(first.bones, second.bones, atol=1e-4, rtol=0)
    assert torch.equal(first.parents, second.parents)


def test_a_chumpy_variable_gives_its_value(case: Case, tmp_path: Path) -> None:
    arrays = smal_arrays(case.prior)
    as_smal_pickle(arrays, tmp_path / "plain.pkl")
    content = pickle.loads((tmp_path / "plain.pkl").read_bytes())
    variable = chumpy_like()
    variable.__dict__["x"] = content["v_template"]
    raw = pickle.dumps(content | {"v_template": variable}, protocol=2)
    raw = raw.replace(f"c{__name__}\nchumpy_like\n".encode(), b"cchumpy.ch\nCh\n")
    (tmp_path / "chumpy.pkl").write_bytes(raw)
    first, second = (template_prior(tmp_path / name, case.prior) for name in ("plain.pkl", "chumpy.pkl"))
    assert torch.equal(first.vertices, second.vertices)


class Harmful:
    """Would run a command when it is opened."""

    def __reduce__(self) -> tuple[Any, ...]:
        return __import__("os").system, ("touch /tmp/should-not-be-here",)


def test_bad_files_get_one_sentence(case: Case, tmp_path: Path) -> None:
    arrays = smal_arrays(case.prior)

    def said(name: str) -> str:
        with pytest.raises(UserError) as caught:
            template_prior(tmp_path / name, case.prior)
        return str(caught.value)

    assert "absent.pkl: expected a D-SMAL file (npz or SMAL pickle), but there is no such file" in said("absent.pkl")
    as_smal_pickle(arrays, tmp_path / "harm.pkl", Harmful())
    assert "it holds a posix.system, which is not let through" in said("harm.pkl")
    (tmp_path / "junk.pkl").write_bytes(b"junk")
    assert "cannot be read" in said("junk.pkl")
    (tmp_path / "list.pkl").write_bytes(pickle.dumps([1, 2], protocol=2))
    assert "expected a SMAL pickle that holds a dictionary, got a list" in said("list.pkl")
    np.savez(tmp_path / "part.npz", **{name: value for name, value in arrays.items() if name != "weights"})
    assert "but weights is not in it (faces, joints, parents, vertices)" in said("part.npz")
    np.savez(tmp_path / "wide.npz", **(arrays | {"weights": arrays["weights"][:, :7]}))
    assert f"expected 'weights' of shape [{len(arrays['vertices'])}, 20]" in said("wide.npz")
    np.savez(tmp_path / "far.npz", **(arrays | {"faces": arrays["faces"] + 10**6}))
    assert "expected 'faces' between 0 and" in said("far.npz")
    cycle = arrays["parents"].copy()
    cycle[3] = 2
    np.savez(tmp_path / "cycle.npz", **(arrays | {"parents": cycle}))
    assert "expected 'parents' to form a tree" in said("cycle.npz")


def test_a_fit_on_a_template_file(case: Case, tmp_path: Path) -> None:
    arrays = smal_arrays(case.prior)
    np.savez(tmp_path / "dog.npz", **arrays)
    config = msgspec.convert(SETTINGS | {"template": str(tmp_path / "dog.npz")}, GartConfig)
    made = Gart().fit(case.clip, case.prior, config=config, seed=0, device=CPU, log=quiet, workdir=None)
    other = replace(case.prior, transforms=case.prior.transforms)
    plain = Gart().fit(
        case.clip, other, config=msgspec.convert(SETTINGS, GartConfig), seed=0, device=CPU, log=quiet, workdir=None
    )
    assert made.weights.shape[1] == 20
    assert float((made.at(0.1).means.mean(0) - plain.at(0.1).means.mean(0)).norm()) < 0.05
    assert matrix_to_quat(torch.eye(3))[0] == 1


def test_the_variation_in_double_precision_is_the_kernels(case: Case) -> None:
    """Where the kernel does not compute (double precision, a GPU), the same value and the same slopes."""
    single = ResidualField(case.prior, GartSkinning(resolution=8, neighbours=4, sweeps=1))
    with torch.no_grad():
        single.residual.normal_(0, 1e-3, generator=torch.Generator().manual_seed(0))
    double = copy.deepcopy(single).double()
    points = case.prior.vertices[::40]
    found = [field(points.to(field.residual), True)[1] for field in (single, double)]
    torch.testing.assert_close(found[0].double(), found[1], atol=0, rtol=1e-5)
    slopes = torch.autograd.grad(found, (single.residual, double.residual))
    torch.testing.assert_close(*slopes, atol=1e-9, rtol=1e-4, check_dtype=False)


def test_skinning_that_does_not_learn_stays(case: Case) -> None:
    for learn in (True, False):
        settings = SETTINGS | {"skinning": SETTINGS["skinning"] | {"learn": learn}, "poses": {"skinning_start": 0.0}}
        made = training(case, msgspec.convert(settings, GartConfig))
        made.step(0)
        assert bool(made.model.field.residual.any()) == learn
