"""Feature extractors and LPIPS: the original networks, and the door for one's own.

An extractor is any object with the attributes of `Extractor` (images) or `VideoExtractor` (clips); nothing has to be
registered or inherited. A score is stored with the extractor's name, digest and resize, so a network of one's own makes
a metric of its own, in a column of its own:

    class Dino:
        name, digest, dimension, resize = "dino-s14", "<SHA-256 of its weights>", 384, "square 224, bicubic"

        def __call__(self, images: Tensor) -> Tensor:     # [B, 3, H, W] in [0, 1] -> [B, 384]
            return self.network(self.preprocess(images))

Images go in at their own size and in [0, 1]; resizing, scaling and the device are the extractor's business. Weights of
the networks here come from `rewild4d.metrics.weights`, which checks every byte; without them a constructor raises
`WeightsMissing`. TF32 is off while a network runs.
"""

from typing import Protocol

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


class Extractor(Protocol):
    """What a metric on sets of images needs; see the module on bringing one's own."""

    name: str
    digest: str
    dimension: int
    resize: str

    def __call__(self, images: Tensor) -> Tensor:
        """Features of images in [0, 1], [B, 3, H, W] -> [B, dimension]."""
        ...


class VideoExtractor(Protocol):
    """What a metric on sets of clips needs; see the module on bringing one's own."""

    name: str
    digest: str
    dimension: int
    minimum_frames: int
    resize: str

    def __call__(self, videos: Tensor) -> Tensor:
        """Features of clips in [0, 1], [B, T, 3, H, W] -> [B, dimension]."""
        ...


class InceptionFeatures:
    """The FID Inception-v3 of December 2015, averaged over the pixels of a layer; see `inception`."""

    def __init__(self, weights: LoadedWeights, tap: int, resize: str, device: torch.device) -> None:
        self.name = "inception-fid" if tap == 2048 else f"inception-fid-{tap}"
        self.digest, self.dimension, self.resize, self.device = weights.digest, tap, resize, device
        self._network = inception_network.Inception(_on(weights, device))

    def __call__(self, images: Tensor) -> Tensor:
        """Features of images.

        A rendering is rounded to 8 bits first, so that it scores the same in memory as out of a PNG file. Then it is
        resized in float, without rounding again, and the network reads (pixel - 128) / 128.

        Args:
            images: in [0, 1], [B, 3, H, W].

        Returns:
            Float32, on the images' device, [B, dimension].

        Raises:
            ValueError: another shape or range.
        """
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
    """The Kinetics-400 I3D that FVD is defined on; see `i3d`."""

    def __init__(self, weights: LoadedWeights, resize: str, device: torch.device) -> None:
        self.name, self.digest, self.resize, self.device = "i3d-k400", weights.digest, resize, device
        self.dimension, self.minimum_frames = i3d_network.CLASSES, i3d_network.MINIMUM_FRAMES
        with exact_float32():
            self._network = i3d_network.I3d(_on(weights, device))

    def __call__(self, videos: Tensor) -> Tensor:
        """Logits of clips, averaged over time.

        Frames are taken as they are, at their own rate, without rounding to 8 bits.

        Args:
            videos: in [0, 1], at least 9 frames, [B, T, 3, H, W].

        Returns:
            Float32, on the videos' device, [B, 400].

        Raises:
            ValueError: another shape or range, or too few frames.
        """
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
    """LPIPS v0.1 on the AlexNet or the VGG-16 trunk (Zhang et al. 2018): 0 for equal images, and no upper bound.

    The two trunks make two metrics, LPIPS-alex and LPIPS-vgg, whose values do not compare. Nor do those of other sizes,
    crops and backgrounds, for images are not resized.
    """

    def __init__(self, net: lpips_network.Net, device: torch.device | str = CPU) -> None:
        """Load a trunk and its heads.

        Args:
            net: "alex" or "vgg".
            device: to compute on.

        Raises:
            ValueError: another trunk.
            WeightsMissing: the weights are not here.
        """
        _one_of("trunk", net, ("alex", "vgg"))
        weights = load_weights(f"lpips-{net}")
        self.net, self.name, self.digest, self.device = net, f"lpips-{net}", weights.digest, torch.device(device)
        self.minimum_size = lpips_network.MINIMUM_SIZE[net]
        self._tensors = _on(weights, self.device)

    def __call__(self, prediction: Tensor, target: Tensor) -> Tensor:
        """Distance of each pair, one pair at a time, so that a pair's value does not depend on its batch.

        Args:
            prediction: in [0, 1], not rounded to 8 bits, [B, 3, H, W].
            target: in [0, 1], [B, 3, H, W].

        Returns:
            Computed in float32, returned as float64 on the images' device, [B].

        Raises:
            ValueError: another shape or range, or images that are too small for the trunk.
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


def inception(resize: str = "clean", device: torch.device | str = CPU, tap: int = 2048) -> InceptionFeatures:
    """The extractor of FID and KID (Heusel et al. 2017, Binkowski et al. 2018).

    Args:
        resize: to 299x299: "clean", "tf1" or "bilinear-antialias"; see `networks.resizing.resize_images`.
        device: to compute on.
        tap: layer by its dimension: 2048 ("pool3"), or 768, 192, 64, which are other metrics.

    Raises:
        ValueError: another resize or tap.
        WeightsMissing: the weights are not here.
    """
    _one_of("resize", resize, IMAGE_RESIZES)
    _one_of("tap", tap, inception_network.TAPS)
    return InceptionFeatures(load_weights("inception-fid"), tap, resize, torch.device(device))


def i3d(resize: str = "short-side-crop", device: torch.device | str = CPU) -> I3dFeatures:
    """The extractor of FVD (Unterthiner et al. 2019): logits of I3D, averaged over time, without a softmax.

    Args:
        resize: to 224x224: "short-side-crop" or "square"; see `networks.resizing.resize_clip`.
        device: to compute on.

    Raises:
        ValueError: another resize.
        WeightsMissing: the weights are not here.
    """
    _one_of("resize", resize, VIDEO_RESIZES)
    return I3dFeatures(load_weights("i3d-k400"), resize, torch.device(device))


def _one_of(what: str, value: object, known: tuple[object, ...]) -> None:
    if value not in known:
        raise ValueError(f"expected a {what} out of {', '.join(map(str, known))}, got {value}")


def _on(weights: LoadedWeights, device: torch.device) -> dict[str, Tensor]:
    return {name: tensor.to(device) for name, tensor in weights.tensors.items()}
