"""Parts beyond a plain body: ears, horns, antlers, humps, manes, trunks, tusks, beaks, wings, arms, ridges, tufts."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from rewild4d.datasets.builtin.anatomy import Chain, Node, Part


@dataclass(frozen=True)
class Landmarks:
    """Where ornaments attach: centres [3] and radii of head, nose, neck, spine and tail, lengths in hip heights."""

    skull: np.ndarray
    nose: np.ndarray
    head: float
    neck: Sequence[np.ndarray]
    neck_girth: tuple[float, float]
    spine: Sequence[np.ndarray]
    girth: tuple[float, float, float]
    tail: Sequence[np.ndarray]
    tail_girth: tuple[float, float]

    @property
    def forward(self) -> np.ndarray:
        """Unit vector from the skull to the nose, [3]."""
        along = self.nose - self.skull
        return along / np.linalg.norm(along)

    @property
    def upward(self) -> np.ndarray:
        """Unit vector out of the crown, perpendicular to `forward`, [3]."""
        return np.array((0.0, self.forward[2], -self.forward[1]))


def _node(place: np.ndarray, radius: float) -> Node:
    return float(place[0]), float(place[1]), float(place[2]), radius


def ears(length: float, form: str, at: Landmarks) -> list[Part]:
    """Return both ears."""
    if length <= 0:
        return []
    side = np.array((1.0, 0.0, 0.0))
    root = at.skull + 0.7 * at.head * at.upward + 0.55 * at.head * side - 0.1 * at.head * at.forward
    if form == "pointed":
        tip, radii, squash = root + length * (at.upward + 0.3 * side), (0.32 * length, 0.12 * length), (1, 1, 0.6)
    elif form == "round":
        tip, radii, squash = root + 0.5 * length * (at.upward + 0.8 * side), (0.4 * length, 0.5 * length), (1, 1, 0.45)
    else:
        tip, radii, squash = root + length * (1.0 * side - 0.5 * at.upward), (0.3 * length, 0.42 * length), (1, 1, 0.45)
    return [Part("head", _node(root, radii[0]), _node(tip, radii[1]), 0.2 * length, "ear", squash, mirrored=True)]


def limbs(extras: Sequence[str], chest: np.ndarray, girth: float) -> list[Chain]:
    """Return chains with bones of their own: arms and wings.

    Args:
        extras: names of ornaments.
        chest: centre of the chest, [3].
        girth: radius of the chest.
    """
    found = []
    shoulder = chest + (0.62 * girth, 0.1 * girth, -0.2 * girth)
    if "arms" in extras:
        nodes = [_node(shoulder - (0, 0.3 * girth, -0.2), 0.07)]
        for step, radius in (((0.03, -0.17, 0.04), 0.05), ((0.0, -0.1, 0.13), 0.035)):
            nodes.append(_node(np.array(nodes[-1][:3]) + step, radius))
        found.append(Chain("arm", "spine.2", tuple(nodes), 0.03, mirrored=True))
    if "wings" in extras:
        nodes = [_node(shoulder, 0.16)]
        for step, radius in (((0.38, 0.08, 0.06), 0.2), ((0.42, 0.02, -0.02), 0.22), ((0.42, -0.03, -0.14), 0.08)):
            nodes.append(_node(np.array(nodes[-1][:3]) + step, radius))
        found.append(Chain("wing", "spine.2", tuple(nodes), 0.05, (1.0, 0.22, 1.0), mirrored=True, paint="wing"))
    return found


def parts(extras: Sequence[str], at: Landmarks) -> list[Part]:
    """Return flesh without bones of its own, by the ornaments' names.

    Raises:
        KeyError: no such ornament.
    """
    found: list[Part] = []
    for name in extras:
        if name not in ("arms", "wings"):
            found += ORNAMENTS[name](at)
    return found


def _branch(bone: str, points: Sequence[np.ndarray], radii: Sequence[float], paint: str, mirrored: bool) -> list[Part]:
    """Return a polyline of flesh."""
    pairs = zip(points, points[1:], radii, radii[1:], strict=False)
    return [Part(bone, _node(a, p), _node(b, q), 0.015, paint, mirrored=mirrored) for a, b, p, q in pairs]


def _crown(at: Landmarks, side: float) -> np.ndarray:
    return at.skull + 0.8 * at.head * at.upward + np.array((side * at.head, 0.0, 0.0))


def _antlers(at: Landmarks) -> list[Part]:
    root, unit = _crown(at, 0.4), 4.5 * at.head
    bends = [
        root + unit * np.array(step) for step in ((0, 0, 0), (0.22, 0.3, -0.12), (0.42, 0.62, -0.1), (0.4, 0.95, 0.05))
    ]
    found = _branch("head", bends, (0.034, 0.03, 0.026, 0.018), "horn", mirrored=True)
    for start, step in ((0.15, (0.02, 0.14, 0.26)), (1.0, (0.0, 0.1, 0.26)), (2.0, (0.2, 0.2, -0.08))):
        low = int(start)
        base = bends[low] + (start - low) * (bends[low + 1] - bends[low])
        found += _branch("head", (base, base + unit * np.array(step)), (0.026, 0.015), "horn", mirrored=True)
    return found


def _horns(at: Landmarks) -> list[Part]:
    root, unit = _crown(at, 0.5), 2.4 * at.head
    steps = ((0, 0, 0), (0.35, 0.25, 0), (0.5, 0.6, 0.1), (0.42, 0.9, 0.15))
    return _branch(
        "head", [root + unit * np.array(s) for s in steps], (0.045, 0.04, 0.03, 0.016), "horn", mirrored=True
    )


def _curved_horns(at: Landmarks) -> list[Part]:
    root, unit = _crown(at, 0.35), 2.8 * at.head
    steps = ((0, 0, 0), (0.1, 0.4, -0.15), (0.2, 0.6, -0.5), (0.3, 0.5, -0.85))
    return _branch(
        "head", [root + unit * np.array(s) for s in steps], (0.045, 0.04, 0.032, 0.016), "horn", mirrored=True
    )


def _nose_horn(at: Landmarks) -> list[Part]:
    root = at.nose + 0.4 * at.head * at.upward - 0.5 * at.head * at.forward
    points = (root, root + 0.8 * at.head * at.upward, root + 1.7 * at.head * at.upward + 0.2 * at.head * at.forward)
    return _branch("head", points, (0.06, 0.045, 0.015), "horn", mirrored=False)


def _hump(at: Landmarks) -> list[Part]:
    middle, height = 0.5 * (at.spine[0] + at.spine[-1]), at.girth[1]
    low, top = (middle + (0, share * height, 0) for share in (0.6, 1.65))
    return [Part("spine.1", _node(low, 0.8 * height), _node(top, 0.5 * height), 0.1, squash=(0.6, 1, 1))]


def _mane(at: Landmarks) -> list[Part]:
    """A crest along the neck."""
    found = []
    for i, (low, high) in enumerate(zip(at.neck, at.neck[1:], strict=False)):
        along = (high - low) / np.linalg.norm(high - low)
        out = np.array((0.0, along[2], -along[1]))
        lift = 0.85 * np.array(at.neck_girth).mean()
        found.append(
            Part(f"neck.{i}", _node(low + lift * out, 0.08), _node(high + lift * out, 0.07), 0.02, "mane", (0.45, 1, 1))
        )
    return found


def _ruff(at: Landmarks) -> list[Part]:
    """A lion's mane around head and neck."""
    middle = at.neck[1]
    return [
        Part(
            "neck.1",
            _node(middle + (0, 0.02, -0.05), 2.2 * at.head),
            _node(at.skull - 0.3 * at.head * at.forward, 1.45 * at.head),
            0.04,
            "mane",
        ),
        Part(
            "neck.0",
            _node(at.neck[0] - (0, 0.12, 0), 1.5 * at.head),
            _node(middle - (0, 0.1, 0), 1.8 * at.head),
            0.06,
            "mane",
        ),
    ]


def _trunk(at: Landmarks) -> list[Part]:
    unit = at.head
    steps = ((0, 0.1, -0.2), (0, -0.9, 0.5), (0, -2.0, 0.6), (0, -3.0, 0.5), (0, -3.5, 0.85))
    points = [at.nose + unit * np.array(s) for s in steps]
    return _branch("head", points, (0.42 * unit, 0.36 * unit, 0.27 * unit, 0.2 * unit, 0.16 * unit), "coat", False)


def _tusks(at: Landmarks) -> list[Part]:
    root = at.nose + np.array((0.45 * at.head, -0.2 * at.head, 0.0))
    steps = ((0, 0, 0), (0.1, -0.6, 0.6), (0.05, -0.7, 1.4))
    points = [root + at.head * np.array(s) for s in steps]
    return _branch("head", points, (0.13 * at.head, 0.12 * at.head, 0.05 * at.head), "tusk", mirrored=True)


def _snout(at: Landmarks) -> list[Part]:
    """A pig's disc."""
    return [Part("head", _node(at.nose, 0.075), _node(at.nose + 0.05 * at.forward, 0.07), 0.01, "nose")]


def _beak(at: Landmarks) -> list[Part]:
    tip = at.nose + 0.9 * at.head * at.forward
    return [
        Part(
            "head",
            _node(at.nose - 0.2 * at.head * at.forward, 0.45 * at.head),
            _node(tip, 0.14 * at.head),
            0.01,
            "beak",
            (0.8, 0.8, 1),
        )
    ]


def _bill(at: Landmarks) -> list[Part]:
    tip = at.nose + 1.1 * at.head * at.forward
    return [
        Part(
            "head",
            _node(at.nose - 0.2 * at.head * at.forward, 0.4 * at.head),
            _node(tip, 0.42 * at.head),
            0.01,
            "beak",
            (1.1, 0.4, 1),
        )
    ]


def _folded_wings(at: Landmarks) -> list[Part]:
    side = np.array((0.78 * at.girth[1], 0.15 * at.girth[1], 0.0))
    ends = at.spine[-1] + side - (0, 0, 0.1), at.spine[0] + 0.75 * side - (0, 0, 0.35)
    return [
        Part(
            "spine.1",
            _node(ends[0], 0.55 * at.girth[1]),
            _node(ends[1], 0.12),
            0.05,
            "wing",
            (0.35, 1, 1),
            mirrored=True,
        )
    ]


def _fan(at: Landmarks) -> list[Part]:
    """A bird's tail feathers."""
    return [
        Part(
            "tail.3",
            _node(at.tail[2], 0.06),
            _node(at.tail[-1] + (x, 0.0, -0.12), 0.09),
            0.03,
            "wing",
            (1, 0.3, 1),
            mirrored=True,
        )
        for x in (0.05, 0.16)
    ]


def _tuft(at: Landmarks) -> list[Part]:
    along = at.tail[-1] - at.tail[-2]
    ends = at.tail[-1] - 0.1 * along, at.tail[-1] + 0.7 * along
    return [Part("tail.3", _node(ends[0], 1.5 * at.tail_girth[1] + 0.03), _node(ends[1], 0.03), 0.02, "mane")]


def _brush(at: Landmarks) -> list[Part]:
    """A fox's tail."""
    radius = 2.2 * at.tail_girth[0]
    return [
        Part("tail.2", _node(at.tail[1], 0.8 * radius), _node(at.tail[3], radius), 0.03),
        Part("tail.3", _node(at.tail[3], radius), _node(at.tail[4], 0.45 * radius), 0.03, "tip"),
    ]


def _ridge(at: Landmarks) -> list[Part]:
    """Plates along a back and a tail."""
    rows = [
        ("spine", at.spine, [at.girth[1]] * 3, 0.09),
        ("tail", at.tail, list(np.linspace(*at.tail_girth, 5)), 0.07),
    ]
    found = []
    for chain, nodes, radii, height in rows:
        for i, (low, high) in enumerate(zip(nodes, nodes[1:], strict=False)):
            for share in (0.25, 0.75):
                foot = low + share * (high - low) + (0, 0.85 * radii[i], 0)
                tip = foot + (0, height, 0)
                found.append(Part(f"{chain}.{i}", _node(foot, 0.045), _node(tip, 0.012), 0.02, squash=(0.5, 1, 1)))
    return found


ORNAMENTS = {
    "antlers": _antlers,
    "horns": _horns,
    "curved-horns": _curved_horns,
    "nose-horn": _nose_horn,
    "hump": _hump,
    "mane": _mane,
    "ruff": _ruff,
    "trunk": _trunk,
    "tusks": _tusks,
    "snout": _snout,
    "beak": _beak,
    "bill": _bill,
    "folded-wings": _folded_wings,
    "fan": _fan,
    "tuft": _tuft,
    "brush": _brush,
    "ridge": _ridge,
}
"""Ornaments without bones, by name."""
