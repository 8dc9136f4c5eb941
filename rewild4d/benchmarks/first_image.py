"""Import the rasterizer in a fresh process and render one image with gradients.

`python -m rewild4d.benchmarks.first_image FILE` prints the times as JSON for `probes.py`; it imports only what a user
of the rasterizer does.
"""

import gc
import json
import sys
import time

BEGIN = time.perf_counter()
import torch  # noqa: E402

TORCH = time.perf_counter()
from rewild4d.rasterizer import rasterize  # noqa: E402


def compiled_kernels() -> int:
    """Return how many of our kernels this process compiled because numba's cache lacked them."""
    from numba.core.dispatcher import Dispatcher

    kernels = [each for each in gc.get_objects() if issubclass(type(each), Dispatcher)]  # resolves no lazy proxies
    ours = [each for each in kernels if each.py_func.__module__.startswith("rewild4d.")]
    return sum(sum(each.stats.cache_misses.values()) for each in ours)


def main(file: str) -> None:
    gaussians, world_to_camera, intrinsics, size = torch.load(file, weights_only=True)
    means, quats, scales, opacities, colors = (tensor.requires_grad_() for tensor in gaussians)
    begin = time.perf_counter()
    image, _, _ = rasterize(means, quats, scales, opacities, colors, world_to_camera, intrinsics, size, size)
    image.sum().backward()
    end = time.perf_counter()
    times = {"torch": TORCH - BEGIN, "after_torch": end - TORCH, "first_image": end - begin}
    print(json.dumps(times | {"compiled": compiled_kernels()}))


if __name__ == "__main__":
    main(sys.argv[1])
