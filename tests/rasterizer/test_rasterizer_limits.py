"""What the CPU path promises in numbers and in other people's processes: accuracy, workers, caches, bad input."""

import math
import multiprocessing
import os
import subprocess
import sys
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import joblib
import pytest
import torch
from splats import Renders, gradients, hard_scene, image_bytes, render, scene
from torch import Tensor
from torch.utils.data import DataLoader

from rewild4d.kernels import compiling
from rewild4d.rasterizer import cpu, rasterize

WIDTH, HEIGHT = 70, 50


def draw(kind: str, seed: int, count: int) -> dict[str, Tensor]:
    """Gaussians of one kind; values that single precision holds, so that only the arithmetic differs."""
    made = scene(count, 3, 1, WIDTH, HEIGHT, seed)
    chance = torch.rand(count, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    if kind == "nearly opaque":
        made["opacities"] = 0.999 * chance**0.3
    elif kind == "behind and beside":
        made["means"][::2, 2] -= 8
        made["means"][::3] *= 4
    elif kind == "needles":
        made["scales"][:, 0], made["scales"][:, 1:] = 0.5, 0.0005
    elif kind == "sub-pixel":
        made["scales"] *= 1e-3
    elif kind == "on one pixel":
        made["means"] *= 0.003
        made["scales"] *= 0.1
        made["opacities"] *= 0.2
    return {name: value.float().double() for name, value in made.items()}


def compared(kind: str, seed: int, count: int = 300, width: int = WIDTH) -> tuple[float, dict[str, float]]:
    """PSNR of the image, and the relative error of every gradient, against double precision.

    The Gaussians are at the right end of wider images.
    """
    inputs = draw(kind, seed, count)
    inputs["intrinsics"][:, 0, 2] += width - WIDTH
    wanted, slopes = gradients(inputs, width, HEIGHT, backend="reference")
    single = {name: value.float() for name, value in inputs.items()}
    image, found = gradients(single, width, HEIGHT, backend="numba")
    error = (image - wanted).square().mean().clamp_min(1e-30).item()
    relative = {
        name: float((found[name] - slope).norm() / slope.norm().clamp_min(1e-30)) for name, slope in slopes.items()
    }
    return -10 * math.log10(error), relative


@pytest.mark.parametrize("kind", ["plain", "nearly opaque", "behind and beside", "sub-pixel", "needles"])
def test_gradients_to_a_hundred_thousandth(kind: str) -> None:
    for seed in range(5):
        psnr, relative = compared(kind, seed)
        assert psnr >= 100
        assert max(relative.values()) <= 1e-5, (seed, relative)


@pytest.mark.parametrize("width", [256, 2048])
@pytest.mark.parametrize("kind", ["plain", "sub-pixel", "needles"])
def test_gradients_are_as_exact_far_from_the_images_corner(kind: str, width: int) -> None:
    """The steps of single precision grow with the coordinate, so a centre is two single numbers."""
    for seed in range(3):
        psnr, relative = compared(kind, seed, 80, width)
        assert psnr >= 100
        assert max(relative.values()) <= 1e-5, (seed, relative)


@pytest.mark.parametrize("count", [300, 1000, 3000])
def test_many_on_one_pixel(count: int) -> None:
    """In the cameras' gradients thousands of terms cancel."""
    for seed in range(3):
        psnr, relative = compared("on one pixel", seed, count)
        assert psnr >= 100
        assert max(relative.values()) <= 1e-5, relative


@pytest.mark.parametrize("kind", ["opaque", "behind", "faint", "huge", "tied"])
@pytest.mark.parametrize(("channels", "views"), [(3, 1), (5, 2)])
def test_tiles_walked_in_double_precision(
    monkeypatch: pytest.MonkeyPatch, kind: str, channels: int, views: int
) -> None:
    """However few their Gaussians, at the image's edges, closed pixels and capped opacities included."""
    monkeypatch.setattr(cpu, "CROWD", 0)
    inputs = {name: value.float().double() for name, value in hard_scene(kind, 0, 80, channels, views).items()}
    _, slopes = gradients(inputs, WIDTH, HEIGHT, backend="reference")
    _, found = gradients({name: value.float() for name, value in inputs.items()}, WIDTH, HEIGHT, backend="numba")
    for name, slope in slopes.items():
        assert (found[name] - slope).norm() <= 1e-5 * slope.norm().clamp_min(1e-6), name


def test_depths_that_single_precision_cannot_tell_apart_keep_their_order() -> None:
    count = 64
    depth = 5 + 1e-9 * torch.arange(count, dtype=torch.float64).flip(0)
    inputs = scene(count, 3, 1, 20, 20, 0) | {"means": torch.zeros(count, 3, dtype=torch.float64)}
    # The camera's own offset carries the depths, because float32 means cannot.
    matrix = torch.eye(4, dtype=torch.float64)[None]
    matrix[:, 2, 0] = 1e-9
    inputs["means"][:, 0] = torch.arange(count, dtype=torch.float64).flip(0) * 1e-3
    matrix[:, 2, 3] = 5
    inputs |= {"world_to_camera": matrix, "scales": torch.full((count, 3), 0.3, dtype=torch.float64)}
    assert len((inputs["means"][:, 0] * 1e-9 + 5).float().unique()) == 1 and len(depth.float().unique()) == 1
    inputs = {name: value.float().double() for name, value in inputs.items()}
    wanted = render(inputs, 20, 20, backend="reference")[0]
    single = {name: value.float() for name, value in inputs.items()}
    assert (render(single, 20, 20)[0] - wanted).abs().max() < 1e-4


def test_what_lies_behind_a_pixel_that_a_gaussian_closed_alone_has_no_gradient() -> None:
    """Two wide Gaussians, one of a single pixel that closes it, and a wide one behind; the loss looks at that pixel."""
    focal, depths = 16.0, torch.tensor([1.0, 1.1, 1.2, 1.4])
    sizes = torch.tensor([4.0, 4.0, 0.05, 4.0])
    places = torch.tensor([(5.5 - 8) / focal, (5.5 - 8) / focal, 1.0])
    inputs = (
        depths[:, None] * places, torch.tensor([[1.0, 0, 0, 0]]).repeat(4, 1),
        (sizes * depths / focal)[:, None].repeat(1, 3), torch.tensor([0.93, 0.93, 0.99, 0.5]), torch.rand(4, 3),
    )  # fmt: skip
    camera = torch.tensor([[[focal, 0, 8], [0, focal, 8], [0, 0, 1]]])
    for backend, kind in (("numba", torch.float32), ("reference", torch.float64)):
        leaves = [value.to(kind, copy=True).requires_grad_() for value in inputs]
        image, _, _ = rasterize(*leaves, torch.eye(4)[None], camera, 16, 16, eps2d=0.01, backend=backend)
        image[0, :, 5, 5].sum().backward()
        slopes = [leaf.grad for leaf in leaves if leaf.grad is not None]
        assert all((slope[3] == 0).all() for slope in slopes), backend
        assert len(slopes) == 5 and all((slope[:2] != 0).all() for slope in slopes[3:]), (
            "opacities and features in front"
        )


@pytest.mark.parametrize("count", [1, 2])
def test_a_gaussian_whose_radius_rounds_to_zero_is_listed_as_often_as_it_is_counted(count: int) -> None:
    """Antialiasing leaves it an alpha of 1/255 and a hair, at a pixel's centre."""
    inputs = (
        torch.tensor([[0.0, 0, 1], [0.1, 0, 2]]), torch.tensor([[1.0, 0, 0, 0]] * 2),
        torch.tensor([[1 / 16.0] * 3, [2.0] * 3]), torch.tensor([0.5, 0.9]), torch.ones(2, 3),
    )  # fmt: skip
    leaves = [value[:count].clone().requires_grad_() for value in inputs]
    camera = torch.tensor([[[16.0, 0, 8.5], [0, 16, 8.5], [0, 0, 1]]])
    image, _, info = rasterize(
        *leaves, torch.eye(4)[None], camera, 16, 16, eps2d=126.49999999999999, antialias=True, backend="numba"
    )
    assert info.radii[0, 0] == 0, "or the case is another"
    image.sum().backward()
    for leaf in leaves:
        assert leaf.grad is not None and leaf.grad.abs().max() < 1e3


@pytest.mark.parametrize("seed", range(4))
def test_no_nan_from_any_finite_input(seed: int) -> None:
    generator = torch.Generator().manual_seed(seed)
    inputs = {name: value.float() for name, value in scene(200, 3, 1, 40, 30, seed).items()}
    sizes = 10.0 ** torch.randint(-30, 12, (200, 3), generator=generator)
    inputs["scales"] = sizes
    inputs["means"] = inputs["means"] * 10.0 ** torch.randint(-20, 8, (200, 1), generator=generator)
    inputs["quats"][::3] = 0
    inputs["opacities"][::4], inputs["opacities"][1::4] = 0, 1
    image, found = gradients(inputs, 40, 30)
    assert torch.isfinite(image).all()
    for name, slope in found.items():
        assert torch.isfinite(slope).all(), name


def test_a_zero_quaternion_turns_nothing() -> None:
    inputs = {name: value.float() for name, value in scene(50, 3, 1, 40, 30, 1).items()}
    inputs["quats"][::2] = 0
    turned = inputs | {"quats": inputs["quats"].clone()}
    turned["quats"][::2, 0] = 1
    assert torch.equal(render(inputs, 40, 30)[0], render(turned, 40, 30)[0])
    wanted = render({name: value.double() for name, value in inputs.items()}, 40, 30, backend="reference")[0]
    assert float((wanted - render(inputs, 40, 30)[0]).abs().max()) < 1e-4


def test_features_up_to_their_limit_have_gradients() -> None:
    inputs = {name: value.float() for name, value in scene(50, 3, 1, 40, 30, 0).items()}
    loud = inputs | {"features": 2.0**100 * (2 * (torch.arange(150).view(50, 3) % 2) - 1).float()}
    for name, slope in gradients(loud, 40, 30)[1].items():
        assert torch.isfinite(slope).all(), name
    loud["features"][7, 1] = -1e31
    with pytest.raises(
        ValueError, match=r"features: expected magnitudes up to 1.3e\+30, got -1e\+31 at index \[7, 1\]"
    ):
        render(loud, 40, 30)


@pytest.fixture(autouse=True)
def same_threads() -> Iterator[None]:
    """Workers that are threads of this process set its number of threads."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def expected() -> list[bytes]:
    return [image_bytes(seed) for seed in range(4)]


def test_a_data_loader_renders_in_its_workers(expected: list[bytes]) -> None:
    loader = DataLoader(Renders(), batch_size=None, num_workers=2, multiprocessing_context="fork")
    assert [image.numpy().tobytes() for image in loader] == expected


@pytest.mark.parametrize("backend", ["loky", "threading"])
def test_joblib_renders_in_its_workers(backend: str, expected: list[bytes]) -> None:
    found = joblib.Parallel(n_jobs=2, backend=backend)(joblib.delayed(image_bytes)(seed) for seed in range(4))
    assert found == expected


def test_spawned_processes_render(expected: list[bytes]) -> None:
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=context) as pool:
        assert list(pool.map(image_bytes, range(2))) == expected[:2]


SCRIPT = """
import sys, numba, torch
from rewild4d.rasterizer import rasterize
count = 20
camera, pinhole = torch.eye(4)[None].clone(), torch.tensor([[[20.0, 0, 8], [0, 20, 8], [0, 0, 1]]])
camera[:, 2, 3] = 5
means = torch.zeros(count, 3).requires_grad_()
image, _, _ = rasterize(means, torch.ones(count, 4), torch.full((count, 3), 0.2), torch.full((count,), 0.5),
                        torch.ones(count, 3), camera, pinhole, 16, 16)
image.sum().backward()
from rewild4d.rasterizer.stages import bin_and_blend
stats = bin_and_blend.stats
print(float(image.max()) > 0, sum(stats.cache_hits.values()), sum(stats.cache_misses.values()))
"""


def start(cache: Path) -> list[str]:
    """What a fresh process says of its image and of the kernel cache."""
    environment = os.environ | {"REWILD4D_CACHE": str(cache)}
    environment.pop("NUMBA_CACHE_DIR", None)
    done = subprocess.run([sys.executable, "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True)
    return done.stdout.split()


def test_a_second_process_compiles_nothing(tmp_path: Path) -> None:
    assert start(tmp_path) == ["True", "0", "1"]
    assert start(tmp_path) == ["True", "1", "0"]


def test_without_a_cache_folder_kernels_compile_in_the_process(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    blocker = tmp_path / "file"
    blocker.write_text("")
    monkeypatch.setattr(compiling, "_CACHE", blocker / "cache")
    # Also where numba would fall back to, next to the source and in the user's folder.
    monkeypatch.setattr("numba.core.caching._CacheLocator.ensure_cache_path", _refuse)
    doubled = compiling.kernel(_double)
    assert doubled(21) == 42 and not blocker.is_dir()


def _refuse(self: object) -> None:
    raise OSError("read-only")


def _double(value: int) -> int:
    return 2 * value
