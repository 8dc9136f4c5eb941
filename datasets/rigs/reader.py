"""A skinned, animated glTF file as an `AnimatedAnimal`.

Read: triangle primitives with skins, flat colours, vertex colours and base colour textures; light that materials send
out; unskinned meshes that hang from a joint, directly or through other nodes; node animation; morph targets that keep
still. Both sides of every face are drawn. Materials that one sees through are refused; static scenery is left out.
"""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rewild4d.datasets.rigs.animal import AnimatedAnimal, Surface
from rewild4d.datasets.rigs.colors import (
    base_color,
    base_texture,
    glow_of,
    linear_to_srgb,
    require_opaque,
    whole_range,
)
from rewild4d.datasets.rigs.gltf import Document, Floats, consistent
from rewild4d.datasets.rigs.gltf_file import Part
from rewild4d.datasets.rigs.morphs import still_offsets
from rewild4d.errors import UserError, unknown_name
from rewild4d.files import digest

TRIANGLES, STRIP, FAN = 4, 5, 6


def clips(path: Path) -> list[str]:
    """Return names of the animations of a rig file, in the file's order.

    Unnamed ones are called clip_<index>; one that has the name of an earlier one gets _<index> behind it.

    Raises:
        UserError: the file is missing or is no glTF.
    """
    with consistent(path):
        return _clip_names(Document(path))


def content(path: Path) -> str:
    """Return the digest of a rig file and of the files beside it that it names: the same for every copy of the rig.

    Raises:
        UserError: the file is missing or is no glTF, or a file beside it is missing.
    """
    with consistent(path):
        return digest(path.read_bytes(), *Document(path).beside())[:16]


def load_rig(path: Path, clip: str, frames: int = 24, shares: Floats | None = None) -> AnimatedAnimal:
    """Read one animation of a rig.

    Args:
        path: a .glb or .gltf file.
        clip: which animation, one of `clips(path)`.
        frames: how many moments to sample, evenly over [start, end): a looping clip does not repeat its first pose.
        shares: of the way from start to end, ascending: sample there instead, of a clip that does not loop, [T].

    Returns:
        The animal in the file's own world (metres by the specification, +y up).

    Raises:
        UserError: the file is missing or no glTF, contradicts itself, holds no skinned mesh, has no such clip, or the
            clip changes morph targets.
    """
    shares = np.arange(frames) / frames if shares is None else shares
    with consistent(path):
        animal = _read_rig(path, clip, shares)
        if not any(len(surface.faces) for surface in animal.surfaces):
            raise UserError(f"{path}: expected a mesh of triangles, but the file has none.")
        points = np.concatenate([surface.vertices for surface in animal.surfaces])
        posed = (np.concatenate(animal.posed(frame)) for frame in range(len(shares)))
        if not all(np.isfinite(each).all() for each in (points, *posed)) or not np.ptp(points, axis=0).any():
            raise UserError(f"{path}: expected a mesh of some size in every pose, but scales or turns of it are zero.")
    return animal


def _read_rig(path: Path, clip: str, shares: Floats) -> AnimatedAnimal:
    document = Document(path)
    names = _clip_names(document)
    visible = document.scene_nodes()
    nodes = document.tree.nodes
    skinned = [i for i in visible if nodes[i].mesh is not None and nodes[i].skin is not None]
    if not skinned:
        raise document.error("expected a skinned mesh, but the file has none")
    if clip not in names:
        raise document.error(str(unknown_name("clip", clip, names)).removesuffix("."))
    animation = names.index(clip)
    start, end = document.clip_range(animation)
    times = start + (end - start) * shares
    skeleton = _Skeleton(document, animation, times)
    surfaces = [surface for index in skinned for surface in _skinned_surfaces(document, skeleton, index)]
    for index in visible:
        if nodes[index].mesh is not None and nodes[index].skin is None:
            surfaces += _attached_surfaces(document, skeleton, index)
    bones = document.global_matrices(document.local_matrices(animation, times))[:, skeleton.nodes]
    return skeleton.sorted(
        AnimatedAnimal(
            name=_folder_name(path.stem),
            species=path.stem,
            licence=document.tree.asset.copyright or f"that of the rig file {path.name}",
            surfaces=tuple(surfaces),
            bone_names=tuple(nodes[i].name or f"node_{i}" for i in skeleton.nodes),
            parents=skeleton.parents(),
            bones_rest=np.stack(skeleton.rest),
            bones=bones,
            fps=len(times) / (end - start) if end > start else 24.0,
            motion=_folder_name(clip),
            up=np.array([0.0, 1.0, 0.0]),
        )
    )


def _clip_names(document: Document) -> list[str]:
    names: dict[str, None] = {}  # in order
    for index, clip in enumerate(document.tree.animations):
        name = clip.name or f"clip_{index}"
        while name in names:
            name = f"{name}_{index}"
        names[name] = None
    return list(names)


def _folder_name(name: str) -> str:
    """Return the name with everything that a folder or a space-separated list cannot hold replaced."""
    return re.sub(r"[^\w.-]+", "_", name).strip("._") or "unnamed"


@dataclass
class _Skeleton:
    """Bones as they are gathered from skins and attached parts: bone b is node nodes[b] with rest[b].

    The bones of a node are bones[node]; of a skin, what moves its mesh into the world and its bones are skins[skin].
    """

    document: Document
    animation: int
    times: Floats
    nodes: list[int] = field(default_factory=list)
    rest: list[Floats] = field(default_factory=list)
    bones: dict[int, list[int]] = field(default_factory=dict)
    skins: dict[int, tuple[Floats, NDArray[np.int64]]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.local = self.document.local_matrices(None, np.zeros(1))[0]
        self.default = self.document.global_matrices(self.local[None])[0]
        channels = self.document.tree.animations[self.animation].channels
        self.animated = {channel.target.node for channel in channels} - {None}

    def add(self, node: int, rest: Floats) -> int:
        """Return the index of the bone of a node with this rest matrix, new where there is none.

        Two skins may bind one joint differently; then it becomes two bones, and the skinning stays exact.
        """
        known = self.bones.setdefault(node, [])
        for bone in known:
            if np.allclose(self.rest[bone], rest, rtol=1e-4, atol=1e-5 * np.abs(rest[:3]).max()):
                return bone
        known.append(len(self.nodes))
        self.nodes.append(node)
        self.rest.append(rest)
        return known[-1]

    def parents(self) -> NDArray[np.int64]:
        """Return the nearest ancestor that is a bone, -1 for a root, [J]."""
        above = self.document.nearest_above(self.bones)
        return np.array([self.bones[above[node]][0] if above[node] >= 0 else -1 for node in self.nodes])

    def ancestors(self, node: int) -> list[int]:
        """Return ancestors of a node, the nearest first."""
        line = []
        while (node := self.document.parents[node]) >= 0:
            line.append(node)
        return line

    def sorted(self, animal: AnimatedAnimal) -> AnimatedAnimal:
        """Return the same animal with parents before children (Artemis wants a root in row 0)."""
        order = np.array(sorted(range(len(self.nodes)), key=lambda bone: self.document.depths[self.nodes[bone]]))
        rank = np.argsort(order)
        old = animal.parents[order]
        surfaces = tuple(replace(s, bone_indices=rank[s.bone_indices]) for s in animal.surfaces)
        return replace(
            animal,
            surfaces=surfaces,
            bone_names=tuple(animal.bone_names[bone] for bone in order),
            parents=np.where(old < 0, -1, rank[old]),
            bones_rest=animal.bones_rest[order],
            bones=animal.bones[:, order],
        )


def _skinned_surfaces(document: Document, skeleton: _Skeleton, node: int) -> list[Surface]:
    skin = document.tree.nodes[node].skin
    if skin not in skeleton.skins:
        joints: list[int] = document.tree.skins[skin].joints
        inverse_bind = inverse_binds(document, skin)
        above = document.nearest_above(set(joints))
        root = next(k for k, joint in enumerate(joints) if above[joint] < 0)
        to_world = skeleton.default[joints[root]] @ inverse_bind[root]  # mesh space -> the rest pose in the world
        rest = to_world @ np.linalg.inv(inverse_bind)
        skeleton.skins[skin] = to_world, np.array([skeleton.add(*each) for each in zip(joints, rest, strict=True)])
    return _bound_surfaces(document, skeleton, node, *skeleton.skins[skin], is_skinned=True)


def _bound_surfaces(
    document: Document, skeleton: _Skeleton, node: int, to_world: Floats, bones: NDArray[np.int64], is_skinned: bool
) -> list[Surface]:
    """Return the triangles of a node, bound to a skin's ``bones`` by their weights, or rigidly to the only one."""
    surfaces = []
    for primitive in document.tree.meshes[document.tree.nodes[node].mesh].primitives:
        if primitive.mode in (None, TRIANGLES, STRIP, FAN):
            if is_skinned:
                indices, weights = influences(document, primitive, len(bones))
            else:
                count = document.count(primitive.attributes.POSITION)
                indices, weights = np.zeros((count, 1), dtype=np.int64), np.ones((count, 1))
            offsets = still_offsets(document, skeleton.animation, node, primitive, skeleton.times)
            surfaces.append(read_surface(document, primitive, to_world, bones[indices], weights, offsets))
    return surfaces


def inverse_binds(document: Document, skin: int) -> Floats:
    """Return the transform from mesh to joint space of each joint of a skin, [joints, 4, 4]."""
    found = document.tree.skins[skin]
    if not found.joints:
        raise document.error(f"expected joints, but skin {skin} has none")
    if found.inverseBindMatrices is None:
        return np.tile(np.eye(4), (len(found.joints), 1, 1))
    matrices = document.floats(found.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
    if len(matrices) < len(found.joints) or (np.abs(np.linalg.det(matrices)) == 0).any():
        raise document.error(f"expected {len(found.joints)} invertible inverse bind matrices, but a skin has others")
    return matrices[: len(found.joints)]


def _attached_surfaces(document: Document, skeleton: _Skeleton, node: int) -> list[Surface]:
    """Return the rigid parts that hang from a joint without a skin; parts that hang from none are scenery."""
    line = [node, *skeleton.ancestors(node)]
    above = next((k for k, n in enumerate(line) if n in skeleton.bones), None)
    if above is None:
        return []
    between = np.eye(4)
    for link in reversed(line[:above]):
        between = between @ skeleton.local[link]
    bone = skeleton.bones[line[above]][0]
    to_world = skeleton.rest[bone] @ between
    if skeleton.animated & set(line[:above]):  # it moves against the joint, so it is a bone of its own
        bone = skeleton.add(node, to_world)
    return _bound_surfaces(document, skeleton, node, to_world, np.array([bone]), is_skinned=False)


def influences(document: Document, primitive: Part, count: int) -> tuple[NDArray[np.int64], Floats]:
    """Return the joint numbers within a skin of ``count`` joints and weights that sum to one, both [n, 4 k].

    Raises:
        UserError: a vertex without either, or a joint that the skin does not have.
    """
    sets = range(8)
    indices = [getattr(primitive.attributes, f"JOINTS_{k}", None) for k in sets]
    weights = [getattr(primitive.attributes, f"WEIGHTS_{k}", None) for k in sets]
    if indices[0] is None or weights[0] is None:
        raise document.error("expected JOINTS_0 and WEIGHTS_0 in a skinned mesh, but a primitive lacks them")
    joints = np.concatenate([document.accessor(i).astype(np.int64) for i in indices if i is not None], axis=1)
    shares = np.concatenate([document.floats(i) for i in weights if i is not None], axis=1)
    vertices = document.tree.accessors[primitive.attributes.POSITION].count
    if not len(joints) == len(shares) == vertices:
        came = f"{len(joints)}, {len(shares)} came"
        raise document.error(f"expected joints and weights of {vertices} vertices, but {came}")
    total = shares.sum(1, keepdims=True)
    shares[:, :1] = np.where(total <= 0, 1.0, shares[:, :1])  # a vertex without weights follows its first joint
    joints = np.where(shares > 0, joints, joints[:, :1])
    if joints.max(initial=0) >= count:
        raise document.error(f"expected joint indices below {count}, but one is {joints.max()}")
    return joints, shares / np.where(total <= 0, 1.0, total)


def read_surface(
    document: Document,
    primitive: Part,
    to_world: Floats,
    indices: NDArray[np.int64],
    weights: Floats,
    offsets: Floats | float = 0.0,
) -> Surface:
    """Return one primitive with its colours; ``offsets``, then ``to_world`` move its vertices."""
    positions = document.floats(primitive.attributes.POSITION) + offsets
    material = document.tree.materials[primitive.material] if primitive.material is not None else None
    factor, picture = base_color(material) if material else (None, None)
    color = np.tile(np.array(factor or (1.0, 1.0, 1.0, 1.0))[:3], (len(positions), 1))
    if primitive.attributes.COLOR_0 is not None:
        color = color * whole_range(document, primitive.attributes.COLOR_0)[:, :3]
    if material is not None:
        require_opaque(document, primitive, material)
    uv, texture = (None, None) if picture is None else base_texture(document, primitive, picture)
    return Surface(
        vertices=positions @ to_world[:3, :3].T + to_world[:3, 3],
        faces=_faces(document, primitive, len(positions)),
        bone_indices=indices,
        bone_weights=weights,
        colors=linear_to_srgb(color),
        uv=uv,
        texture=texture,
        lit=material is None or "KHR_materials_unlit" not in (material.extensions or {}),
        glow=glow_of(document, primitive, material) if material is not None else None,
    )


def _faces(document: Document, primitive: Part, count: int) -> NDArray[np.int64]:
    """Return triangles, [f, 3], of lists, strips and fans, indexed or not."""
    if primitive.indices is None:
        corners = np.arange(count)
    else:
        corners = document.accessor(primitive.indices)[:, 0].astype(np.int64)
    if corners.max(initial=0) >= count:
        raise document.error(f"expected vertex indices below {count}, but one is {corners.max()}")
    if primitive.mode == STRIP:
        faces = np.stack((corners[:-2], corners[1:-1], corners[2:]), axis=1)
        faces[1::2] = faces[1::2, [1, 0, 2]]
        return faces
    if primitive.mode == FAN:
        return np.stack((corners[1:-1], corners[2:], np.full(len(corners) - 2, corners[0])), axis=1)
    return corners[: len(corners) // 3 * 3].reshape(-1, 3)
