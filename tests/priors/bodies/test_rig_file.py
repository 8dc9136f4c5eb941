"""A rig file as a template: the package's quadruped, written as a rig, is read back with what its clip says."""

from pathlib import Path

import numpy as np
import pytest
import torch
from rig_files import save_template

from rewild4d.errors import UserError
from rewild4d.priors.bodies.body import Proportions, diagonal
from rewild4d.priors.bodies.covering import balls, squares
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.bodies.rig_file import LEAST_SPREAD, ROOM, read_body
from rewild4d.priors.bodies.rigged import GIRTH_SPREAD, LENGTH_SPREAD, RiggedBody
from rewild4d.priors.kinematics import pose
from rewild4d.transforms import mirror_points

WAVE = np.sin(np.linspace(0, 2 * np.pi, 25))
TOP, FOOT, HEAD = 13, 11, 0
"""Bones of the quadruped: the top and the last of the left rear leg, the head."""


def numbers(body: RiggedBody) -> dict[int, int]:
    """Bone of the body by the number that it has in the quadruped."""
    return {int(name.removeprefix("bone_")): bone for bone, name in enumerate(body.bone_names)}


@pytest.fixture(scope="module")
def swinging(tmp_path_factory: pytest.TempPathFactory) -> RiggedBody:
    """The left rear leg swings by 0.4 radians, the head around 0.3."""
    path = tmp_path_factory.mktemp("rigs") / "dog.glb"
    return read_body(save_template(path, QUADRUPED.build(), {TOP: 0.4 * WAVE, HEAD: 0.3 + 0.1 * WAVE}, yaw=0.6))


def test_skeleton_and_symmetry_come_back(swinging: RiggedBody) -> None:
    at = numbers(swinging)
    assert sorted(at) == list(range(20)) and swinging.name == "dog.glb"
    for bone, parent in enumerate(QUADRUPED.parents):
        assert swinging.parents[at[bone]] == (-1 if parent < 0 else at[parent]) or bone in (3, 7)
        assert swinging.mirror[at[bone]] == at[QUADRUPED.mirror[bone]]
    assert {at[bone] for bone in QUADRUPED.feet} == set(swinging.feet)


def test_the_mean_pose_is_the_rest_in_the_object_frame(swinging: RiggedBody) -> None:
    at, template = numbers(swinging), QUADRUPED.build()
    angles = torch.zeros(20, 3)
    angles[HEAD, 0] = 0.3
    posed = pose(angles, template.bones[:, 0], template.parents)
    found = swinging.build().bones[[at[bone] for bone in range(20)]]
    wanted = (posed[:, None, :3, :3] @ template.bones[..., None])[..., 0] + posed[:, None, :3, 3]
    shift = (found[:, 0] - wanted[:, 0]).mean(0)
    assert (found[:, 0] - wanted[:, 0] - shift).abs().max() < 0.05
    assert abs(float(shift[0])) < 0.02
    assert torch.allclose(mirror_points(found), found[list(QUADRUPED.mirror)], atol=0.02)


def test_limits_are_the_clips(swinging: RiggedBody) -> None:
    """A sine of 0.4 has a root mean square of 0.4 / sqrt(2); half of the frames are those of the mirror image."""
    at = numbers(swinging)
    leg = swinging.spreads[at[TOP]]
    assert float(leg[0]) == pytest.approx(ROOM * 0.4 / 2, rel=0.1)
    assert torch.equal(leg, swinging.spreads[at[QUADRUPED.mirror[TOP]]])
    assert float(swinging.spreads[at[HEAD], 0]) == pytest.approx(ROOM * 0.1 / 2**0.5, rel=0.1)
    assert float(swinging.spreads[at[1]].max()) == pytest.approx(LEAST_SPREAD)
    assert bool((swinging.limits >= swinging.spreads).all())


def test_a_foot_that_hangs_from_the_root_is_hung_from_its_leg(tmp_path: Path) -> None:
    """As files have it whose feet a solver moves: the foot's translation follows the leg."""
    template = QUADRUPED.build()
    angles = torch.zeros(25, 20, 3)
    angles[:, TOP, 0] = torch.from_numpy(0.4 * WAVE)
    moved = pose(angles, template.bones[:, 0].expand(25, -1, -1), template.parents)[:, FOOT]
    track = ((moved[..., :3, :3] @ template.bones[FOOT, 0, :, None])[..., 0] + moved[..., :3, 3]).numpy()
    swings = {TOP: 0.4 * WAVE, FOOT: 0.4 * WAVE}
    body = read_body(save_template(tmp_path / "ik.glb", template, swings, hung={FOOT: -1}, shifts={FOOT: track}))
    at = numbers(body)
    assert body.parents[at[FOOT]] == at[FOOT + 1] and body.parents[at[14]] == at[15]


def test_a_longer_thigh_moves_the_shank_and_a_thicker_one_does_not(swinging: RiggedBody) -> None:
    at, rest = numbers(swinging), swinging.build(unit=False)
    pair, pairs = swinging.pairs[at[TOP]], swinging.measures // 2
    assert swinging.pairs[at[QUADRUPED.mirror[TOP]]] == pair
    long, thick = (Proportions(torch.zeros(swinging.measures)) for _ in range(2))
    long.deviations[pair], thick.deviations[pairs + pair] = 1.0, 1.0
    longer, thicker = swinging.build(long, unit=False), swinging.build(thick, unit=False)

    def length(bones: torch.Tensor, bone: int) -> float:
        return float((bones[at[bone], 1] - bones[at[bone], 0]).norm())

    stretch = float(np.exp(LENGTH_SPREAD))
    assert length(longer.bones, TOP) == pytest.approx(stretch * length(rest.bones, TOP), rel=1e-4)
    assert length(longer.bones, FOOT) == pytest.approx(length(rest.bones, FOOT), rel=1e-4)
    step = rest.bones[at[TOP], 1] - rest.bones[at[TOP], 0]
    assert torch.allclose(longer.bones[at[FOOT]], rest.bones[at[FOOT]] + (stretch - 1) * step, atol=1e-4)
    assert torch.allclose(thicker.bones, rest.bones, atol=1e-4)
    own = rest.blob_weights[:, at[TOP]] > 0.99
    assert torch.allclose(thicker.blob_sizes[own], float(np.exp(GIRTH_SPREAD)) * rest.blob_sizes[own], rtol=0.01)
    assert float(diagonal(swinging.build().vertices)) == pytest.approx(5.0, abs=1e-4)


def test_a_batch_is_its_rows(swinging: RiggedBody) -> None:
    shapes = torch.randn(2, swinging.measures, generator=torch.Generator().manual_seed(0))
    both = swinging.build(Proportions(shapes))
    for row, shape in enumerate(shapes):
        one = swinging.build(Proportions(shape))
        for name in ("vertices", "bones", "blobs", "blob_sizes", "cover"):
            assert torch.allclose(getattr(both, name)[row], getattr(one, name), atol=1e-5), name


def test_a_rig_without_clips_is_one_sentence(tmp_path: Path) -> None:
    path = save_template(tmp_path / "still.glb", QUADRUPED.build(), {})
    with pytest.raises(UserError, match="still.glb: expected a rig with at least one clip, which says how its joints"):
        read_body(path)


def test_balls_in_a_ball_and_squares_on_it() -> None:
    """In a ball of radius 2 the largest ball has radius 2; squares share its area, a little overlapped."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(1500, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    assert np.allclose(balls(2 * normals, normals), 2.0, rtol=0.01)
    corners = squares(2 * normals, normals, 4 * np.pi * 2**2)
    side = np.linalg.norm(corners[:, 1] - corners[:, 0], axis=1)
    assert np.allclose(side, 1.15 * np.sqrt(4 * np.pi * 2**2 / 1500))
    assert np.allclose(np.einsum("na,nka->nk", normals, corners), 2.0)
