"""Animals of a trunk and four limbs: five tubes and 20 bones, in a layout that quadrupeds, bipeds and primates share.

Layout and numbering are 3D-Fauna's (design notes, FORMATS 4.4): body bones 0-3 run from the head to the middle of the
back, 4-7 from the tail tip to the middle; limbs are front left 8-10, rear left 11-13, rear right 14-16, front right
17-19, each from its end to its top. Joints follow from the proportions.
"""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from functools import cache

import torch
from torch import Tensor
from torch.nn.functional import normalize

from rewild4d.priors.bodies.body import ANGLE_LIMIT, Measure, Proportions, Template, to_unit
from rewild4d.priors.bodies.tubes import Section, Tube, chain_weights, loft, point, tube_faces, tube_quads
from rewild4d.transforms import mirror_points

PARENTS = (1, 2, 3, -1, 5, 6, 7, -1, 9, 10, 3, 12, 13, 7, 15, 16, 7, 18, 19, 3)
MIRROR = (0, 1, 2, 3, 4, 5, 6, 7, 17, 18, 19, 14, 15, 16, 11, 12, 13, 8, 9, 10)
SPINE = 8
"""Bones of head, neck, trunk and tail; they come first."""
ENDS = (8, 11, 14, 17)
"""Last bone of each limb."""

BODY_RINGS, BODY_SEGMENTS = 48, 16
LEG_RINGS, LEG_SEGMENTS = 16, 10
BODY_STATIONS = (0.0, 0.2, 0.5, 0.95, 1.25, 2.0, 3.0, 3.25, 4.0, 4.75, 5.5, 6.0, 6.5, 7.25, 8.0)
"""Bone coordinate of each body section: k to k + 1 is the k-th bone from the nose (bones 0 1 2 3 7 6 5 4)."""
LEG_STATIONS = (-0.3, 0.1, 0.6, 1.0, 1.5, 2.0, 2.5, 2.85, 3.0)
"""Bone coordinate of each limb's section: 0 to 1 is the top bone, below zero the body bone."""
SECTIONS = (len(BODY_STATIONS), len(LEG_STATIONS), len(LEG_STATIONS))
"""Cross sections of the body, of a front limb and of a rear limb, each from the nose or the top."""
RELIEF_SPREAD = (0.15, 0.15, 0.05, 0.05)
"""One standard deviation of a cross section's relief: width and height relative, shifts in object units."""

Measures = dict[str, Tensor]


class Tetrapod(ABC):
    """A kind of tetrapod; see `Body` for what the fit asks of it.

    Attributes:
        name: of the kind.
        table: its measures.
        feet: bones whose end treads the ground.
        bends: standard deviations of the joint angles of each bone of the left side, radians.
        reach: bounds of joint angles other than `ANGLE_LIMIT`, by bone of the left side, radians.
    """

    name: str
    table: dict[str, Measure]
    feet: tuple[int, ...] = ENDS
    bends: dict[int, tuple[float, float, float]]
    reach: dict[int, tuple[float, float, float]] = {}
    parents, mirror, sections = PARENTS, MIRROR, sum(SECTIONS)

    @abstractmethod
    def spine(self, m: Measures) -> list[Tensor]:
        """Return the nine spine joints from the nose to the tail tip, each [..., 3]."""

    @abstractmethod
    def trunk(self, m: Measures, joints: list[Tensor]) -> list[Section]:
        """Return the body's sections from nose to tail tip."""

    @abstractmethod
    def limb(self, m: Measures, end: str) -> list[Tensor]:
        """Return the four joints of a left limb from its top to its end; ``end`` is "front" or "rear"."""

    @abstractmethod
    def limb_sections(self, m: Measures, joints: list[Tensor], end: str) -> list[Section]:
        """Return sections of a left limb, from inside the body to its end."""

    @abstractmethod
    def carriage(self, bones: Tensor, transforms: Tensor) -> Tensor:
        """See `Body`."""

    @property
    def measures(self) -> int:
        return len(self.table)

    @property
    def spreads(self) -> Tensor:
        return torch.tensor([self.bends[min(bone, MIRROR[bone])] for bone in range(len(PARENTS))])

    @property
    def limits(self) -> Tensor:
        usual = (ANGLE_LIMIT, ANGLE_LIMIT, ANGLE_LIMIT)
        return torch.tensor([self.reach.get(min(bone, MIRROR[bone]), usual) for bone in range(len(PARENTS))])

    def proportions(self, **measures: float) -> Proportions:
        """Return the average animal with other values of the named measures (object units, radians)."""
        deviations = torch.zeros(self.measures)
        for name, value in measures.items():
            deviations[list(self.table).index(name)] = self.table[name].deviation(value)
        return Proportions(deviations)

    def build(self, shape: Proportions | None = None, *, unit: bool = True) -> Template:
        shape = shape or self.proportions()
        m = {name: p.at(z) for (name, p), z in zip(self.table.items(), shape.deviations.unbind(-1), strict=True)}
        reliefs, spine = _reliefs(shape), self.spine(m)
        limbs = {end: self.limb(m, end) for end in ("front", "rear")}
        body = loft(self.trunk(m, spine), reliefs[0], BODY_RINGS)
        left = [
            loft(self.limb_sections(m, joints, end), relief, LEG_RINGS)
            for (end, joints), relief in zip(limbs.items(), reliefs[1:], strict=True)
        ]
        template = _assembled(body, left, _bones(spine, limbs["front"], limbs["rear"]))
        return to_unit(template) if unit else template


def _reliefs(shape: Proportions) -> tuple[Tensor, ...]:
    """Return the relief of body, front limbs and rear limbs, logarithms and object units, each [..., s, 4]."""
    relief = shape.relief
    if relief is None:
        relief = shape.deviations.new_zeros(*shape.deviations.shape[:-1], sum(SECTIONS), 4)
    return (relief * relief.new_tensor(RELIEF_SPREAD)).split(SECTIONS, dim=-2)


def _bones(spine: list[Tensor], front: list[Tensor], rear: list[Tensor]) -> Tensor:
    """Return start and end of every bone, [..., J, 2, 3]."""
    segments = [(spine[k + 1], spine[k]) for k in range(4)] + [(spine[k - 1], spine[k]) for k in (8, 7, 6, 5)]
    limbs = [front, rear, [mirror_points(j) for j in rear], [mirror_points(j) for j in front]]
    segments += [(limb[k], limb[k + 1]) for limb in limbs for k in (2, 1, 0)]
    return torch.stack([torch.stack(pair, -2) for pair in segments], -3)


def _assembled(body: Tube, left: list[Tube], bones: Tensor) -> Template:
    """Join the body with left limbs, front and rear, and their mirror images."""
    ring_weights, faces = _skinning()
    weights = [
        torch.cat((w.repeat_interleave(BODY_SEGMENTS if k == 0 else LEG_SEGMENTS, 0), w[:1], w[-1:]))
        for k, w in enumerate(ring_weights)
    ]
    blobs, sizes = zip(body.blobs(6), *(limb.blobs(3) for limb in left), strict=True)
    blob_weights = [w.repeat_interleave(6 if k == 0 else 3, 0) for k, w in enumerate(ring_weights)]
    vertices = torch.cat(_with_right([body.mesh(BODY_SEGMENTS), *(limb.mesh(LEG_SEGMENTS) for limb in left)]), -2)
    vertex_weights = torch.cat(weights)
    return Template(
        vertices=vertices,
        faces=faces,
        weights=vertex_weights,
        bones=bones,
        parents=PARENTS,
        mirror=MIRROR,
        blobs=torch.cat(_with_right(blobs), -2),
        blob_sizes=torch.cat((*sizes, sizes[2], sizes[1]), -1),
        blob_weights=torch.cat(blob_weights),
        cover=vertices,
        cover_weights=vertex_weights,
        quads=_quads(),
    )


def _with_right(parts: Sequence[Tensor]) -> list[Tensor]:
    """Append mirrored points, rear limb first, to those of the body and the left front and rear limb."""
    return [*parts, mirror_points(parts[2]), mirror_points(parts[1])]


@cache
def _skinning() -> tuple[tuple[Tensor, ...], Tensor]:
    """Return weights of each tube's rings, [r, J], of the body and the limbs by number, and all faces, [f, 3]."""
    count, tops = len(PARENTS), (10, 13, 16, 19)
    body = chain_weights(BODY_STATIONS, BODY_RINGS, (0, 1, 2, 3, 7, 6, 5, 4), 0.0, count)
    limbs = tuple(chain_weights(LEG_STATIONS, LEG_RINGS, (PARENTS[t], t, t - 1, t - 2), -1.0, count) for t in tops)
    faces, offset = [tube_faces(BODY_RINGS, BODY_SEGMENTS)], BODY_RINGS * BODY_SEGMENTS + 2
    for limb in range(4):
        triangles = tube_faces(LEG_RINGS, LEG_SEGMENTS)
        faces.append(offset + (triangles if limb < 2 else triangles.flip(1)))
        offset += LEG_RINGS * LEG_SEGMENTS + 2
    return (body, *limbs), torch.cat(faces)


@cache
def _quads() -> Tensor:
    """Return corners of the quadrilaterals of the whole mesh, its caps left out, int64, [q, 4]."""
    body, limb = tube_quads(BODY_RINGS, BODY_SEGMENTS), tube_quads(LEG_RINGS, LEG_SEGMENTS)
    first, each = BODY_RINGS * BODY_SEGMENTS + 2, LEG_RINGS * LEG_SEGMENTS + 2
    return torch.cat((body, *(first + k * each + limb for k in range(4))))


def direction(angle: Tensor, forward: float = 1.0) -> Tensor:
    """Return unit vectors in the plane of symmetry, risen by an angle above +z, or above -z where forward is -1."""
    return point(angle.sin(), forward * angle.cos())


def head_sections(m: Measures, joints: list[Tensor]) -> list[Section]:
    """Return the trunk's sections from the nose to the middle of the neck, from the joints of the spine."""
    nose, poll, neck = joints[:3]
    snout = normalize(nose - poll, dim=-1)
    return [
        (nose, 0.55 * m["muzzle"], 0.55 * m["muzzle"]),
        (nose - 0.18 * snout * m["head_length"][..., None], m["muzzle"], m["muzzle"]),
        (0.5 * (nose + poll), 0.8 * m["head_width"], 0.85 * m["head_height"]),
        (poll + 0.12 * snout, 1.1 * m["head_width"], 1.15 * m["head_height"]),
        (poll - 0.25 * (poll - neck), m["neck_top"] * 0.85, m["neck_top"]),
        (neck, 0.5 * (m["neck_top"] + m["neck_base"]) * 0.8, 0.5 * (m["neck_top"] + m["neck_base"])),
    ]


def tail_sections(m: Measures, joints: list[Tensor]) -> list[Section]:
    """Return the trunk's sections from the root to the tip of the tail."""
    root, tail, tip = joints[6:]
    return [
        (root, 1.3 * m["tail_base"], 1.3 * m["tail_base"]),
        (0.5 * (root + tail), m["tail_base"], m["tail_base"]),
        (tail + 0.25 * (tip - tail), m["tail_middle"], m["tail_middle"]),
        (tip, 0.4 * m["tail_middle"], 0.4 * m["tail_middle"]),
    ]
