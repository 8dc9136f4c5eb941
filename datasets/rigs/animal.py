"""An animated, skinned animal in memory: what a rig file or the procedural builder gives and the studio renders.

Posed by plain linear blend skinning: x_t = sum_k w_k T_{b_k}(t) x with T_b(t) = bones[t, b] @ inv(bones_rest[b]),
weights as given. All matrices act on column vectors; world units and axes are the animal's own.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Glow:
    """Light that a surface sends out, added to what it reflects.

    Attributes:
        color: linear light, multiplied with the texture where there is one, float64, [3].
        uv: texture coordinates as `Surface.uv`; or None.
        texture: sRGB, uint8, [h, w, 3]; or None.
    """

    color: NDArray[np.float64]
    uv: NDArray[np.float64] | None = None
    texture: NDArray[np.uint8] | None = None


@dataclass(frozen=True)
class Surface:
    """One triangle mesh with one material.

    Attributes:
        vertices: rest pose in world units, float64, [n, 3].
        faces: vertex indices, int64, [f, 3].
        bone_indices: the bones that move each vertex, int64, [n, K].
        bone_weights: their weights, each row sums to one, float64, [n, K].
        colors: sRGB in [0, 1] per vertex, multiplied with the texture where there is one, float64, [n, 3].
        uv: texture coordinates, (0, 0) = the texture's upper left corner, repeated outside [0, 1],
            float64, [n, 2]; or None.
        texture: sRGB, uint8, [h, w, 3]; or None.
        lit: whether the studio's light shades it.
        glow: light of its own; or None.
    """

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    bone_indices: NDArray[np.int64]
    bone_weights: NDArray[np.float64]
    colors: NDArray[np.float64]
    uv: NDArray[np.float64] | None = None
    texture: NDArray[np.uint8] | None = None
    lit: bool = True
    glow: Glow | None = None

    def posed(self, transforms: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the world vertices under the skinning transforms [J, 4, 4] of one moment, [n, 3]."""
        blended = np.einsum("nk,nkab->nab", self.bone_weights, transforms[self.bone_indices, :3])
        return np.einsum("nab,nb->na", blended[..., :3], self.vertices) + blended[..., 3]


@dataclass(frozen=True)
class AnimatedAnimal:
    """An animal that performs one motion.

    Attributes:
        name: of the animal; one folder name.
        species: free text, for reports only.
        licence: of the model.
        surfaces: everything that is visible.
        bone_names: [J].
        parents: parent of each bone, -1 for a root, int64, [J].
        bones_rest: bone-to-world matrices of the rest pose, float64, [J, 4, 4].
        bones: global (not local) bone-to-world matrices of each frame, float64, [T, J, 4, 4].
        fps: frames per second.
        motion: name of the motion; one folder name.
        up: unit vector that points up in the world, float64, [3].
    """

    name: str
    species: str
    licence: str
    surfaces: tuple[Surface, ...]
    bone_names: tuple[str, ...]
    parents: NDArray[np.int64]
    bones_rest: NDArray[np.float64]
    bones: NDArray[np.float64]
    fps: float
    motion: str
    up: NDArray[np.float64]

    @property
    def transforms(self) -> NDArray[np.float64]:
        """Skinning transforms T_b(t), rest -> posed, [T, J, 4, 4]."""
        return self.bones @ np.linalg.inv(self.bones_rest)

    def posed(self, frame: int) -> list[NDArray[np.float64]]:
        """Return the world vertices of every surface at one frame, each [n, 3]."""
        transforms = self.bones[frame] @ np.linalg.inv(self.bones_rest)
        return [surface.posed(transforms) for surface in self.surfaces]
