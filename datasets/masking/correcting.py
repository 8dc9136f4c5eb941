"""Carry strokes to the image's edges: a random walker (Grady 2006), held to what was found without them."""

import cv2
import numpy as np
from scipy.sparse import csr_array, diags_array
from scipy.sparse.linalg import cg

PULL, EDGE = 0.001, 60.0
"""How strongly each pixel keeps its chance, and the squared difference of Lab colours at which neighbours part."""
LEAST = 1e-3
"""What joins neighbours of any colours."""
REACH = 60
"""Pixels around strokes in which they change a mask."""


def corrected(image: np.ndarray, chance: np.ndarray, said: np.ndarray) -> np.ndarray:
    """Return chances that strokes have changed: each stroke's change is carried to where the image has edges.

    The change c of a pixel minimises PULL c^2 plus, over its neighbours, exp(-|colours' difference|^2 / EDGE) times the
    squared difference of their changes; on strokes it is what makes the chance 1 or 0.

    Args:
        image: uint8 [h, w, 3], red, green, blue.
        chance: of each pixel to be the animal's, before, float32 [h, w].
        said: the marks, [h, w].

    Returns:
        float32 [h, w], 0 to 1.
    """
    if said.all() or not said.any():
        return np.where(said > 0, 1.0, np.where(said < 0, 0.0, chance)).astype(np.float32)
    left, top, width, height = cv2.boundingRect((said != 0).astype(np.uint8))
    near = np.s_[max(0, top - REACH) : top + height + REACH, max(0, left - REACH) : left + width + REACH]
    lab = cv2.cvtColor(image[near], cv2.COLOR_RGB2LAB).astype(np.float32)
    strokes = said[near]
    change = np.where(strokes == 0, 0.0, (strokes > 0) - chance[near]).ravel()
    equations, free = _equations(lab), np.flatnonzero(strokes == 0)
    inner = equations[free][:, free]
    wanted, scale = -(equations @ change)[free], diags_array(1 / inner.diagonal())
    change[free], _ = cg(inner, wanted, rtol=1e-2, maxiter=500, M=scale)
    found = chance.astype(np.float32)
    found[near] += change.reshape(strokes.shape)
    return found.clip(0, 1)


def _equations(lab: np.ndarray) -> csr_array:
    """Return the walker's equations on a grid of colours, [h, w, 3]: sparse, [h w, h w]."""
    height, wide = lab.shape[:2]
    across, down = np.zeros((height, wide)), np.zeros((height, wide))
    across[:, :-1] = np.exp(-((lab[:, 1:] - lab[:, :-1]) ** 2).sum(-1) / EDGE) + LEAST
    down[:-1] = np.exp(-((lab[1:] - lab[:-1]) ** 2).sum(-1) / EDGE) + LEAST
    total = PULL + across + down
    total[:, 1:] += across[:, :-1]
    total[1:] += down[:-1]
    sides, below = -across.ravel()[:-1], -down.ravel()[:-wide]
    places = (0, 1, -1, wide, -wide)
    return csr_array(diags_array([total.ravel(), sides, sides, below, below], offsets=places))
