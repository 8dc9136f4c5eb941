"""Read a rig file as a template: the bones that move skin, an object frame, the mean pose and range of its clips."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from rewild4d.datasets.rigs.reader import clips, load_rig
from rewild4d.errors import UserError
from rewild4d.priors.bodies.body import ANGLE_LIMIT, Template
from rewild4d.priors.bodies.covering import BLOBS, INNER, SQUARES, filled, spread_points, squares
from rewild4d.priors.bodies.rigged import RiggedBody
from rewild4d.priors.kinematics import depth_levels
from rewild4d.priors.rig import symmetric_frame, twins
from rewild4d.transforms import nearest_rotation

MOMENTS = 12
"""Of each clip that are looked at."""
LEAST_SHARE, MOST_BONES = 0.003, 40
"""Bones that move less of the skin than this share join their parents, and further ones until so many are left."""
LOOSE = 0.03
"""A bone whose start moves further against its parent, in sizes of the animal, is hung from a bone that keeps it."""
GROUND = 0.04
"""Height above the lowest vertex below which skin treads the ground, as a share of the animal's height."""
FRONT, REAR = r"head|skull|jaw|nose|snout|beak|mouth|eye|(?<![a-z])ear(?![a-z])", r"tail|hip|pelvis|rump"
"""What names of bones in front and behind contain."""
LEAST_SPREAD, ROOM = 0.06, 1.5
"""Least standard deviation of a joint angle, radians; those of clips are multiplied by the second for other animals."""


@dataclass(frozen=True)
class _Rig:
    """A skinned mesh and how its bones move.

    Attributes:
        vertices: at rest, [n, 3].
        faces: [f, 3].
        weights: rows sum to one, [n, J].
        names: [J].
        parents: -1 for a root, [J].
        pivots: starts of the bones at rest, [J, 3].
        motion: rest -> posed, of all moments, [T, J, 4, 4].
    """

    vertices: Tensor
    faces: Tensor
    weights: Tensor
    names: tuple[str, ...]
    parents: list[int]
    pivots: Tensor
    motion: Tensor


def read_body(path: Path) -> RiggedBody:
    """Read a rig as a template.

    Args:
        path: a .glb or .gltf file with a skinned mesh and at least one clip, y up.

    Raises:
        UserError: the file cannot be used; see `load_rig`.
    """
    rig = _read(path)
    rig = _fewer_bones(_rehung(_in_object_frame(rig, _axes(rig))))
    mirror = _mirror(rig)
    local = _local_rotations(rig)
    mean = _mean_rotations(rig, local, mirror)
    spreads = _spreads(rig, mean, mirror)
    rest = _posed(rig, mean)
    feet, grounds = _feet(rest, mirror)
    ends = _ends(rest)
    for bone, ground in zip(feet, grounds, strict=True):
        ends[bone] = ground
    return RiggedBody(
        name=path.name,
        bone_names=rest.names,
        parents=tuple(rest.parents),
        mirror=tuple(mirror.tolist()),
        feet=tuple(feet),
        spreads=spreads.float(),
        limits=(3 * spreads).clamp(0.3, 2 * ANGLE_LIMIT).float(),
        rest=_template(rest, torch.stack((rest.pivots, ends), dim=1), mirror),
    )


def _read(path: Path) -> _Rig:
    names = clips(path)
    if not names:
        raise UserError(f"{path}: expected a rig with at least one clip, which says how its joints bend, got none.")
    animals = [load_rig(path, name, MOMENTS) for name in names]
    first = animals[0]
    # a clip that moves an attached part has a bone more than the others
    moved = [animal.transforms for animal in animals if animal.bone_names == first.bone_names]
    vertices, faces, weights, count = [], [], [], 0
    for surface in first.surfaces:
        dense = np.zeros((len(surface.vertices), len(first.bone_names)))
        np.add.at(dense, (np.arange(len(dense))[:, None], surface.bone_indices), surface.bone_weights)
        vertices.append(surface.vertices)
        faces.append(surface.faces + count)
        weights.append(dense)
        count += len(dense)
    arrays = (np.concatenate(vertices), np.concatenate(faces), np.concatenate(weights))
    points, triangles, skin = map(torch.from_numpy, arrays)
    return _Rig(
        points, triangles, skin, first.bone_names, first.parents.tolist(),
        torch.from_numpy(first.bones_rest[:, :3, 3].copy()), torch.from_numpy(np.concatenate(moved)),
    )  # fmt: skip


def _shares(rig: _Rig) -> Tensor:
    """Return the share of the skin's area that each bone moves, [J]."""
    corners = rig.vertices[rig.faces]
    area = torch.linalg.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]).norm(dim=-1)
    moved = (area[:, None] * rig.weights[rig.faces].mean(1)).sum(0)
    return moved / moved.sum()


def _size(rig: _Rig) -> float:
    return float((rig.vertices.amax(0) - rig.vertices.amin(0)).norm())


def _ancestor(parents: Sequence[int], bone: int, kept: set[int]) -> int:
    """Return the nearest ancestor that is kept, -1 where there is none."""
    bone = parents[bone]
    while bone >= 0 and bone not in kept:
        bone = parents[bone]
    return bone


def _chosen(rig: _Rig, kept: list[int]) -> _Rig:
    """Return the rig with some of its bones; the others' weights go to the nearest ancestor that is kept."""
    inside = set(kept)
    to = {bone: bone if bone in inside else _ancestor(rig.parents, bone, inside) for bone in range(len(rig.parents))}
    weights = torch.zeros(len(rig.weights), len(kept), dtype=rig.weights.dtype)
    for bone, target in to.items():
        weights[:, kept.index(target) if target >= 0 else 0] += rig.weights[:, bone]
    parents = [_ancestor(rig.parents, bone, inside) for bone in kept]
    return replace(
        rig, weights=weights, names=tuple(rig.names[bone] for bone in kept), pivots=rig.pivots[kept],
        parents=[kept.index(parent) if parent >= 0 else -1 for parent in parents], motion=rig.motion[:, kept],
    )  # fmt: skip


def _rehung(rig: _Rig) -> _Rig:
    """Return the rig's skin-moving bones, each hung from one against which its start keeps its place.

    Feet that a solver moves often hang from the root in a file; they belong to the leg's last bone.
    """
    rig = _chosen(rig, torch.nonzero(_shares(rig) > 0)[:, 0].tolist())
    mirror = _mirror(rig).tolist()
    slack = _slack(rig)
    slack = (slack + slack[mirror][:, mirror]) / 2  # both sides alike
    apart = torch.cdist(rig.pivots, rig.pivots) / _size(rig)
    parents, shares = list(rig.parents), _shares(rig)
    roots = [bone for bone, parent in enumerate(parents) if parent < 0]
    main = max(roots, key=lambda root: sum(float(shares[b]) for b in _below(parents, root)))
    for bone, parent in enumerate(rig.parents):
        twin = mirror[bone]
        if bone == main or twin < bone or (parent >= 0 and slack[parent, bone] <= LOOSE):
            continue
        below = _below(parents, bone) | _below(parents, twin)
        others = [other for other in range(len(parents)) if other not in below and slack[other, bone] <= LOOSE]
        if others:
            parents[bone] = min(others, key=lambda other: float(slack[other, bone] + 0.1 * apart[other, bone]))
            parents[twin] = mirror[parents[bone]]
    return replace(rig, parents=parents)


def _slack(rig: _Rig) -> Tensor:
    """Return how far the start of each bone (column) moves against each bone (row), in sizes of the animal, [J, J]."""
    starts = (rig.motion[..., :3, :3] @ rig.pivots[..., None])[..., 0] + rig.motion[..., :3, 3]
    back = torch.linalg.pinv(rig.motion)  # a clip may hide a part by a scale of zero
    rows = [starts @ own[:, :3, :3].transpose(-1, -2) + own[:, None, :3, 3] for own in back.unbind(1)]
    away = [(row - rig.pivots).norm(dim=-1).square().mean(0).sqrt() for row in rows]
    return torch.stack(away) / _size(rig)


def _mirror(rig: _Rig) -> Tensor:
    """Return the bone on the other side, of each, in the object frame, [J]."""
    return twins(torch.stack((rig.pivots, _ends(rig)), dim=1))


def _below(parents: Sequence[int], bone: int) -> set[int]:
    """Return a bone and all that hang from it."""
    found, new = {bone}, {bone}
    while new:
        new = {child for child, parent in enumerate(parents) if parent in new}
        found |= new
    return found


def _fewer_bones(rig: _Rig) -> _Rig:
    shares = _shares(rig)
    kept = [bone for bone in range(len(shares)) if shares[bone] >= LEAST_SHARE or rig.parents[bone] < 0]
    rig = _chosen(rig, kept)
    while len(rig.parents) > MOST_BONES:
        shares = _shares(rig)
        inner = [bone for bone, parent in enumerate(rig.parents) if parent >= 0]
        least = min(inner, key=lambda bone: float(shares[bone]))
        rig = _chosen(rig, [bone for bone in range(len(rig.parents)) if bone != least])
    return rig


def _axes(rig: _Rig) -> Tensor:
    """Return the object's x, y and z axes in the file's, as columns, [3, 3]: by names of bones, else +z is ahead."""
    ahead = [k for k, name in enumerate(rig.names) if re.search(FRONT, name, re.IGNORECASE)]
    behind = [k for k, name in enumerate(rig.names) if re.search(REAR, name, re.IGNORECASE)]
    forward = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
    if ahead:
        rear = rig.pivots[behind].mean(0) if behind else rig.vertices.mean(0)
        line = (rig.pivots[ahead].mean(0) - rear) * torch.tensor((1.0, 0.0, 1.0), dtype=torch.float64)
        if float(line.norm()) > 0.05 * _size(rig):
            forward = line / line.norm()
    up = torch.tensor((0.0, 1.0, 0.0), dtype=torch.float64)
    return torch.stack((torch.linalg.cross(up, forward), up, forward), dim=1)


def _in_object_frame(rig: _Rig, axes: Tensor) -> _Rig:
    """Return the rig in the frame whose x axis is normal to its symmetry plane, with the object's diagonal."""
    frame = symmetric_frame(rig.vertices, axes)
    back = torch.linalg.inv(frame)
    return replace(
        rig,
        vertices=rig.vertices @ back[:3, :3].T + back[:3, 3],
        pivots=rig.pivots @ back[:3, :3].T + back[:3, 3],
        motion=back @ rig.motion @ frame,
    )


def _ends(rig: _Rig) -> Tensor:
    """Return ends of bones, [J, 3]: the mean of their children's starts, else twice as far as their skin's middle."""
    ends = rig.pivots.clone()
    for bone, pivot in enumerate(rig.pivots):
        children = [child for child, parent in enumerate(rig.parents) if parent == bone]
        own = rig.weights[:, bone]
        middle = (own[:, None] * rig.vertices).sum(0) / own.sum().clamp_min(1e-9)
        ends[bone] = rig.pivots[children].mean(0) if children else 2 * middle - pivot
    return ends


def _turns(rig: _Rig) -> Tensor:
    """Return rotations of the bones, rest -> posed, without the scales that some clips have, [T, J, 3, 3]."""
    return nearest_rotation(rig.motion[..., :3, :3])


def _local_rotations(rig: _Rig) -> Tensor:
    """Return rotations against the parent about the object's axes, the identity for roots, [T, J, 3, 3]."""
    return _against_parents(_turns(rig), rig.parents)


def _against_parents(turns: Tensor, parents: Sequence[int]) -> Tensor:
    above = torch.tensor([max(parent, 0) for parent in parents])
    is_root = torch.tensor([parent < 0 for parent in parents])
    local = turns[:, above].transpose(-1, -2) @ turns
    return torch.where(is_root[:, None, None], torch.eye(3, dtype=turns.dtype), local)


def _flipped(rotations: Tensor, mirror: Tensor) -> Tensor:
    """Return rotations of the mirrored pose, [..., J, 3, 3]."""
    sign = rotations.new_tensor((-1.0, 1.0, 1.0))
    return sign[:, None] * rotations[..., mirror, :, :] * sign


def _mean_rotations(rig: _Rig, local: Tensor, mirror: Tensor) -> Tensor:
    """Return the rotation of each bone in the mean pose of all clips and of their mirror images, [J, 3, 3]."""
    mean = nearest_rotation((local + _flipped(local, mirror)).mean(0))
    return _chained(mean, rig.parents)


def _chained(local: Tensor, parents: Sequence[int]) -> Tensor:
    """Return rotations of bones from those against their parents, [J, 3, 3]."""
    turns: dict[int, Tensor] = {}
    for level in depth_levels(parents):
        for bone in level:
            turns[bone] = local[bone] if parents[bone] < 0 else turns[parents[bone]] @ local[bone]
    return torch.stack([turns[bone] for bone in range(len(parents))])


def _spreads(rig: _Rig, mean: Tensor, mirror: Tensor) -> Tensor:
    """Return standard deviations of joint angles about the object's axes around the mean pose, [J, 3]."""
    local = _against_parents(_turns(rig) @ mean.transpose(-1, -2), rig.parents)
    both = torch.cat((local, _flipped(local, mirror)))
    angles = torch.from_numpy(Rotation.from_matrix(both.flatten(0, 1).numpy()).as_rotvec()).unflatten(0, both.shape[:2])
    spreads = ROOM * angles.square().mean(0).sqrt()
    return spreads.clamp_min(LEAST_SPREAD)


def _posed(rig: _Rig, turns: Tensor) -> _Rig:
    """Return the rig whose rest is the pose of some rotations; its motion is left out."""
    pivots: dict[int, Tensor] = {}
    for level in depth_levels(rig.parents):
        for bone in level:
            parent, start = rig.parents[bone], rig.pivots[bone]
            if parent >= 0:
                start = pivots[parent] + turns[parent] @ (start - rig.pivots[parent])
            pivots[bone] = start
    starts = torch.stack([pivots[bone] for bone in range(len(rig.parents))])
    moved = torch.einsum("jab,nb->nja", turns, rig.vertices) + (starts - torch.einsum("jab,jb->ja", turns, rig.pivots))
    return replace(rig, vertices=(rig.weights[..., None] * moved).sum(1), pivots=starts, motion=rig.motion[:0])


def _feet(rig: _Rig, mirror: Tensor) -> tuple[list[int], list[Tensor]]:
    """Return bones that tread the ground, on both sides, and where each does, [3]."""
    height = rig.vertices[:, 1] - rig.vertices[:, 1].min()
    low = (height < GROUND * height.max()).double()
    shares = (low[:, None] * rig.weights).sum(0)
    shares = (shares + shares[mirror]) / 2
    feet = torch.nonzero(shares > 0.1 * shares.sum())[:, 0].tolist()
    own = low[:, None] * rig.weights
    return feet, [(own[:, bone, None] * rig.vertices).sum(0) / own[:, bone].sum() for bone in feet]


def _template(rig: _Rig, bones: Tensor, mirror: Tensor) -> Template:
    mesh = rig.vertices, rig.faces, rig.weights
    points, normals, weights, area = spread_points(*mesh, SQUARES)
    inner, inner_normals, inner_weights, _ = spread_points(*mesh, INNER)
    blobs, sizes, kept = filled(inner, inner_normals, BLOBS)
    return Template(
        vertices=rig.vertices.float(),
        faces=rig.faces,
        weights=rig.weights.float(),
        bones=bones.float(),
        parents=tuple(rig.parents),
        mirror=tuple(mirror.tolist()),
        blobs=blobs,
        blob_sizes=sizes,
        blob_weights=torch.from_numpy(inner_weights[kept]).float(),
        cover=torch.from_numpy(squares(points, normals, area)).float().flatten(0, 1),
        cover_weights=torch.from_numpy(weights).float().repeat_interleave(4, dim=0),
        quads=torch.arange(4 * len(points)).reshape(-1, 4),
    )
