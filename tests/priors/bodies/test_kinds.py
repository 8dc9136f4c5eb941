"""Every template of the package keeps what the fit asks of a body."""

import pytest
import torch

from rewild4d.errors import UserError
from rewild4d.priors.bodies.biped import BIPED, PRIMATE, Biped
from rewild4d.priors.bodies.body import Body, Proportions, diagonal
from rewild4d.priors.bodies.choice import KINDS, bodies
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.transforms import mirror_points


@pytest.fixture(params=[(body, size) for body in KINDS for size in (0.0, 0.7)], ids=lambda p: f"{p[0].name}-{p[1]}")
def drawn(request: pytest.FixtureRequest) -> tuple[Body, Proportions]:
    """The average animal of a kind, and a random one."""
    body, size = request.param
    generator = torch.Generator().manual_seed(3)
    return body, Proportions(size * torch.randn(body.measures, generator=generator))


def test_symmetric_in_the_units_and_axes_of_the_object_frame(drawn: tuple[Body, Proportions]) -> None:
    body, shape = drawn
    template, mirror = body.build(shape), torch.tensor(body.mirror)
    assert float(diagonal(template.vertices)) == pytest.approx(5.0, abs=1e-5)
    assert torch.allclose(mirror_points(template.bones), template.bones[mirror], atol=1e-5)
    nose, tail = template.bones[0, 1], template.bones[4, 1]
    assert nose[2] > tail[2]
    feet = template.bones[list(body.feet), 1, 1]
    assert bool((feet < template.bones[3, 0, 1]).all())
    assert float(template.vertices[:, 1].min()) > float(feet.min()) - 0.5


def test_closed_surfaces_that_face_outwards(drawn: tuple[Body, Proportions]) -> None:
    body, shape = drawn
    template = body.build(shape)
    edges = torch.cat([template.faces[:, [a, b]] for a, b in ((0, 1), (1, 2), (2, 0))]).tolist()
    directed = {tuple(edge) for edge in edges}
    assert len(directed) == len(edges) and all((b, a) in directed for a, b in directed)
    a, b, c = template.vertices[template.faces].unbind(1)
    volumes = (a * torch.linalg.cross(b, c)).sum(1) / 6
    trunk, limb = 2 * 47 * 16 + 32, 2 * 15 * 10 + 20
    assert all(float(part.sum()) > 0 for part in volumes.split([trunk, limb, limb, limb, limb]))


def test_every_measure_moves_the_surface_and_angles_have_room(drawn: tuple[Body, Proportions]) -> None:
    body, shape = drawn
    deviations = shape.deviations.requires_grad_()
    vertices = body.build(Proportions(deviations), unit=False).vertices
    probe = torch.randn(vertices.shape, generator=torch.Generator().manual_seed(0))
    (slope,) = torch.autograd.grad((vertices * probe).sum(), deviations)
    assert torch.isfinite(slope).all() and bool((slope.abs() > 1e-3).all())
    assert body.spreads.shape == body.limits.shape == (20, 3)
    assert bool((body.spreads >= 0).all()) and bool((body.limits > body.spreads).all())
    assert torch.equal(body.spreads, body.spreads[list(body.mirror)])


def test_a_trunk_that_rises_lifts_the_chest_about_its_middle() -> None:
    """The spine's joints turn about the origin by the angle, and the neck keeps its own."""
    level, risen = (
        BIPED.build(BIPED.proportions(body_pitch=pitch, chest_height=1e-6, hip_height=1e-6), unit=False).bones
        for pitch in (0.0, torch.pi / 2)
    )
    withers, hips = (3, 1), (6, 0)
    half = 1.15 / 2
    assert torch.allclose(level[withers], torch.tensor((0.0, 0.0, half)), atol=1e-5)
    assert torch.allclose(risen[withers], torch.tensor((0.0, half, 0.0)), atol=1e-5)
    assert torch.allclose(risen[hips], torch.tensor((0.0, -half, 0.0)), atol=1e-5)
    neck = [bones[2, 1] - bones[2, 0] for bones in (level, risen)]
    assert torch.allclose(neck[0], neck[1], atol=1e-5)


def test_a_primate_is_a_biped_of_other_proportions() -> None:
    assert isinstance(PRIMATE, Biped) and PRIMATE.table.keys() == BIPED.table.keys()
    reach = {
        body.name: float((body.build(unit=False).bones[8, 1] - body.build(unit=False).bones[10, 0]).norm())
        for body in (BIPED, PRIMATE)
    }
    assert reach["biped"] == pytest.approx(0.6, abs=1e-5) and reach["primate"] == pytest.approx(1.25, abs=1e-5)


def test_names() -> None:
    assert bodies("") == KINDS and bodies("biped") == (BIPED,) and bodies("quadruped") == (QUADRUPED,)
    known = r"unknown template 'bipe'.*Did you mean 'biped'\?"
    with pytest.raises(UserError, match=known):
        bodies("bipe")
