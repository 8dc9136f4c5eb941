"""Write an animated, skinned glTF 2.0 binary (.glb): any 3D program plays it.

Every Gaussian is a flat, coloured square in the plane of its two longer axes. Influences are sorted by weight, so that
viewers that read the first four of each vertex lose as little as possible; all that count are in the file.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pygltflib
import torch
from numpy.typing import NDArray
from torch import Tensor

from rewild4d.contracts import Articulated
from rewild4d.files import atomic
from rewild4d.harmonics import base_colors
from rewild4d.transforms import matrix_to_quat, quat_to_matrix, split_similarity
from rewild4d.types import Splats

HALF_SIDE = 1.5
"""Half the side of a square in standard deviations of its Gaussian."""
SEEN = 0.1
"""Gaussians less opaque than this are left out: a square has no soft edge."""
NEGLIGIBLE = 1e-5
"""Influences below this weight are left out and the others scaled to one."""
FLOAT, SHORT, INT = 5126, 5123, 5125
VERTICES, INDICES = 34962, 34963


def write_glb(path: Path, reconstruction: Articulated, times: Sequence[float], name: str, copyright: str) -> None:
    """Write the canonical Gaussians of a reconstruction, its skeleton and its motion, atomically.

    Skinning the file gives object_to_world(t) sum_j w_j P_j(t) x, in the world: linear blend skinning, without any
    further deformation that the method has.

    Args:
        path: of the file.
        reconstruction: what is written.
        times: key times in seconds, strictly ascending in single precision, as glTF stores them.
        name: of the mesh.
        copyright: goes into the file.

    Raises:
        ValueError: times that do not ascend.
    """
    keys = torch.tensor(times, dtype=torch.float32)
    if not bool((keys[1:] > keys[:-1]).all()):
        raise ValueError(f"expected key times that ascend in single precision, got {list(times)}")
    splats, weights = _seen(reconstruction.canonical(), reconstruction.weights)
    pivots, parents = reconstruction.pivots.double().cpu(), reconstruction.parents.cpu().tolist()
    corners, faces, normals = squares(splats)
    joints, shares = influences(weights.double().cpu())
    builder = _Builder()
    attributes = {
        "POSITION": builder.add(corners.float().numpy(), VERTICES, bounds=True),
        "NORMAL": builder.add(normals.float().numpy(), VERTICES),
        "COLOR_0": builder.add(_linear_colors(splats).repeat_interleave(4, 0).float().numpy(), VERTICES),
    }
    for part in range(joints.shape[1] // 4):
        chosen = slice(4 * part, 4 * part + 4)
        rows = joints[:, chosen].repeat_interleave(4, 0).numpy().astype(np.uint16)
        attributes[f"JOINTS_{part}"] = builder.add(rows, VERTICES)
        attributes[f"WEIGHTS_{part}"] = builder.add(shares[:, chosen].repeat_interleave(4, 0).float().numpy(), VERTICES)
    indices = builder.add(faces.reshape(-1, 1).numpy().astype(np.uint32), INDICES)
    tree = _scene(builder, name, copyright, attributes, indices, pivots, parents)
    _animate(tree, builder, keys, *_motion(reconstruction, times))
    tree.buffers = [pygltflib.Buffer(byteLength=len(builder.data))]
    tree.bufferViews, tree.accessors = builder.views, builder.accessors
    tree.set_binary_blob(bytes(builder.data))
    with atomic(path) as temporary:
        temporary.write_bytes(b"".join(tree.save_to_bytes()))


def _motion(reconstruction: Articulated, times: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Return each bone's node (in its pivot at rest) in its parent's, [T, J, 4, 4], and object_to_world, [T, 4, 4]."""
    moved = [reconstruction.articulation(time) for time in times]
    transforms = torch.stack([bones.double().cpu() for bones, _ in moved])
    root = torch.stack([matrix.double().cpu() for _, matrix in moved])
    standing = transforms @ _translations(reconstruction.pivots.double().cpu())
    parents = reconstruction.parents.cpu().tolist()
    local = [
        standing[:, j] if p < 0 else torch.linalg.inv(standing[:, p]) @ standing[:, j] for j, p in enumerate(parents)
    ]
    return torch.stack(local, dim=1), root


def squares(splats: Splats) -> tuple[Tensor, Tensor, Tensor]:
    """Return Gaussians as squares: corners [4 n, 3], triangles [2 n, 3], unit normals of the corners [4 n, 3]."""
    order = splats.scales.argsort(dim=1, descending=True)
    axes = quat_to_matrix(splats.quats).transpose(1, 2)
    rows = torch.arange(len(splats), device=order.device)
    first, second = (axes[rows, order[:, k]] for k in (0, 1))
    lengths = splats.scales.gather(1, order)[:, :2, None] * HALF_SIDE
    u, v = first * lengths[:, 0], second * lengths[:, 1]
    corners = torch.stack([splats.means + a * u + b * v for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))], dim=1)
    normals = torch.linalg.cross(first, second)[:, None].expand(-1, 4, -1)
    start = 4 * torch.arange(len(splats))[:, None, None]
    faces = (start + torch.tensor(((0, 1, 2), (0, 2, 3)))).reshape(-1, 3)
    return corners.reshape(-1, 3).cpu(), faces, normals.reshape(-1, 3).cpu()


def influences(weights: Tensor) -> tuple[Tensor, Tensor]:
    """Return the joints that move each row of weights [n, J], most important first, in sets of four.

    Returns:
        Joint numbers (0 where the share is 0) and shares that sum to one, both [n, 4 k].
    """
    sorted_weights, joints = weights.sort(dim=1, descending=True)
    needed = int((sorted_weights > NEGLIGIBLE).sum(dim=1).max()) if len(weights) else 1
    width = 4 * -(-needed // 4)
    shares = torch.zeros(len(weights), width, dtype=weights.dtype)
    kept = sorted_weights[:, :width]
    shares[:, : kept.shape[1]] = torch.where(kept > NEGLIGIBLE, kept, 0.0)
    shares = shares / shares.sum(dim=1, keepdim=True)
    numbers = torch.zeros(len(weights), width, dtype=torch.int64)
    numbers[:, : kept.shape[1]] = joints[:, :width]
    return torch.where(shares > 0, numbers, 0), shares


def shown(splats: Splats) -> Tensor:
    """Return which Gaussians are opaque enough to become squares, bool [n]."""
    return splats.opacities >= SEEN


def _seen(splats: Splats, weights: Tensor) -> tuple[Splats, Tensor]:
    keep = shown(splats)
    parts = (splats.means, splats.quats, splats.scales, splats.opacities, splats.colors)
    return Splats(*(part[keep] for part in parts)), weights[keep]


def _linear_colors(splats: Splats) -> Tensor:
    """Return the colour without the view-dependent part, linear as glTF wants vertex colours, [n, 3]."""
    srgb = base_colors(splats).double().cpu()
    return torch.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)


def _translations(points: Tensor) -> Tensor:
    matrices = torch.eye(4, dtype=points.dtype).repeat(len(points), 1, 1)
    matrices[:, :3, 3] = points
    return matrices


class _Builder:
    """The binary part of a file as it grows."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[pygltflib.BufferView] = []
        self.accessors: list[pygltflib.Accessor] = []

    def add(self, values: NDArray[Any], target: int | None = None, bounds: bool = False) -> int:
        """Append an array [count, components] and give its accessor."""
        raw = np.ascontiguousarray(values).tobytes()
        self.views.append(pygltflib.BufferView(buffer=0, byteOffset=len(self.data), byteLength=len(raw), target=target))
        self.data += raw + b"\0" * (-len(raw) % 4)
        kinds = {1: "SCALAR", 3: "VEC3", 4: "VEC4", 16: "MAT4"}
        types = {np.dtype(np.float32): FLOAT, np.dtype(np.uint16): SHORT, np.dtype(np.uint32): INT}
        accessor = pygltflib.Accessor(
            bufferView=len(self.views) - 1, componentType=types[values.dtype], count=len(values),
            type=kinds[values.shape[1]],
        )  # fmt: skip
        if bounds:
            accessor.min, accessor.max = values.min(axis=0).tolist(), values.max(axis=0).tolist()
        self.accessors.append(accessor)
        return len(self.accessors) - 1


def _scene(
    builder: _Builder, name: str, copyright: str, attributes: dict[str, int], indices: int, pivots: Tensor,
    parents: list[int],
) -> pygltflib.GLTF2:  # fmt: skip
    """Return nodes: 0 the root, 1 to J the bones, then the mesh."""
    nodes = [pygltflib.Node(name="root", children=[])]
    for bone, parent in enumerate(parents):
        local = pivots[bone] - (pivots[parent] if parent >= 0 else 0)
        nodes.append(pygltflib.Node(name=f"bone_{bone:02d}", translation=local.tolist(), children=[]))
    for bone, parent in enumerate(parents):  # a parent may come after its child
        nodes[parent + 1].children.append(bone + 1)
    nodes.append(pygltflib.Node(name=name, mesh=0, skin=0))
    binds = _translations(-pivots).transpose(1, 2).reshape(-1, 16).float().numpy()  # column by column
    primitive = pygltflib.Primitive(attributes=pygltflib.Attributes(**attributes), indices=indices, material=0, mode=4)
    material = pygltflib.Material(
        doubleSided=True, pbrMetallicRoughness=pygltflib.PbrMetallicRoughness(metallicFactor=0.0, roughnessFactor=1.0)
    )
    skin = pygltflib.Skin(joints=list(range(1, len(parents) + 1)), inverseBindMatrices=builder.add(binds), skeleton=0)
    return pygltflib.GLTF2(
        asset=pygltflib.Asset(version="2.0", generator="rewild4d", copyright=copyright or None), scene=0,
        scenes=[pygltflib.Scene(nodes=[0, len(nodes) - 1])], nodes=nodes, skins=[skin], materials=[material],
        meshes=[pygltflib.Mesh(name=name, primitives=[primitive])],
    )  # fmt: skip


def _animate(tree: pygltflib.GLTF2, builder: _Builder, times: Tensor, joints: Tensor, root: Tensor) -> None:
    """Add one animation: the root's similarity and every bone's rigid motion."""
    keys = builder.add(times.numpy()[:, None], bounds=True)
    clip = pygltflib.Animation(name="motion", samplers=[], channels=[])

    def channel(node: int, path: str, values: Tensor) -> None:
        output = builder.add(values.float().numpy())
        clip.samplers.append(pygltflib.AnimationSampler(input=keys, output=output, interpolation="LINEAR"))
        target = pygltflib.AnimationChannelTarget(node=node, path=path)
        clip.channels.append(pygltflib.AnimationChannel(sampler=len(clip.samplers) - 1, target=target))

    parts = [split_similarity(matrix) for matrix in root]
    channel(0, "scale", torch.stack([scale.expand(3) for scale, _, _ in parts]))
    channel(0, "rotation", _steady(matrix_to_quat(torch.stack([rotation for _, rotation, _ in parts]))))
    channel(0, "translation", root[:, :3, 3])
    for bone in range(joints.shape[1]):
        channel(bone + 1, "rotation", _steady(matrix_to_quat(joints[:, bone, :3, :3])))
        channel(bone + 1, "translation", joints[:, bone, :3, 3])
    tree.animations = [clip]


def _steady(quats: Tensor) -> Tensor:
    """Return xyzw quaternions whose signs do not jump between keys, from wxyz ones, [T, 4]."""
    signs = torch.ones(len(quats), 1, dtype=quats.dtype)
    dots = (quats[1:] * quats[:-1]).sum(dim=1)
    signs[1:, 0] = torch.where(dots < 0, -1.0, 1.0).to(quats).cumprod(dim=0)
    return (quats * signs)[:, (1, 2, 3, 0)]
