"""Every fused kernel against its plain torch twin in double precision: values, and the gradient of every input."""

import pytest
import torch
from torch import Tensor
from twins import Make, check_twins, leaves, normal, same_on_any_threads, unit

from rewild4d.kernels.halves import available
from rewild4d.ours.canonical import Gaussians, Posed
from rewild4d.ours.config import Config, Deform, Skinning
from rewild4d.ours.deform import DeformNetwork
from rewild4d.ours.fused.harmonics import seen_rgb
from rewild4d.ours.fused.skinning import skin_both
from rewild4d.ours.losses.config import Loss
from rewild4d.ours.losses.images import colour_losses, silhouette_loss, union_window
from rewild4d.ours.losses.regularizers import compact_loss
from rewild4d.ours.model import Model
from rewild4d.ours.pose import joint_transforms
from rewild4d.ours.skinning import SkinningField, build_field
from rewild4d.ours.symmetry import Target
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.bodies.tetrapod import MIRROR, PARENTS
from rewild4d.types import Camera


def deformation(count: int, config: Deform, mixed: bool = True, spread: float = 0.3) -> Make:
    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        network = DeformNetwork(8 if mixed else 20, 24, config, torch.Generator().manual_seed(0))
        for i, layer in enumerate(network.children()):
            generator = torch.Generator().manual_seed(i)
            torch.nn.init.normal_(layer.weight, std=spread, generator=generator)
            torch.nn.init.normal_(layer.bias, std=spread, generator=generator)
        network.to(dtype)
        given = leaves(
            dtype,
            features=normal(20, 24, seed=1),
            anchors=normal(20, 8, seed=2),
            means=2 * normal(count, 3, seed=3),
            quats=unit(count, 4, seed=4),
            log_scales=normal(count, 3, seed=5) - 3,
        )
        posed = Posed(given["means"], given["quats"], given["log_scales"])
        weights = normal(count, 20, seed=6).softmax(-1).to(dtype)
        moved = network(given["features"], weights, given["anchors"] if mixed else None, posed, 0.7)
        return list(moved), given | dict(network.named_parameters())

    return make


@pytest.mark.parametrize(("count", "width", "heads"), [(1, 16, 2), (150, 32, 4), (96, 48, 4)])
@pytest.mark.parametrize("mixed", [True, False])
def test_deformation(count: int, width: int, heads: int, mixed: bool) -> None:
    check_twins(deformation(count, Deform(width=width, heads=heads, half=False), mixed))


@pytest.mark.parametrize("frequencies", [0, 1])
def test_deformation_with_few_octaves(frequencies: int) -> None:
    check_twins(deformation(33, Deform(width=16, heads=2, frequencies=frequencies, half=False)))


@pytest.mark.skipif(not available(), reason="this CPU multiplies no bfloat16 pairs (AVX512_BF16)")
def test_deformation_in_bfloat16_is_the_same_to_its_rounding() -> None:
    make, grads, values = deformation(600, Deform(width=32), spread=0.15), [], []
    for dtype in (torch.float64, torch.float32):
        (means, quats, log_scales), given = make(dtype)
        moves = torch.cat((means - given["means"], quats - given["quats"], log_scales - given["log_scales"]), dim=1)
        moves.square().sum().backward()
        values.append(moves.double())
        grads.append(torch.cat([each.grad.flatten().double() for each in given.values() if each.grad is not None]))
    # A factor keeps eight bits, and six layers follow each other.
    assert (values[0] - values[1]).norm() < 6 / 256 * values[0].norm()
    assert (grads[0] - grads[1]).norm() < 6 / 256 * grads[0].norm()


def test_deformation_is_the_same_bits_for_any_number_of_threads() -> None:
    network = DeformNetwork(8, 24, Deform(width=16), torch.Generator().manual_seed(0))
    torch.nn.init.normal_(network.out.weight, generator=torch.Generator().manual_seed(1))
    posed = Posed(normal(5000, 3, seed=1).float(), unit(5000, 4, seed=2).float(), normal(5000, 3, seed=3).float())

    def make() -> list[Tensor]:
        network.zero_grad()
        weights = normal(5000, 20, seed=5).float().softmax(-1)
        moved = network(normal(20, 24, seed=4).float(), weights, normal(20, 8, seed=6).float(), posed, 1.0)
        (moved.means.square().sum() + moved.quats[:, 0].sum()).backward()
        return [*moved, network.up.weight.grad, network.query.weight.grad]

    same_on_any_threads(make)


def matte(height: int, width: int, center: tuple[float, float], radius: float) -> Tensor:
    """A soft disc, exactly 0 far outside and 0.99 inside, [1, h, w]."""
    rows, columns = torch.meshgrid(torch.arange(height).double(), torch.arange(width).double(), indexing="ij")
    distance = ((rows - center[0]).square() + (columns - center[1]).square()).sqrt()
    return (0.5 + (radius - distance) / 6).clamp(0, 0.99)[None]


@pytest.mark.parametrize(
    ("height", "width", "center", "radius"),
    [(70, 90, (33.0, 47.0), 14.0), (40, 35, (3.0, 30.0), 12.0), (30, 17, (15.0, 8.0), 40.0)],
)
def test_image_losses(height: int, width: int, center: tuple[float, float], radius: float) -> None:
    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        mask = matte(height, width, center, radius)
        alpha = matte(height, width, (center[0] + 2, center[1] - 3), 0.9 * radius)
        colours = [torch.rand(3, height, width, generator=torch.Generator().manual_seed(i)).double() for i in (1, 2)]
        camera = Camera(torch.eye(4), torch.eye(3), width, height)
        target = Target((colours[0] * mask).to(dtype), mask.to(dtype), camera, 1.3 * radius)
        given = leaves(dtype, rgb=colours[1] * alpha, alpha=alpha)
        window = union_window([given["alpha"], target.mask], 10)
        background = torch.tensor((0.2, 0.9, 0.5), dtype=dtype)
        losses = [*colour_losses(given["rgb"], given["alpha"], target, background, window)]
        return [*losses, silhouette_loss(given["alpha"], target, window)], given

    check_twins(make)


@pytest.fixture(scope="module")
def field() -> SkinningField:
    template = QUADRUPED.build()
    return build_field(template.vertices, template.weights, torch.tensor(MIRROR), Skinning(resolution=9, sweeps=1))


def test_sampled_skinning_weights(field: SkinningField) -> None:
    points = 2 * normal(1500, 3, seed=1)  # some lie outside the cube

    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        given = leaves(dtype, table=unit(9**3, 20, seed=2))
        # The buffers' own precision decides the voxel, so both start from single precision.
        return [field.to(dtype).sample(given["table"], points.float().to(dtype))], given

    check_twins(make)


@pytest.mark.parametrize(("isolated", "spread"), [(True, 1.0), (False, 1.0), (True, 0.2)])
def test_skinning_of_both_branches(isolated: bool, spread: float) -> None:
    template, count = QUADRUPED.build(), 1300
    # Near the rest pose no rotation is opposed to another, which is a path of its own.
    quats = torch.nn.functional.normalize(unit(20, 4, seed=1) * spread + torch.eye(4)[0] * (1 - spread), dim=-1)
    assert bool((quats @ quats.T < 0).any()) == (spread == 1)
    weights = normal(count, 20, seed=3).mul(2).softmax(dim=-1)

    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        values = {
            "means": normal(count, 3, seed=4),
            "quats": normal(count, 4, seed=5),
            "log_scales": normal(count, 3, seed=6) - 4,
            "logit_opacities": normal(count, seed=7),
            "colors": normal(count, 1, 3, seed=8),
        }
        config = Config(deform=Deform(width=16), loss=Loss(isolated=isolated))
        generator = torch.Generator().manual_seed(0)
        grid = SkinningField(torch.zeros(8, 20), torch.zeros(3), torch.ones(3), torch.tensor(MIRROR), False)
        skeleton = template.bones[:, 0].float(), torch.tensor(PARENTS), torch.tensor(MIRROR)
        model = Model(config, Gaussians(values, 1.0), grid, *skeleton, generator).to(dtype)
        for name, value in values.items():
            getattr(model.gaussians, name).data = value.to(dtype)
        given = leaves(dtype, quats=quats, shifts=normal(20, 3, seed=2), weights=weights)
        transforms = joint_transforms(given["quats"], given["shifts"], model.pivots)
        branches = model.skin(given["weights"], given["quats"], transforms)
        own = {name: getattr(model.gaussians, name) for name in ("means", "quats", "log_scales")}
        return [tensor for branch in branches for tensor in branch], given | {f"own {k}": v for k, v in own.items()}

    check_twins(make)


def test_the_second_branch_does_not_reach_the_joints() -> None:
    given = leaves(torch.float32, means=normal(50, 3, seed=1), quats=unit(50, 4, seed=2))
    joints = leaves(torch.float32, transforms=normal(20, 4, 4, seed=3), quats=unit(20, 4, seed=4))
    weights = normal(50, 20, seed=5).softmax(dim=-1).float()
    for own, reached in ((slice(0, 2), True), (slice(2, 4), False)):
        made = skin_both(given["means"], given["quats"], weights, joints["transforms"], joints["quats"])[own]
        grads = torch.autograd.grad((made[0].sum() + made[1][:, 1].sum()), [*joints.values(), *given.values()])
        assert all((grad.abs().max() > 0) == reached for grad in grads[:2])
        assert all(grad.abs().max() > 0 for grad in grads[2:])


@pytest.mark.parametrize("degree", [1, 2, 3])
def test_seen_colours(degree: int) -> None:
    count = 1100

    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        values = {"means": torch.zeros(count, 3), "log_scales": torch.zeros(count, 3)}
        values |= {"quats": normal(count, 4, seed=1), "logit_opacities": torch.zeros(count)}
        values["colors"] = normal(count, 16, 3, seed=2) + 0.5
        own = Gaussians(values, 1.0).to(dtype)
        own.colors.data, own.quats.data = values["colors"].to(dtype), values["quats"].to(dtype)
        means, quats = normal(count, 3, seed=3).to(dtype), unit(count, 4, seed=4).to(dtype)
        eye = torch.tensor((1.0, -3.0, 7.0), dtype=torch.float64)
        return [own.seen_rgb(means, quats, eye, degree)], {"colors": own.colors}

    check_twins(make)


def test_seen_colours_of_no_gaussians_and_of_too_few_coefficients() -> None:
    none = [torch.zeros(0, *shape, requires_grad=True) for shape in ((16, 3), (3,), (4,), (4,))]
    seen = seen_rgb(*none, torch.zeros(3), 3, 1.0)
    seen.sum().backward()
    assert seen.shape == (0, 3)
    assert none[0].grad is not None
    with pytest.raises(ValueError, match="expected 16 coefficients for degree 3, got 9"):
        seen_rgb(torch.zeros(2, 9, 3), *none[1:], torch.zeros(3), 3, 1.0)


def test_rows_in_any_order_of_memory() -> None:
    means, quats = normal(3, 70, seed=1).float(), unit(70, 4, seed=2).float()
    colors, eye = normal(70, 4, 3, seed=3).float(), torch.tensor((0.0, 0, 9))
    joints = normal(5, 4, 4, seed=4).float(), unit(5, 4, seed=5).float()
    weights = normal(70, 5, seed=6).softmax(dim=-1).float()
    turned = quats.T.contiguous().T
    made = skin_both(means.T, turned, weights, *joints)
    for a, b in zip(made, skin_both(means.T.contiguous(), quats, weights, *joints), strict=True):
        assert torch.equal(a, b)
    expected = seen_rgb(colors, means.T.contiguous(), quats, quats, eye, 1, 1.0)
    assert torch.equal(seen_rgb(colors, means.T, turned, turned, eye, 1, 1.0), expected)


def test_sampled_weights_with_the_total_variation(field: SkinningField) -> None:
    points = normal(300, 3, seed=1).float()

    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        given = leaves(dtype, table=normal(9**3, 20, seed=1).softmax(dim=-1))
        weights, variation = field.to(dtype).sample_and_vary(given["table"], points.to(dtype), 0.05)
        return [weights, 100 * variation[None]], given

    check_twins(make)


@pytest.mark.parametrize("alpha", [0.0, 2.0])
def test_compactness(alpha: float) -> None:
    weights = normal(1500, 20, seed=1).mul(3).softmax(dim=-1)
    weights[:, 7] = 0  # a part without mass

    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        stretch = torch.tensor((1.0, 2.0, 3.0))
        given = leaves(dtype, points=normal(1500, 3, seed=3) * stretch, others=normal(1500, 3, seed=4) / stretch)
        clouds = given["points"], given["others"]
        return [compact_loss(clouds, weights.to(dtype), alpha)[None]], given

    check_twins(make)
