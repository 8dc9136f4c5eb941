"""Fit the template to films of random animals whose camera goes half around them, and measure headings (headings.md).

python docs/experiments/turns.py 1 3 5 8 13 14 18 20       # seeds of the zoo, 0 to 99 for development
"""

import sys

import numpy as np
import torch
from torch import Tensor

from rewild4d.datasets.builtin.zoo import animals
from rewild4d.datasets.rigs.studio import camera_ring, picture
from rewild4d.priors.bodies.quadruped import QUADRUPED
from rewild4d.priors.config import FOOTAGE
from rewild4d.priors.footage import fit_footage
from rewild4d.priors.heading.network import wrapped
from rewild4d.priors.heading.weights import package_weights
from rewild4d.priors.trained import Trained
from rewild4d.types import Clip, Frame

COUNT, RATE, WIDTH, HEIGHT = 32, 24.0, 256, 192
RING = 72
"""Cameras around each animal."""
GOES, COMES = 10, 18
"""Frames between which the camera goes on."""


def film(seed: int) -> tuple[Clip, Tensor]:
    """Return a film of an animal and its headings in the camera's axes, x to the right and z to it, radians, [T]."""
    animal, random = animals.build(seed, COUNT), np.random.default_rng(seed)
    posed = np.stack([np.concatenate(animal.posed(t))[::5] for t in range(COUNT)])
    ring = camera_ring(posed, animal.up, RING, WIDTH, HEIGHT)
    start, side = int(random.integers(RING)), 1 if random.random() < 0.5 else -1
    ways = np.interp(np.arange(COUNT), (GOES, COMES), (0, side * RING // 2)).round().astype(int)
    rear, front = (animal.bones[:, animal.bone_names.index(name), :3, 3] for name in ("spine.0", "neck.0"))
    frames, headings = [], []
    for t, way in enumerate(ways):
        camera = ring[(start + way) % RING]
        rgb, alpha = picture(animal, t).render(camera)
        mask = torch.from_numpy(alpha)[None].float() / 255
        frames.append(Frame(t / RATE, None, torch.from_numpy(rgb).permute(2, 0, 1).float() / 255 * mask, mask))
        view = camera.world_to_camera[:3, :3].numpy()
        ahead, up = view @ (front[t] - rear[t]), view @ animal.up
        ahead = ahead - (ahead @ up) * up
        headings.append(np.arctan2(ahead[0], -ahead[2]))
    return Clip(f"zoo/{seed}", "zoo", tuple(frames), RATE, "CC0", ""), torch.tensor(headings)


def errors(seed: int) -> Tensor:
    """Return how far the fit's headings are from the true ones, degrees, [T]."""
    clip, true = film(seed)
    prior = fit_footage(
        clip, config=FOOTAGE, seed=0, log=lambda *_: None, trained=Trained(headings=package_weights()),
        bodies=(QUADRUPED,),
    )  # fmt: skip
    ahead = torch.stack([camera.world_to_camera[:3, 2] for camera in prior.cameras])
    return wrapped(torch.atan2(ahead[:, 0], -ahead[:, 2]) - true).abs().rad2deg()


if __name__ == "__main__":
    for seed in map(int, sys.argv[1:]):
        found = errors(seed)
        print(
            f"{seed}: median {found.median():.0f}, mean {found.mean():.0f}, above 90: {(found > 90).sum()}", flush=True
        )
