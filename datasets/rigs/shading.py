"""One ray-cast, anti-aliased picture of a posed animal."""

from collections.abc import Sequence

import cv2
import numpy as np
from embreex.mesh_construction import TriangleMesh
from embreex.rtcore_scene import EmbreeScene
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

from rewild4d.datasets.rigs.animal import Glow, Surface
from rewild4d.datasets.rigs.colors import added, srgb_to_linear
from rewild4d.datasets.rigs.voxels import barycentric
from rewild4d.types import Camera

SAMPLES = 3
"""Rays per pixel along each axis."""

AMBIENT, SKY, SUN = 0.70, 0.15, 0.15
"""Shading factor = AMBIENT + SKY * (how far the normal points up) + SUN * (how far it faces the sun): 0.70 to 1.0.

Mild on purpose, since the methods fit a colour that does not change with the pose; without shadows for the same reason.
"""

SUN_ALONG, SUN_UP = 0.5, 0.87
"""Direction of the sun: 60 degrees above the horizon, along the first camera's axis."""

DILATION = 5
"""Pixels of the window that carries colour past the silhouette, so that resizing straight colour makes no dark rim."""


def raycaster(vertices: Sequence[NDArray[np.float64]], surfaces: Sequence[Surface]) -> EmbreeScene:
    """Return the scene of the surfaces with the given vertices (each [n, 3]); geometry id = index of the surface."""
    scene = EmbreeScene(robust=True)
    for points, surface in zip(vertices, surfaces, strict=True):
        TriangleMesh(scene, points.astype(np.float32), surface.faces.astype(np.int32))
    return scene


class Picture:
    """The animal at one moment, ready to be seen by many cameras.

    Args:
        scene: ray caster with one geometry per surface, in coordinates relative to `origin`.
        surfaces: colours and textures.
        extent: relative coordinates that bound the animal in every image (its posed vertices), [n, 3].
        origin: of the relative coordinates in the world, [3].
        up: unit vector, [3].
        sun: unit vector towards the light, [3].
    """

    def __init__(
        self,
        scene: EmbreeScene,
        surfaces: Sequence[Surface],
        extent: NDArray[np.float64],
        origin: NDArray[np.float64],
        up: NDArray[np.float64],
        sun: NDArray[np.float64],
    ) -> None:
        self.scene, self.surfaces, self.extent = scene, surfaces, extent
        self.origin, self.up, self.sun = origin, up, sun

    def render(self, camera: Camera) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
        """Straight sRGB colour [h, w, 3] and matte [h, w], area averages over SAMPLES x SAMPLES rays a pixel."""
        rgb = np.zeros((camera.height, camera.width, 3), np.float32)
        alpha = np.zeros((camera.height, camera.width), np.float32)
        left, top, right, bottom = self._window(camera)
        if right > left and bottom > top:
            rays = self._rays(camera, left, top, right, bottom)
            where, color = self._cast(rays)
            pixel, count = where % ((bottom - top) * (right - left)), (bottom - top) * (right - left)
            sums = [np.bincount(pixel, channel, count) for channel in (*color.T, np.ones(len(pixel)))]
            window = np.stack(sums, axis=1).reshape(bottom - top, right - left, 4) / SAMPLES**2
            rgb[top:bottom, left:right], alpha[top:bottom, left:right] = window[..., :3], window[..., 3]
        return _straight(rgb, alpha), np.round(alpha * 255).astype(np.uint8)

    def _window(self, camera: Camera) -> tuple[int, int, int, int]:
        """Return the pixel rectangle (left, top, right, bottom; the last two exclusive) that holds the animal."""
        world_to_camera, intrinsics = camera.world_to_camera.numpy(), camera.intrinsics.numpy()
        local = (self.extent + self.origin) @ world_to_camera[:3, :3].T + world_to_camera[:3, 3]
        if (local[:, 2] <= 0).any():
            return 0, 0, camera.width, camera.height
        image = local @ intrinsics.T
        image = image[:, :2] / image[:, 2:]
        size = (camera.width, camera.height)
        low = np.clip(np.floor(image.min(0)) - 1, 0, size).astype(int)
        high = np.clip(np.ceil(image.max(0)) + 1, 0, size).astype(int)
        return int(low[0]), int(low[1]), int(high[0]), int(high[1])

    def _rays(self, camera: Camera, left: int, top: int, right: int, bottom: int) -> NDArray[np.float32]:
        """Origins and directions of all rays of a window: every pixel once, for one sample after the other, [n, 6]."""
        world_to_camera = camera.world_to_camera.numpy()
        inner = (np.arange(SAMPLES) + 0.5) / SAMPLES
        u = np.arange(left, right) + inner[:, None, None]
        v = np.arange(top, bottom)[:, None] + inner[:, None, None, None]
        to_world = world_to_camera[:3, :3].T @ np.linalg.inv(camera.intrinsics.numpy())
        rays = np.empty((SAMPLES, SAMPLES, bottom - top, right - left, 6), np.float32)
        rays[..., :3] = camera.center.numpy() - self.origin
        for axis in range(3):
            rays[..., 3 + axis] = u * to_world[axis, 0] + (v * to_world[axis, 1] + to_world[axis, 2])
        return rays.reshape(-1, 6)

    def _cast(self, rays: NDArray[np.float32]) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """Return which rays hit the animal, [m], and the shaded colour that they see, [m, 3]."""
        answer = self.scene.run(rays[:, :3], rays[:, 3:], query="INTERSECT", output=True)
        where = np.flatnonzero(answer["primID"] >= 0)
        geometry, primitive = answer["geomID"][where], answer["primID"][where]
        share = barycentric(np.stack((answer["u"][where], answer["v"][where]), axis=1))
        color = np.empty((len(where), 3), np.float32)
        shade = self._shade(answer["Ng"][where], rays[where, 3:])[:, None]
        for number, surface in enumerate(self.surfaces):
            mine = np.flatnonzero(geometry == number)
            if len(mine):
                corners = surface.faces[primitive[mine]]
                color[mine] = _albedo(surface, corners, share[mine])
                if surface.lit:
                    color[mine] *= shade[mine]
                if surface.glow is not None:
                    color[mine] = added(color[mine].astype(np.float64), _emitted(surface.glow, corners, share[mine]))
        return where, color

    def _shade(self, normals: NDArray[np.float32], directions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return the factor in [0.7, 1] from the flat normals, turned towards the viewer, [n]."""
        away = np.einsum("na,na->n", normals, directions)
        length = np.sqrt(np.einsum("na,na->n", normals, normals))
        sign = np.where(away > 0, -1.0, 1.0) / np.maximum(length, 1e-20)
        axes = np.stack((self.up, self.sun), axis=1).astype(np.float32)
        above, lit = (normals @ axes).T * sign.astype(np.float32)
        return AMBIENT + SKY * (0.5 + 0.5 * above) + SUN * np.maximum(lit, 0.0)


def _albedo(surface: Surface, corners: NDArray[np.int64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the unshaded colour at points of triangles, [n, 3]."""
    if (surface.colors == surface.colors[0]).all():  # flat, which is common and cheap
        color = surface.colors[:1]
    else:
        color = np.einsum("nk,nkc->nc", share, surface.colors[corners])
    if surface.texture is None or surface.uv is None:
        return color
    return color * sample_texture(surface.texture, np.einsum("nk,nkc->nc", share, surface.uv[corners]))


def _emitted(glow: Glow, corners: NDArray[np.int64], share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the linear light that points of triangles send out, [n, 3]."""
    if glow.texture is None or glow.uv is None:
        return np.tile(glow.color, (len(corners), 1))
    uv = np.einsum("nk,nkc->nc", share, glow.uv[corners])
    return glow.color * srgb_to_linear(sample_texture(glow.texture, uv))


def sample_texture(texture: NDArray[np.uint8], uv: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the bilinear lookup in a repeated texture; (0, 0) is its upper left corner, [n, 2] -> [n, 3] in [0, 1]."""
    height, width = texture.shape[:2]
    place = uv[:, ::-1].T * ((height,), (width,)) - 0.5
    channels = [map_coordinates(texture[..., k], place, np.float64, order=1, mode="grid-wrap") for k in range(3)]
    return np.stack(channels, axis=1) / 255.0


def _straight(premultiplied: NDArray[np.float32], alpha: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Return un-premultiplied colour, carried a little past the silhouette, black beyond, [h, w, 3]."""
    spread = cv2.blur(np.dstack((premultiplied, alpha)), (DILATION, DILATION))
    color = np.where(alpha[..., None] > 0, premultiplied, spread[..., :3])
    weight = np.where(alpha > 0, alpha, spread[..., 3])[..., None]
    straight = np.divide(color, weight, out=np.zeros_like(color), where=weight > 1e-6)
    return np.round(np.clip(straight, 0.0, 1.0) * 255).astype(np.uint8)
