"""Features that need not be computed twice: of the input that just passed, and of reference videos on this machine."""

from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Any
from zipfile import BadZipFile

import numpy as np
import torch
from torch import Tensor

from rewild4d.errors import UserError
from rewild4d.files import atomic, cache_folder, digest
from rewild4d.metrics.samples import Features


class Remembering:
    """A network that knows its last input again: sixteen views of nothing are one image.

    The same bits go in, so the same bits come out: no number changes.
    """

    def __init__(self, network: Any) -> None:
        """Stand in for an image or a video extractor."""
        self.network = network
        self.name, self.digest, self.resize = network.name, network.digest, network.resize
        self.minimum_frames = getattr(network, "minimum_frames", 1)
        self._last: tuple[Tensor, Tensor] | None = None

    def __call__(self, images: Tensor, /) -> Tensor:
        """What the network says of a batch of images or clips."""
        if self._last is None or not torch.equal(self._last[0], images):
            self._last = images.clone(), self.network(images)
        return self._last[1]


def kept(network: Any, images: Sequence[Tensor], compute: Callable[[Any], Features], *choice: object) -> Features:
    """Features of a reference, which every method and seed of a case is compared with: computed once on a machine.

    They lie in the cache folder, under a digest of the pixels, the network and all that decides the last bits of its
    arithmetic (torch, device, processor, threads), so a number is the same whether they were there or not.

    Args:
        network: image or video extractor.
        images: the reference, [3, H, W] each.
        compute: network -> the features, all of one sequence.
        choice: what else ``compute`` depends on (the windows of clips), as text.
    """
    device = torch.device(getattr(network, "device", "cpu"))
    where = torch.cuda.get_device_name(device) if device.type == "cuda" else torch.backends.cpu.get_cpu_capability()
    way = (torch.__version__, device, where, torch.get_num_threads(), network.name, network.digest, network.resize)
    key = digest(*images, repr(way), repr(choice))
    path = cache_folder() / "features" / f"{key[:32]}.npz"
    try:
        with np.load(path, allow_pickle=False) as file:
            values, groups, frames = (torch.from_numpy(file[name]) for name in ("values", "groups", "frames"))
        return Features(values, groups, network.name, network.digest, network.resize, int(frames) or None)
    except (OSError, ValueError, KeyError, EOFError, BadZipFile):  # not there or damaged: made anew
        found = compute(network)
    with suppress(UserError), atomic(path) as temporary, temporary.open("wb") as file:  # it is a cache, no result
        np.savez(file, values=found.values.numpy(), groups=found.groups.numpy(), frames=np.array(found.frames or 0))
    return found
