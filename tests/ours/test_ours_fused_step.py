"""The small kernels of a training step against torch: Adam, clipping, softmax, normals, scales, what a view tells."""

import math

import pytest
import torch
from torch import Tensor, nn
from twins import check_twins, leaves, normal, same_on_any_threads

from rewild4d.ours.adam import Adam
from rewild4d.ours.canonical import NAMES, Gaussians
from rewild4d.ours.config import Density
from rewild4d.ours.density import DensityControl
from rewild4d.ours.gradients import all_finite, clip_gradients
from rewild4d.ours.losses.images import union_window
from rewild4d.ours.losses.regularizers import _disagreement, _normals
from rewild4d.ours.skinning import SkinningField
from rewild4d.rasterizer import RasterInfo

SHAPES = ((40_000, 3), (5,), (), (33, 7), (2, 1, 3))
"""The first takes several chunks and threads."""


def optimizers(dtype: torch.dtype = torch.float32) -> tuple[torch.optim.Adam, Adam]:
    """Torch's and ours over the same values, in two groups."""
    made = []
    for kind, more in ((torch.optim.Adam, {"fused": True}), (Adam, {})):
        values = [nn.Parameter(normal(*shape, seed=i).to(dtype)) for i, shape in enumerate(SHAPES)]
        groups = [{"params": values[:2], "lr": 1e-2, "eps": 1e-15}, {"params": values[2:], "betas": (0.8, 0.99)}]
        made.append(kind(groups, lr=3e-3, **more))
    return made[0], made[1]


def values(optimizer: torch.optim.Optimizer) -> list[nn.Parameter]:
    return [parameter for group in optimizer.param_groups for parameter in group["params"]]


def move(optimizer: torch.optim.Optimizer, steps: range) -> None:
    """Steps with gradients of many sizes; the second tensor has none in every third step, and a rate changes."""
    for step in steps:
        optimizer.zero_grad(set_to_none=True)
        for i, parameter in enumerate(values(optimizer)):
            if i != 1 or step % 3:
                parameter.grad = (10.0 ** (-i) * normal(*parameter.shape, seed=100 * step + i)).to(parameter)
        optimizer.param_groups[0]["lr"] = 1e-2 / (1 + step)
        optimizer.step()


def check_same(wanted: torch.optim.Optimizer, got: torch.optim.Optimizer) -> None:
    for a, b in zip(values(wanted), values(got), strict=True):
        pairs = [(a, b), *((wanted.state[a][name], got.state[b][name]) for name in ("exp_avg", "exp_avg_sq", "step"))]
        assert all((x - y).norm() <= 1e-6 * x.norm() for x, y in pairs)


def test_adam_is_torchs() -> None:
    wanted, got = optimizers()
    for each in (wanted, got):
        move(each, range(60))
    check_same(wanted, got)
    assert [float(got.state[each]["step"]) for each in values(got)] == [60, 40, 60, 60, 60]


def test_adam_and_torchs_continue_each_other() -> None:
    wanted, got = optimizers()
    for each in (wanted, got):
        move(each, range(5))
    kept, other = wanted.state_dict(), got.state_dict()
    wanted.load_state_dict(other)
    got.load_state_dict(kept)
    for each in (wanted, got):
        move(each, range(5, 20))
    check_same(wanted, got)


def test_adam_in_double_precision_is_torchs() -> None:
    wanted, got = optimizers(torch.float64)
    for each in (wanted, got):
        move(each, range(5))
    assert all(torch.equal(a, b) for a, b in zip(values(wanted), values(got), strict=True))


def test_adam_is_the_same_bits_for_any_number_of_threads() -> None:
    def make() -> list[Tensor]:
        _, own = optimizers()
        move(own, range(3))
        return values(own)

    same_on_any_threads(make)


def test_adam_refuses_a_state_of_another_size() -> None:
    parameter = nn.Parameter(torch.zeros(4))
    own = Adam([parameter])
    parameter.grad = torch.ones(4)
    own.step()
    own.state[parameter]["exp_avg"] = torch.zeros(3)
    with pytest.raises(ValueError, match=r"^Adam's state is of \[3\], the parameter of \[4\]\.$"):
        own.step()


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("bad", [math.inf, -math.inf, math.nan])
@pytest.mark.parametrize("place", [0, 70, 200_000, 299_999])
def test_a_gradient_that_is_not_finite_is_found(bad: float, place: int, dtype: torch.dtype) -> None:
    parameters = [nn.Parameter(torch.zeros(count, dtype=dtype)) for count in (0, 7, 300_000)]
    for parameter in parameters:
        parameter.grad = torch.full_like(parameter, 1e30)
    assert all_finite(parameters)
    parameters[2].grad[place] = bad
    assert not all_finite(parameters)
    assert not math.isfinite(clip_gradients(parameters, 1.0))


@pytest.mark.parametrize("joints", [1, 5, 16, 20, 35])
@pytest.mark.parametrize("tied", [False, True])
def test_probabilities_of_the_field(joints: int, tied: bool) -> None:
    mirror = torch.arange(joints).flip(0)
    # Rows far apart and entries far apart: neither may overflow, and what is nothing stays finite.
    logits = normal(11**3, joints, seed=1) * 3 + 1e3 * normal(11**3, 1, seed=2)
    logits[::7, 0] -= 500

    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        field = SkinningField(logits, torch.zeros(3), torch.ones(3), mirror, tied).to(dtype)
        return [field.probabilities()], {"logits": field.logits}

    check_twins(make)


@pytest.mark.parametrize("place", [0, 9, 17])
def test_what_is_not_a_number_stays_visible(place: int) -> None:
    rows = torch.zeros(3, 18)
    rows[1, place] = math.nan
    field = SkinningField(rows, torch.zeros(3), torch.ones(3), torch.arange(18), False)
    assert field.probabilities()[:, place].isnan().tolist() == [False, True, False]
    own = Gaussians({name: torch.zeros(3, 3) for name in NAMES}, 1.0)
    assert torch.equal(own.scales(rows).isnan(), rows.isnan())


def test_normals() -> None:
    quats, log_scales = normal(1100, 4, seed=1), normal(1100, 3, seed=2)
    log_scales[:5] = 0  # the first of equals
    means, eye = normal(1100, 3, seed=3), torch.tensor((1.0, 2.0, -3.0))

    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        given = leaves(dtype, quats=quats)
        return [_normals(given["quats"], log_scales.to(dtype), means.to(dtype), eye.to(dtype))], given

    check_twins(make)


@pytest.mark.parametrize(("height", "width"), [(40, 37), (17, 32), (2, 1), (1, 50)])
def test_disagreement_of_neighbours(height: int, width: int) -> None:
    covered = (normal(height, width, seed=1) > 0) * normal(height, width, seed=2).sigmoid()

    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        image = normal(3, height, width, seed=3) + torch.tensor((1.0, 0.0, 2.0))[:, None, None]
        given = leaves(dtype, image=image * (covered > 0))
        return [_disagreement(given["image"], covered.to(dtype))[None]], given

    check_twins(make)


@pytest.mark.parametrize("blur", [0.0, 0.02])
def test_scales(blur: float) -> None:
    def make(dtype: torch.dtype) -> tuple[list[Tensor], dict[str, Tensor]]:
        own = Gaussians({name: torch.zeros(3, 3) for name in NAMES}, 1.0).to(dtype)
        own.blur.fill_(blur)
        given = leaves(dtype, log_scales=2 * normal(333, 3, seed=1) - 4)
        return [own.scales(given["log_scales"])], given

    check_twins(make)


def test_what_densification_collects() -> None:
    found = []
    for dtype in (torch.float64, torch.float32):
        control = DensityControl(Density(), 100, torch.device("cpu"))
        for part in ("gradient", "seen", "radius"):
            setattr(control, part, getattr(control, part).to(dtype))
        for view in range(3):
            centers = normal(1, 100, 2, seed=view).to(dtype)
            centers.grad = normal(1, 100, 2, seed=10 + view).to(dtype)
            control.observe(RasterInfo(normal(1, 100, seed=20 + view).to(dtype).clamp_min(0), centers), 50.5, 640)
        found.append([control.gradient, control.seen, control.radius])
    for wanted, got in zip(*found, strict=True):
        torch.testing.assert_close(got.double(), wanted, rtol=1e-6, atol=0)
    assert found[1][1].unique().tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize("places", [[(3, 5)], [(3, 5), (19, 0)], [(0, 0)], [(29, 36)], []])
def test_windows_of_both_twins(places: list[tuple[int, int]]) -> None:
    mattes = [torch.zeros(1, 30, 37), torch.zeros(1, 30, 37)]
    for i, (y, x) in enumerate(places):
        mattes[i % 2][0, y, x] = 1e-6
    own = union_window(mattes, 4)
    assert own == union_window([matte.double() for matte in mattes], 4)
    rows, columns = ([place[axis] for place in places] or [0] for axis in (0, 1))
    assert own == (
        slice(max(0, min(rows) - 4), min(30, max(rows) + 5)),
        slice(max(0, min(columns) - 4), min(37, max(columns) + 5)),
    )
