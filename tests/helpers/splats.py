"""Scenes of Gaussians, and their images and gradients, for the rasterizer's tests."""

import math
import sys
from typing import Any

import torch
from torch import Tensor
from torch.utils.data import Dataset

from rewild4d.rasterizer import RasterInfo, rasterize

NAMES = ("means", "quats", "scales", "opacities", "features", "world_to_camera", "intrinsics", "background")


def scene(count: int, channels: int, views: int, width: int, height: int, seed: int) -> dict[str, Tensor]:
    """A cloud around the origin seen from five units away, float64, every input `rasterize` differentiates."""
    generator = torch.Generator().manual_seed(seed)

    def uniform(*shape: int) -> Tensor:
        return torch.rand(*shape, generator=generator, dtype=torch.float64)

    means = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    turn = 0.1 * torch.randn(views, 3, 3, generator=generator, dtype=torch.float64)
    world_to_camera = torch.eye(4, dtype=torch.float64).repeat(views, 1, 1)
    world_to_camera[:, :3, :3] = torch.linalg.matrix_exp(turn - turn.mT)
    world_to_camera[:, 2, 3] = 5
    pinhole = torch.tensor([[1.1 * width, 0, 0.45 * width], [0, 0.9 * width, 0.55 * height], [0, 0, 1]])
    return {
        "means": means,
        "quats": torch.randn(count, 4, generator=generator, dtype=torch.float64),
        "scales": 0.02 + 0.3 * uniform(count, 3),
        "opacities": 0.05 + 0.9 * uniform(count),
        "features": uniform(count, channels),
        "world_to_camera": world_to_camera,
        "intrinsics": pinhole.double().repeat(views, 1, 1),
        "background": uniform(views, channels),
    }


def hard_scene(
    kind: str, seed: int = 0, count: int = 300, channels: int = 3, views: int = 1, width: int = 70, height: int = 50
) -> dict[str, Tensor]:
    """The same cloud, spoilt in one way."""
    made = scene(count, channels, views, width, height, seed)
    if kind == "needles":
        made["scales"][:, 0] *= 8
        made["scales"][:, 1:] *= 0.01
    elif kind == "sub-pixel":
        made["scales"] *= 1e-3
    elif kind == "behind":
        made["means"][::2, 2] -= 8
        made["means"][::3] *= 4
    elif kind == "opaque":
        made["opacities"][:] = 0.9999
    elif kind == "faint":
        made["opacities"] *= 0.02
    elif kind == "huge":
        made["scales"] *= 10
    elif kind == "tied":
        made["means"][1::2] = made["means"][::2]
    return made


def spoilt_scenes() -> dict[str, tuple[dict[str, Tensor], str]]:
    """Inputs that nobody can draw, in single precision, and what is said of each (a pattern), by name."""
    made: dict[str, tuple[dict[str, Tensor], str]] = {}
    for name, index, value, said in (
        ("scales", (3, 1), math.nan, r"scales: expected finite values, got nan at index \[3, 1\]"),
        ("quats", (1, 0), math.inf, r"quats: expected finite values, got inf at index \[1, 0\]"),
        ("opacities", (4,), math.inf, r"opacities: expected finite values, got inf at index \[4\]"),
        ("means", (0, 2), -math.inf, r"means: expected finite values, got -inf at index \[0, 2\]"),
        ("features", (2, 0), 1e35, r"features: expected magnitudes up to 1.3e\+30, got 1e\+35 at index \[2, 0\]"),
        ("features", (39, 2), math.nan, r"features: expected finite values, got nan at index \[39, 2\]"),
        ("background", (1, 2), -1e35, r"background: expected magnitudes up to .* at index \[1, 2\]"),
        ("world_to_camera", (1, 3, 3), math.nan, r"world_to_camera: .* got nan at index \[1, 3, 3\]"),
        ("intrinsics", (1, 0, 2), math.nan, r"intrinsics: .* got nan at index \[1, 0, 2\]"),
        ("intrinsics", (0, 1, 1), -1.0, r"intrinsics\[0\]: .* positive focal lengths"),
        ("intrinsics", (1, 0, 1), 0.5, r"intrinsics\[1\]: .* positive focal lengths"),
    ):
        inputs = {key: tensor.float() for key, tensor in scene(40, 3, 2, 20, 18, seed=1).items()}
        inputs[name][index] = value
        made[f"{name}{list(index)} {value}"] = (inputs, said)
    nobody = {key: tensor.float() for key, tensor in scene(0, 3, 2, 20, 18, seed=1).items()}
    nobody["world_to_camera"][0, 1, 2] = math.nan
    made["no Gaussian, a camera of NaN"] = (nobody, r"world_to_camera: .* got nan at index \[0, 1, 2\]")
    return made


def render(inputs: dict[str, Tensor], width: int, height: int, **options: Any) -> tuple[Tensor, Tensor, RasterInfo]:
    background = inputs.get("background")
    return rasterize(*(inputs[name] for name in NAMES[:-1]), width, height, background=background, **options)


def loss_weights(image: Tensor) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(9)
    shape = (image.shape[0], image.shape[1] + 1, *image.shape[2:])
    weights = torch.randn(shape, generator=generator, dtype=torch.float64)
    return weights[:, :-1], weights[:, -1:]


def outcome(inputs: dict[str, Tensor], width: int, height: int, **options: Any) -> dict[str, Tensor]:
    """Image, alpha, radii, and the gradient of a random loss by each input and by the centres ("d means", ...)."""
    leaves = {name: tensor.clone().requires_grad_() for name, tensor in inputs.items()}
    image, alpha, info = render(leaves, width, height, **options)
    on_image, on_alpha = (weights.to(image) for weights in loss_weights(image))
    ((image * on_image).sum() + (alpha * on_alpha).sum()).backward()
    found = {f"d {name}": tensor.grad for name, tensor in (leaves | {"means2d": info.means2d}).items()}
    return {"image": image.detach(), "alpha": alpha.detach(), "radii": info.radii} | found


def gradients(inputs: dict[str, Tensor], width: int, height: int, **options: Any) -> tuple[Tensor, dict[str, Tensor]]:
    made = outcome(inputs, width, height, **options)
    return made["image"], {name[2:]: tensor for name, tensor in made.items() if name.startswith("d ")}


class Renders(Dataset):
    """Each item is an image, so that a worker process has to render."""

    def __len__(self) -> int:
        return 4

    def __getitem__(self, index: int) -> Tensor:
        return one_image(index)


def one_image(seed: int) -> Tensor:
    """A small image in a process of its own; one thread, as workers beside each other should have."""
    torch.set_num_threads(1)
    inputs = {name: value.float() for name, value in scene(700, 3, 1, 48, 32, seed).items()}
    return render(inputs, 48, 32)[0][0]


def image_bytes(seed: int) -> bytes:
    """Plain bytes, which every kind of process can send."""
    return one_image(seed).numpy().tobytes()


def main(source: str, target: str) -> None:
    """Write the single-precision outcomes, by Triton and twice, of a file of cases, or what the error says."""
    torch.set_num_threads(1)
    cases = torch.load(source)
    made: dict[str, list[dict[str, Tensor]] | str] = {}
    for name, (inputs, width, height, options) in cases.items():
        single = {key: tensor.float() for key, tensor in inputs.items()}
        try:
            made[name] = [outcome(single, width, height, backend="triton", **options) for _ in range(2)]
        except ValueError as error:
            made[name] = str(error)
    torch.save(made, target)


if __name__ == "__main__":
    main(*sys.argv[1:])
