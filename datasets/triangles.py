"""Draw points on triangles, uniform by area."""

import numpy as np
from numpy.typing import NDArray


def draw(
    vertices: NDArray[np.float64], faces: NDArray[np.int64], count: int, rng: np.random.Generator
) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Draw points on a mesh by area.

    Args:
        vertices: [v, 3].
        faces: vertex indices, at least one triangle with an area, [f, 3].
        count: points to draw.
        rng: of the draws.

    Returns:
        The triangle of each point, [count], and the weights of its three corners, [count, 3].

    Raises:
        ValueError: no triangle has an area.
    """
    corners = vertices[faces]
    cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    ends = np.cumsum(np.linalg.norm(cross, axis=1))
    if not len(ends) or not 0 < ends[-1] < np.inf:
        raise ValueError(f"expected triangles with an area, got {len(ends)} triangles without")
    chosen = np.searchsorted(ends, rng.random(count) * ends[-1], side="right").clip(max=len(ends) - 1)
    root, along = np.sqrt(rng.random(count)), rng.random(count)
    return chosen, np.stack((1 - root, root * (1 - along), root * along), axis=1)
