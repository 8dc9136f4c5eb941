"""An animated glTF file as meshes: skinned, with morph targets, or rigid parts that move."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rewild4d.datasets.rigs.animal import Surface
from rewild4d.datasets.rigs.colors import baked
from rewild4d.datasets.rigs.gltf import Document, Floats, consistent
from rewild4d.datasets.rigs.morphs import target_offsets, target_weights
from rewild4d.datasets.rigs.reader import clips, influences, inverse_binds, read_surface
from rewild4d.errors import UserError
from rewild4d.io.meshes import Mesh


def read_animation(path: Path, times: Sequence[float]) -> list[list[Mesh]]:
    """The parts of an animated file at the moments of a video: its clip begins at the first and ends at the last.

    Args:
        path: a .glb or .gltf file with one animation.
        times: of the moments in seconds on the video's clock, ascending.

    Returns:
        For each moment its parts; a part keeps its place in the list.

    Raises:
        UserError: no glTF, not exactly one animation, or nothing that could be seen.
    """
    names = clips(path)
    if len(names) != 1:
        raise UserError(f"{path}: expected one animation, got {', '.join(names) or 'none'}.")
    clock = np.asarray(times, np.float64) - times[0]
    shares = clock / max(clock[-1], 1e-9)
    with consistent(path):
        return _moments(Document(path), path, names[0], shares)


def _moments(document: Document, path: Path, clip: str, shares: Floats) -> list[list[Mesh]]:
    start, end = document.clip_range(0)
    moments = start + (end - start) * shares
    world = document.global_matrices(document.local_matrices(0, moments))
    parts = [part for index in document.scene_nodes() for part in _parts(document, index, moments, world)]
    if not parts:
        raise UserError(f"{path}: expected a mesh, but the file's scene has none.")
    if not all(bool(torch.isfinite(mesh.vertices).all()) for part in parts for mesh in part):
        raise UserError(f"{path}: expected a mesh of some size in every pose, but scales or turns of it are zero.")
    return [[part[frame] for part in parts] for frame in range(len(shares))]


def _parts(document: Document, index: int, times: Floats, world: Floats) -> list[list[Mesh]]:
    """Return the triangle primitives of one node, each as its meshes over time; world holds all nodes' matrices."""
    node = document.tree.nodes[index]
    if node.mesh is None:
        return []
    bones = world[:, index, None] if node.skin is None else _bones(document, node.skin, world)
    parts = []
    for primitive in document.tree.meshes[node.mesh].primitives:
        if primitive.mode not in (None, 4, 5, 6):
            continue
        count = document.count(primitive.attributes.POSITION)
        rigid = np.zeros((count, 1), np.int64), np.ones((count, 1))
        bound = rigid if node.skin is None else influences(document, primitive, bones.shape[1])
        surface = baked(read_surface(document, primitive, np.eye(4), *bound))
        targets = target_offsets(document, primitive)
        offsets = np.einsum("tk,knd->tnd", target_weights(document, 0, index, len(targets), times), targets)
        shapes = (replace(surface, vertices=surface.vertices + each) for each in offsets)
        parts.append([_mesh(surface, shape.posed(each)) for shape, each in zip(shapes, bones, strict=True)])
    return parts


def _bones(document: Document, skin: int, world: Floats) -> Floats:
    """Return the skinning matrices of a skin, mesh space -> world, [T, joints, 4, 4]."""
    return world[:, document.tree.skins[skin].joints] @ inverse_binds(document, skin)


def _mesh(surface: Surface, points: Floats) -> Mesh:
    """Convert a surface of the rig reader at one moment; its texture coordinates begin at the upper left corner."""
    uv: Tensor | None = None
    texture: Tensor | None = None
    if surface.uv is not None and surface.texture is not None:
        corners = torch.from_numpy(surface.uv)[torch.from_numpy(surface.faces)].float()
        uv = torch.stack((corners[..., 0], 1 - corners[..., 1]), dim=-1)
        texture = torch.from_numpy(surface.texture).float() / 255
    vertices, faces = torch.from_numpy(points).float(), torch.from_numpy(surface.faces)
    return Mesh(vertices, faces, torch.from_numpy(surface.colors).float(), uv, texture)
