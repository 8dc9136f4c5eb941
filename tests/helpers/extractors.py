"""Networks small enough for tests: seeded linear maps of thumbnails, and a squared error in LPIPS's place."""

import torch


class LinearNetwork:
    """A seeded linear map of 4x4 thumbnails: enough of a network to test everything around it."""

    name, digest, resize, dimension = "linear", "0" * 64, "area 4x4", 32

    def __init__(self) -> None:
        self.weights = torch.randn(48, self.dimension, generator=torch.Generator().manual_seed(7))

    def __call__(self, images: torch.Tensor) -> torch.Tensor:
        return torch.nn.functional.interpolate(images, (4, 4), mode="area").flatten(1) @ self.weights


class LinearVideoNetwork:
    """A seeded linear map of each frame's 4x4 thumbnail, a weight of its own for each of the first frames, summed."""

    name, digest, resize, dimension, minimum_frames = "linear-video", "0" * 64, "area 4x4", 24, 9

    def __init__(self) -> None:
        self.weights = torch.randn(32, 48, self.dimension, generator=torch.Generator().manual_seed(3))

    def __call__(self, videos: torch.Tensor) -> torch.Tensor:
        batch, frames = videos.shape[:2]
        small = torch.nn.functional.interpolate(videos.flatten(0, 1), (4, 4), mode="area").view(batch, frames, -1)
        return torch.einsum("btc,tcd->bd", small, self.weights[:frames]) / frames


class SquaredError:
    """The mean squared difference of each pair, and how often it was asked."""

    digest = "1" * 64

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, prediction: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
        self.calls += 1
        return (prediction - truth).double().square().flatten(1).mean(1)
