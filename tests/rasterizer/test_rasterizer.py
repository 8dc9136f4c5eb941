"""The rasterizer: reference against central differences, numba against the reference, closed forms and identities."""

import math
import multiprocessing
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from splats import NAMES, gradients, hard_scene, loss_weights, render, scene
from torch import Tensor
from twins import same_on_any_threads

from rewild4d.rasterizer import rasterize
from rewild4d.transforms import mirror_camera, mirror_points, mirror_quats
from rewild4d.types import Camera


@pytest.mark.parametrize("antialias", [False, True])
@pytest.mark.parametrize("name", NAMES)
def test_reference_gradient_is_the_central_difference(name: str, antialias: bool) -> None:
    # Few, faint and broad Gaussians: no pixel sits on one of the blend's cuts, where there is no derivative.
    inputs = scene(6, 2, 2, 12, 10, seed=3)
    inputs["scales"] += 0.4
    options = {"backend": "reference", "antialias": antialias}
    _, found = gradients(inputs, 12, 10, **options)
    generator = torch.Generator().manual_seed(1)
    direction = torch.randn(inputs[name].shape, generator=generator, dtype=torch.float64)
    if name == "intrinsics":
        direction *= torch.tensor([[1, 0, 1], [0, 1, 1], [0, 0, 0]])
    elif name == "world_to_camera":
        direction[:, 3] = 0
    step, values = 1e-6, []
    for sign in (1, -1):
        image, alpha, _ = render(inputs | {name: inputs[name] + sign * step * direction}, 12, 10, **options)
        on_image, on_alpha = loss_weights(image)
        values.append((image * on_image).sum() + (alpha * on_alpha).sum())
    expected = (values[0] - values[1]) / (2 * step)
    assert (found[name] * direction).sum().item() == pytest.approx(expected.item(), rel=1e-5)


@pytest.mark.parametrize(
    ("count", "channels", "views", "width", "height", "antialias"),
    [
        (300, 3, 1, 70, 50, False), (200, 1, 3, 33, 47, True), (200, 16, 2, 16, 16, False), (1, 5, 1, 20, 9, False),
        (7, 3, 2, 30, 20, True), (9, 3, 2, 30, 20, False), (1030, 2, 1, 24, 24, True),
    ],
)  # fmt: skip
def test_numba_equals_reference(
    count: int, channels: int, views: int, width: int, height: int, antialias: bool
) -> None:
    inputs = scene(count, channels, views, width, height, seed=count)
    check_against_reference(inputs, width, height, antialias=antialias)


@pytest.mark.parametrize("kind", ["needles", "sub-pixel", "behind", "opaque", "faint", "huge"])
def test_numba_equals_reference_on_hard_scenes(kind: str) -> None:
    check_against_reference(hard_scene(kind), 70, 50)


def check_against_reference(inputs: dict[str, Tensor], width: int, height: int, **options: bool) -> None:
    expected, wanted = gradients(inputs, width, height, backend="reference", **options)
    single = {name: tensor.float() for name, tensor in inputs.items()}
    image, found = gradients(single, width, height, backend="numba", **options)
    assert image.dtype == torch.float32
    error = (image - expected).square().mean().item()
    assert error <= 1e-7, f"PSNR {-10 * math.log10(error):.1f} dB"
    for name, gradient in wanted.items():
        relative = (found[name] - gradient).norm() / gradient.norm().clamp_min(1e-30)
        # A pixel may fall on the other side of a cut (alpha 1/255, transmittance 1e-4) in single precision.
        assert relative <= 1e-3, f"{name}: {relative:.1e}"


def test_gradients_agree_to_single_precision_where_no_pixel_is_on_a_cut() -> None:
    inputs = scene(60, 3, 2, 40, 32, seed=0)
    _, wanted = gradients(inputs, 40, 32, backend="reference")
    _, found = gradients({name: tensor.float() for name, tensor in inputs.items()}, 40, 32)
    for name, gradient in wanted.items():
        assert (found[name] - gradient).norm() <= 1e-5 * gradient.norm(), name


@pytest.mark.parametrize("backend", ["reference", "numba"])
def test_one_round_gaussian_is_its_closed_form(backend: str) -> None:
    focal, depth, sigma, opacity, eps2d = 50.0, 4.0, 0.3, 0.6, 0.3
    camera = torch.eye(4)[None]
    pinhole = torch.tensor([[[focal, 0, 8.5], [0, focal, 8.5], [0, 0, 1]]])
    image, alpha, info = rasterize(
        torch.tensor([[0.0, 0, depth]]), torch.tensor([[1.0, 0, 0, 0]]), torch.full((1, 3), sigma),
        torch.tensor([opacity]), torch.tensor([[2.0]]), camera, pinhole, 17, 17, background=torch.tensor([0.5]),
        eps2d=eps2d, backend=backend,
    )  # fmt: skip
    variance = (focal * sigma / depth) ** 2 + eps2d
    expected = opacity * math.exp(-0.5 * (3**2 + 2**2) / variance)  # pixel (11, 10) has its centre at (11.5, 10.5)
    assert alpha[0, 0, 10, 11].item() == pytest.approx(expected, rel=1e-5)
    assert image[0, 0, 10, 11].item() == pytest.approx(2 * expected + 0.5 * (1 - expected), rel=1e-5)
    assert info.means2d[0, 0].tolist() == pytest.approx([8.5, 8.5])
    assert info.radii[0, 0].item() == pytest.approx(math.sqrt(2 * math.log(255 * opacity) * variance), rel=1e-5)


@pytest.mark.parametrize("backend", ["reference", "numba"])
@pytest.mark.parametrize("empty", ["no Gaussian", "all behind"])
def test_an_empty_scene_is_the_background(backend: str, empty: str) -> None:
    count = 0 if empty == "no Gaussian" else 5
    inputs = {name: tensor.float() for name, tensor in scene(count, 3, 2, 20, 18, 0).items()}
    inputs["means"] = inputs["means"] - torch.tensor([0.0, 0, 100])
    leaves = {name: tensor.requires_grad_() for name, tensor in inputs.items()}
    image, alpha, info = render(leaves, 20, 18, backend=backend)
    image.sum().backward()
    assert torch.equal(image, inputs["background"][:, :, None, None].expand_as(image))
    assert alpha.abs().sum() == 0 and info.radii.abs().sum() == 0
    assert torch.equal(leaves["background"].grad, torch.full((2, 3), 20.0 * 18))


def single_run() -> list[Tensor]:
    """Image and gradients of a scene large enough to be shared among threads."""
    inputs = {name: tensor.float() for name, tensor in scene(3000, 3, 2, 96, 80, 5).items()}
    image, found = gradients(inputs, 96, 80)
    return [image, *found.values()]


def test_the_same_bits_for_any_number_of_threads() -> None:
    same_on_any_threads(single_run)


def test_more_threads_than_eights_of_gaussians() -> None:
    """Pieces of fewer than eight would be read and written from before the arrays' first element."""
    inputs = {name: tensor.float() for name, tensor in scene(60, 3, 10, 24, 20, 5).items()}

    def make() -> list[Tensor]:
        image, found = gradients(inputs, 24, 20)
        return [image, *found.values()]

    same_on_any_threads(make, (1, 16))


def test_threads_and_a_forked_child_give_the_same_bits() -> None:
    expected = single_run()
    with ThreadPoolExecutor(3) as pool:
        several = list(pool.map(lambda _: single_run(), range(3)))
    for found in several:
        assert all(torch.equal(a, b) for a, b in zip(expected, found, strict=True))
    context = multiprocessing.get_context("fork")
    queue = context.Queue()
    child = context.Process(target=lambda: queue.put(forward_only().numpy().tobytes()))
    child.start()
    assert queue.get(timeout=30) == forward_only().numpy().tobytes()
    child.join()


def forward_only() -> Tensor:
    inputs = {name: tensor.float() for name, tensor in scene(800, 3, 1, 64, 64, 5).items()}
    return render(inputs, 64, 64)[0]


def test_mirrored_gaussians_in_the_mirrored_camera_are_the_flipped_image() -> None:
    inputs = scene(80, 3, 1, 36, 24, 2)
    camera = Camera(inputs["world_to_camera"][0], inputs["intrinsics"][0], 36, 24)
    image = render(inputs, 36, 24)[0]
    seen = mirror_camera(camera)
    mirrored = inputs | {"means": mirror_points(inputs["means"]), "quats": mirror_quats(inputs["quats"])}
    mirrored |= {"world_to_camera": seen.world_to_camera[None], "intrinsics": seen.intrinsics[None]}
    assert torch.allclose(render(mirrored, 36, 24)[0], image.flip(-1), atol=1e-10)
    single = {name: tensor.float() for name, tensor in mirrored.items()}
    assert torch.allclose(render(single, 36, 24)[0].double(), image.flip(-1), atol=1e-2)


@pytest.mark.parametrize("channels", [3, 5])
def test_features_alone_have_the_gradient_that_they_have_among_others(channels: int) -> None:
    inputs = {name: tensor.float() for name, tensor in scene(120, channels, 2, 40, 30, seed=7).items()}
    _, wanted = gradients(inputs, 40, 30, backend="numba")
    features = inputs["features"].clone().requires_grad_()
    image, alpha, _ = render(inputs | {"features": features}, 40, 30, backend="numba")
    on_image, on_alpha = (weights.to(image) for weights in loss_weights(image))
    ((image * on_image).sum() + (alpha * on_alpha).sum()).backward()
    assert torch.equal(features.grad, wanted["features"])


def test_features_without_background_are_premultiplied() -> None:
    inputs = {name: tensor.float() for name, tensor in scene(50, 1, 1, 30, 30, 0).items()}
    inputs["features"] = torch.ones(50, 1)
    image, alpha, _ = rasterize(*(inputs[name] for name in NAMES[:-1]), 30, 30)
    assert torch.allclose(image, alpha, atol=1e-6)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("means", torch.zeros(4, 2), r"means: expected shape \[4, 3\], got \[4, 2\]"),
        ("quats", torch.zeros(3, 4), r"quats: expected shape \[4, 4\], got \[3, 4\]"),
        ("features", torch.zeros(4), r"features: expected shape \[4, C\] with C >= 1, got \[4\]"),
        ("scales", torch.zeros(4, 3).double(), r"scales: expected torch.float32 on cpu .*, got torch.float64"),
        ("opacities", torch.tensor([0.5, 0.5, math.nan, 0.5]), r"opacities: .* finite values, got nan at index \[2\]"),
        ("means", torch.full((4, 3), math.inf), r"means: expected finite values, got inf at index \[0, 0\]"),
        ("world_to_camera", torch.eye(4), r"world_to_camera: expected shape \[V, 4, 4\]"),
        ("intrinsics", -torch.eye(3)[None], r"intrinsics\[0\]: expected .* positive focal lengths"),
        ("background", torch.zeros(2), r"background: expected shape \[3\] or \[1, 3\], got \[2\]"),
    ],
)  # fmt: skip
def test_bad_input_is_named(name: str, value: Tensor, message: str) -> None:
    inputs = {key: tensor.float() for key, tensor in scene(4, 3, 1, 8, 8, 0).items()}
    with pytest.raises(ValueError, match=message):
        render(inputs | {name: value}, 8, 8)


def test_an_unknown_or_unfit_backend_is_named() -> None:
    inputs = scene(4, 3, 1, 8, 8, 0)
    with pytest.raises(ValueError, match="expected one of auto, numba, triton, gsplat, reference, got 'cuda'"):
        render(inputs, 8, 8, backend="cuda")
    with pytest.raises(ValueError, match=r"numba.*expected float32 on the CPU, got torch.float64"):
        render(inputs, 8, 8, backend="numba")
