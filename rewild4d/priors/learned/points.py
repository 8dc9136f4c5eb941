"""Points of the body that the network finds, and the template's bones that carry them."""

import numpy as np

from rewild4d.priors.landmarks import LANDMARKS

NAMES = tuple(name for name in LANDMARKS if name not in ("jaw", "eye"))
"""Points of `LANDMARKS`."""
SPINE = NAMES[:9]
"""Those that animals on two legs have too."""
MIRRORED = {
    name: name.replace("_left_", "_?_").replace("_right_", "_left_").replace("_?_", "_right_") for name in NAMES
}
"""The point of the other side by name; its own for points on the spine."""
OTHER_SIDE = [NAMES.index(name) for name in MIRRORED.values()]
"""Row of the point of the other side of each of `NAMES`."""
ROOT = tuple(NAMES.index(name) for name in ("withers", "hips"))


def root_of(points: np.ndarray) -> np.ndarray:
    """Return the middle of withers and hips, [..., L, 3] -> [..., 3]."""
    return np.asarray(points[..., ROOT, :].mean(axis=-2))
