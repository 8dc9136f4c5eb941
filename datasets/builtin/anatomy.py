"""Body plans of the built-in animals: tables of bone chains and extra parts.

Body frame: x lateral (+x the animal's left), y up (the ground is y = 0), z towards the head; metres.
A chain is a polyline of nodes (x, y, z, radius). Each of its segments is a bone and a tapered capsule of flesh.
"""

from dataclasses import dataclass, field

import numpy as np

Node = tuple[float, float, float, float]
"""x, y, z and radius in metres."""


@dataclass(frozen=True)
class Chain:
    """A row of bones with flesh around them.

    Attributes:
        name: bones are called "<name>.<i>", with ".L" or ".R" appended where mirrored.
        parent: the bone that the first one hangs from; "" for the root.
        nodes: joints and radii, at least two.
        blend: width in metres of the smooth seam to what was there before.
        squash: scale of the flesh along x, y, z.
        rigid: one bone for all segments (a skull).
        mirrored: build it at x and at -x.
        paint: name of its colour in the coat.
    """

    name: str
    parent: str
    nodes: tuple[Node, ...]
    blend: float
    squash: tuple[float, float, float] = (1.0, 1.0, 1.0)
    rigid: bool = False
    mirrored: bool = False
    paint: str = "coat"


@dataclass(frozen=True)
class Part:
    """Flesh without a bone of its own: ears, mane, horns, muzzle. Fields as in `Chain`; ``bone`` carries it."""

    bone: str
    start: Node
    end: Node
    blend: float
    paint: str = "coat"
    squash: tuple[float, float, float] = (1.0, 1.0, 1.0)
    mirrored: bool = False


@dataclass(frozen=True)
class Body:
    """One animal at rest.

    Attributes:
        chains: the first one holds the root; parents come before children.
        parts: extra flesh.
        cell: grid spacing of the surface in metres.
        eye: centre (x, y, z) and radius of the left eye; the right one is its mirror image.
    """

    chains: tuple[Chain, ...]
    parts: tuple[Part, ...]
    cell: float
    eye: Node


@dataclass
class Skeleton:
    """Bones at rest in the body frame.

    Attributes:
        names: one per bone.
        parents: -1 for the root, int64, [J].
        heads: pivots, [J, 3].
        tails: far ends, [J, 3].
    """

    names: list[str] = field(default_factory=list)
    parents: list[int] = field(default_factory=list)
    heads: list[np.ndarray] = field(default_factory=list)
    tails: list[np.ndarray] = field(default_factory=list)

    def add(self, name: str, parent: str, head: np.ndarray, tail: np.ndarray) -> None:
        self.names.append(name)
        self.parents.append(self.names.index(parent) if parent else -1)
        self.heads.append(head)
        self.tails.append(tail)

    def rest(self) -> np.ndarray:
        """Return the rigid rest matrices (bone to body), local y along the bone, float64, [J, 4, 4]."""
        matrices = np.tile(np.eye(4), (len(self.names), 1, 1))
        for matrix, head, tail in zip(matrices, self.heads, self.tails, strict=True):
            along = (tail - head) / np.linalg.norm(tail - head)
            side = np.cross(along, (0.0, 0.0, 1.0) if abs(along[2]) < 0.9 else (0.0, 1.0, 0.0))
            side /= np.linalg.norm(side)
            matrix[:3, :3] = np.stack((side, along, np.cross(side, along)), axis=1)
            matrix[:3, 3] = head
        return matrices


@dataclass(frozen=True)
class Flesh:
    """A tapered, squashed capsule: start and end [3], radii, seam width, the bone it follows and its paint."""

    start: np.ndarray
    end: np.ndarray
    radii: tuple[float, float]
    blend: float
    squash: np.ndarray
    bone: int
    paint: str


def assemble(body: Body) -> tuple[Skeleton, list[Flesh]]:
    """Return the skeleton and flesh of a body plan, left and right expanded."""
    skeleton, flesh = Skeleton(), []
    for chain in body.chains:
        for side, sign in _sides(chain.mirrored):
            nodes = [np.array((sign * x, y, z)) for x, y, z, _ in chain.nodes]
            parent = chain.parent
            if chain.rigid:
                parent = f"{chain.name}{side}"
                skeleton.add(parent, chain.parent, nodes[0], nodes[-1])
            for i in range(len(nodes) - 1):
                if not chain.rigid:
                    name = f"{chain.name}.{i}{side}"
                    skeleton.add(name, parent, nodes[i], nodes[i + 1])
                    parent = name
                radii = (chain.nodes[i][3], chain.nodes[i + 1][3])
                bone, squash = skeleton.names.index(parent), np.array(chain.squash)
                flesh.append(Flesh(nodes[i], nodes[i + 1], radii, chain.blend, squash, bone, chain.paint))
    for part in body.parts:
        for side, sign in _sides(part.mirrored):
            name = part.bone if part.bone in skeleton.names else part.bone + side
            flip = np.array((sign, 1.0, 1.0))
            ends = np.array(part.start[:3]) * flip, np.array(part.end[:3]) * flip
            radii, squash = (part.start[3], part.end[3]), np.array(part.squash)
            flesh.append(Flesh(*ends, radii, part.blend, squash, skeleton.names.index(name), part.paint))
    return skeleton, flesh


def _sides(mirrored: bool) -> tuple[tuple[str, float], ...]:
    return ((".L", 1.0), (".R", -1.0)) if mirrored else (("", 1.0),)
