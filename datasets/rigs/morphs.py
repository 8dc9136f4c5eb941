"""Morph targets of glTF meshes: displacements of the vertices, mixed by weights that may change over time."""

import numpy as np

from rewild4d.datasets.rigs.gltf import Document, Floats, sample
from rewild4d.datasets.rigs.gltf_file import Part

STILL = 1e-4
"""Of the mesh's size: morph targets that move vertices by less keep still."""


def target_offsets(document: Document, primitive: Part) -> Floats:
    """Return displacements of each morph target of a primitive, zero where it moves nothing, [targets, n, 3]."""
    count = document.count(primitive.attributes.POSITION, len(primitive.targets or []))
    offsets = np.zeros((len(primitive.targets or []), count, 3))
    for row, target in enumerate(primitive.targets or []):
        accessor = target.get("POSITION") if isinstance(target, dict) else getattr(target, "POSITION", None)
        if accessor is not None:
            offsets[row] = document.floats(accessor)
    return offsets


def target_weights(document: Document, animation: int, node: int, targets: int, times: Floats) -> Floats:
    """Return weights of a node's morph targets: the animation's, else the node's own, else its mesh's, [T, targets]."""
    if not targets:
        return np.zeros((len(times), 0))
    clip = document.tree.animations[animation]
    for channel in clip.channels:
        if channel.target.node == node and channel.target.path == "weights":
            sampler = clip.samplers[channel.sampler]
            keys = document.floats(sampler.input)[:, 0]
            values = document.floats(sampler.output).reshape(-1, targets)
            return sample(keys, values, sampler.interpolation, times, False)
    still = document.node_weights(node) or document.tree.meshes[document.tree.nodes[node].mesh].weights
    return np.tile(np.array(still or [0.0] * targets)[:targets], (len(times), 1))


def still_offsets(document: Document, animation: int, node: int, primitive: Part, times: Floats) -> Floats | float:
    """Return what the morph targets of a primitive add to its vertices all through a clip, [n, 3]; 0 without any.

    Raises:
        UserError: the clip changes them: bones and voxels cannot hold that.
    """
    offsets = target_offsets(document, primitive)
    if not len(offsets):
        return 0.0
    weights = target_weights(document, animation, node, len(offsets), times)
    size = float(np.ptp(document.floats(primitive.attributes.POSITION), axis=0).max())
    moved = float(np.abs(np.einsum("tk,knd->tnd", weights - weights[:1], offsets)).max())
    if moved > STILL * size:
        clip = document.tree.animations[animation].name or f"clip_{animation}"
        raise document.error(
            f"expected an animal that bones alone move, but clip '{clip}' changes morph targets, by up to "
            f"{moved / max(size, 1e-12):.2g} of the mesh's size"
        )
    return np.einsum("k,knd->nd", weights[0], offsets)
