"""Select the camera of each frame; everything that is not selected for the method is held out."""

import numpy as np

from rewild4d.contracts import Selection

PLACEMENT_AZIMUTHS = {"side": 90.0, "oblique": 45.0, "frontal": 0.0}
"""Degrees between the viewing direction and the long axis of the animal, both in the horizontal plane."""


def selected_views(frames: int, views: int, selection: Selection, fixed_view: int = 0) -> list[int]:
    """Return the view that the method sees at each kept frame.

    Args:
        frames: number of kept frames.
        views: number of cameras.
        selection: "sweep" takes view (i * step) mod views at kept frame i, "random" draws one seeded view a frame.
        fixed_view: the view of "fixed".
    """
    if selection.cameras == "fixed":
        return [fixed_view] * frames
    if selection.cameras == "sweep":
        return [(index * selection.step) % views for index in range(frames)]
    return np.random.default_rng(selection.seed).integers(views, size=frames).tolist()


def held_out(selected: list[int], views: int) -> list[tuple[int, int]]:
    """Return all (kept frame, view) pairs that the method does not see, in the order of time."""
    return [(frame, view) for frame, seen in enumerate(selected) for view in range(views) if view != seen]


def up_direction(camera_to_world: np.ndarray) -> np.ndarray:
    """Return the world's up, from the cameras alone, unit [3].

    Cameras that are not rolled have horizontal x axes whatever their elevation, so up is the direction most orthogonal
    to all of them, on the side of the images' upper edges. Where the x axes are parallel it is the mean upper edge.

    Args:
        camera_to_world: OpenCV axes, [V, 4, 4].
    """
    rights, uppers = camera_to_world[:, :3, 0], -camera_to_world[:, :3, 1]
    mean_upper = uppers.mean(axis=0)
    spread, axes = np.linalg.eigh(rights.T @ rights / len(rights))
    up = axes[:, 0] if spread[1] > 1e-3 else mean_upper
    up = up if up @ mean_upper >= 0 else -up
    return up / np.linalg.norm(up)


def placed_view(placement: str, points: np.ndarray, camera_to_world: np.ndarray) -> int:
    """Return the camera that stands at a named place relative to the animal.

    The animal's long axis is the first principal axis of its points in the horizontal plane; head and tail are not told
    apart. Every camera has an azimuth (0 to 90 degrees from that axis) and an elevation above the cameras' median; the
    chosen one is nearest on that map to (the placement's azimuth, 0), the lowest index among equals.

    Args:
        placement: a key of `PLACEMENT_AZIMUTHS`.
        points: points of the animal in the world, [n, 3].
        camera_to_world: OpenCV axes, [V, 4, 4].
    """
    up = up_direction(camera_to_world)
    flat = points - points.mean(axis=0)
    flat = flat - np.outer(flat @ up, up)
    long_axis = np.linalg.eigh(flat.T @ flat)[1][:, 2]
    looking = points.mean(axis=0) - camera_to_world[:, :3, 3]
    rise = looking @ up
    along = looking @ long_axis
    across = looking @ np.cross(up, long_axis)
    azimuth = np.degrees(np.arctan2(np.abs(across), np.abs(along)))
    elevation = np.degrees(np.arctan2(-rise, np.hypot(along, across)))
    distance = np.hypot(azimuth - PLACEMENT_AZIMUTHS[placement], elevation - np.median(elevation))
    return int(np.argmin(np.round(distance, 6)))
