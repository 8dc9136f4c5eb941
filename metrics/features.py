"""Feature extractors and LPIPS on the original networks.

An extractor is any object with the attributes of `samples.ImageExtractor` or `samples.VideoExtractor`; nothing has to
be registered or inherited. A score is stored with the extractor's name, digest and resize, so a network of one's own
makes a metric of its own, in a column of its own:

    class Dino:
        name, digest, resize = "dino-s14", "<SHA-256 of its weights>", "square 224, bicubic"

        def __call__(self, images: Tensor) -> Tensor:     # [B, 3, H, W] in [0, 1] -> [B, 384]
            return self.network(self.preprocess(images))

Images have their own size and are in [0, 1]; the extractor resizes, scales and chooses the device. Weights of the
networks here come from `rewild4d.metrics.weights`, which checks every byte; without them a constructor raises
`WeightsMissing`. TF32 is off while a network runs.
"""

import torch
from torch import Tensor

from rewild4d.metrics.networks import i3d as i3d_network
from rewild4d.metrics.networks import inception as inception_network
from rewild4d.metrics.networks import lpips as lpips_network
from rewild4d.metrics.networks.layers import check_range, exact_float32
from rewild4d.metrics.networks.resizing import IMAGE_RESIZES, VIDEO_RESIZES, resize_clip, resize_images
from rewild4d.metrics.weights import LoadedWeights, load_weights

CPU = torch.device("cpu")
BATCH = 8
"""Images that pass Inception at once; more are not faster and take more memory."""


class InceptionFeatures:
    """The extractor of FID and KID (Heusel et al. 2017, Binkowski et al. 2018): Inception-v3 of December 2015.

    Images are rounded to 8 bits first, so that a rendering scores the same in memory as from a PNG file; then they are
    resized in float, and the network reads (pixel - 128) / 128. Features are averaged over the pixels of a layer.

    Args:
        resize: to 299x299: "clean", "tf1" or "bilinear-antialias"; see `networks.resizing.resize_images`.
        device: to compute on.
        tap: layer by its dimension: 2048 ("pool3"), or 768, 192, 64, which are other metrics.

    Raises:
        ValueError: another resize or tap.
        WeightsMissing: the weights are not here.

    Examples:
        >>> InceptionFeatures("nearest")
        Traceback (most recent call last):
        ValueError: expected a resize out of clean, tf1, bilinear-antialias, got nearest
    """

    def __init__(self, resize: str = "clean", device: torch.device | str = CPU, tap: int = 2048) -> None:
        _one_of("resize", resize, IMAGE_RESIZES)
        _one_of("tap", tap, inception_network.TAPS)
        weights = load_weights("inception-fid")
        self.name = "inception-fid" if tap == 2048 else f"inception-fid-{tap}"
        self.digest, self.dimension, self.resize, self.device = weights.digest, tap, resize, torch.device(device)
        self._network = inception_network.Inception(_on(weights, self.device))

    def __call__(self, images: Tensor) -> Tensor:
        """Compute features of images in [0, 1], [B, 3, H, W] -> float32, [B, dimension]."""
        if images.ndim != 4 or images.shape[1] != 3:
            raise ValueError(f"expected images of shape [B, 3, H, W], got {tuple(images.shape)}")
        check_range(images)
        return torch.cat([self._batch(batch) for batch in images.split(BATCH)]).to(images.device)

    def _batch(self, images: Tensor) -> Tensor:
        with exact_float32():
            pixels = (images.to(self.device, torch.float32) * 255).round().clamp(0, 255)
            resized = resize_images(pixels, inception_network.SIZE, self.resize)
            return self._network((resized - 128) / 128, self.dimension)


class I3dFeatures:
    """The extractor of FVD (Unterthiner et al. 2019): logits of I3D, averaged over time, without a softmax.

    Frames keep their rate and are not rounded to 8 bits.

    Args:
        resize: to 224x224: "short-side-crop" or "square"; see `networks.resizing.resize_clip`.
        device: to compute on.

    Raises:
        ValueError: another resize.
        WeightsMissing: the weights are not here.

    Examples:
        >>> I3dFeatures("clean")
        Traceback (most recent call last):
        ValueError: expected a resize out of short-side-crop, square, got clean
    """

    def __init__(self, resize: str = "short-side-crop", device: torch.device | str = CPU) -> None:
        _one_of("resize", resize, VIDEO_RESIZES)
        weights = load_weights("i3d-k400")
        self.name, self.digest, self.resize = "i3d-k400", weights.digest, resize
        self.device = torch.device(device)
        self.dimension, self.minimum_frames = i3d_network.CLASSES, i3d_network.MINIMUM_FRAMES
        with exact_float32():
            self._network = i3d_network.I3d(_on(weights, self.device))

    def __call__(self, videos: Tensor) -> Tensor:
        """Compute logits of clips in [0, 1] of at least 9 frames, [B, T, 3, H, W] -> float32, [B, 400]."""
        if videos.ndim != 5 or videos.shape[2] != 3:
            raise ValueError(f"expected clips of shape [B, T, 3, H, W], got {tuple(videos.shape)}")
        if videos.shape[1] < self.minimum_frames:
            raise ValueError(f"expected at least {self.minimum_frames} frames a clip for I3D, got {videos.shape[1]}")
        check_range(videos)
        return torch.cat([self._clip(video) for video in videos]).to(videos.device)

    def _clip(self, video: Tensor) -> Tensor:
        with exact_float32():
            frames = resize_clip(video.to(self.device, torch.float32), i3d_network.SIZE, self.resize)
            return self._network((frames * 2 - 1).transpose(0, 1)[None])


class Lpips:
    """LPIPS v0.1 on the AlexNet or the VGG-16 trunk (Zhang et al. 2018): 0 for equal images, without an upper bound.

    LPIPS-alex and LPIPS-vgg are two metrics whose values do not compare. Images are not resized, so values of
    other sizes, crops and backgrounds do not compare either.

    Args:
        net: "alex" or "vgg".
        device: to compute on.

    Raises:
        ValueError: another trunk.
        WeightsMissing: the weights are not here.
    """

    def __init__(self, net: lpips_network.Net, device: torch.device | str = CPU) -> None:
        _one_of("trunk", net, ("alex", "vgg"))
        weights = load_weights(f"lpips-{net}")
        self.net, self.name, self.digest, self.device = net, f"lpips-{net}", weights.digest, torch.device(device)
        self.minimum_size = lpips_network.MINIMUM_SIZE[net]
        self._tensors = _on(weights, self.device)

    def __call__(self, prediction: Tensor, target: Tensor) -> Tensor:
        """Compute the distance of each pair in [0, 1], not rounded to 8 bits, [B, 3, H, W] -> float64, [B].

        Pairs are computed one at a time in float32, so that a value does not depend on its batch.
        """
        if prediction.shape != target.shape or target.ndim != 4 or target.shape[1] != 3:
            shapes = f"{tuple(prediction.shape)} and {tuple(target.shape)}"
            raise ValueError(f"expected two image batches of one shape [B, 3, H, W], got {shapes}")
        if min(target.shape[2:]) < self.minimum_size:
            least, size = f"{self.minimum_size}x{self.minimum_size}", f"{target.shape[3]}x{target.shape[2]}"
            raise ValueError(f"expected images of at least {least} pixels for LPIPS-{self.net}, got {size}")
        check_range(prediction)
        check_range(target)
        with exact_float32():
            pairs = (x.to(self.device, torch.float32).split(1) for x in (prediction, target))
            values = [lpips_network.lpips(self.net, self._tensors, *pair) for pair in zip(*pairs, strict=True)]
        return torch.cat(values).to(target.device)


def _one_of(what: str, value: object, known: tuple[object, ...]) -> None:
    if value not in known:
        raise ValueError(f"expected a {what} out of {', '.join(map(str, known))}, got {value}")


def _on(weights: LoadedWeights, device: torch.device) -> dict[str, Tensor]:
    return {name: tensor.to(device) for name, tensor in weights.tensors.items()}
