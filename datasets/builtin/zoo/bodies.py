"""Body plans of the zoo: a table of proportions for each kind of animal, and what builds a body from them.

Frame as in `anatomy`. Lengths are in hip heights (of a bird: in trunk lengths) until `Proportions.size` scales them.
"""

from dataclasses import dataclass, fields, replace
from typing import Literal

import numpy as np

from rewild4d.datasets.builtin.anatomy import Body, Chain, Node, Part
from rewild4d.datasets.builtin.zoo import ornaments

FINEST = 70
"""Grid cells over the longest extent of a body's trunk and legs."""


@dataclass(frozen=True)
class Proportions:
    """What distinguishes one body from another; lengths in hip heights, angles in degrees.

    Attributes:
        stance: four feet, two feet, or two feet and wings that carry.
        size: hip height in metres.
        trunk: length of the spine.
        girth: radii of the trunk at the hips, the belly and the chest.
        width: width of the trunk over its height.
        pitch: how far the trunk rises towards the chest.
        neck: its length.
        neck_angle: its rise above the horizontal.
        neck_girth: radii at its base and at its end.
        head: length from the neck to the tip of the nose.
        head_girth: radii of skull and nose.
        head_angle: the nose's fall below the horizontal.
        tail: its length.
        tail_girth: radii at its base and its end.
        tail_angle: its fall below the horizontal at the base.
        tail_curl: how much steeper each of its bones falls than the one before; negative curls upwards.
        leg_girth: radii at hip, knee, hock and foot.
        paws: 0 stands on hooves, 1 on paws.
        sprawl: how far feet stand outside of their hips.
        ears: length of an ear; 0 has none.
        ear_form: its shape.
        extras: ornaments by name (see `ornaments`).
    """

    stance: Literal["four", "two", "wings"] = "four"
    size: float = 1.0
    trunk: float = 1.0
    girth: tuple[float, float, float] = (0.22, 0.24, 0.25)
    width: float = 0.82
    pitch: float = 0.0
    neck: float = 0.5
    neck_angle: float = 45.0
    neck_girth: tuple[float, float] = (0.17, 0.1)
    head: float = 0.45
    head_girth: tuple[float, float] = (0.11, 0.06)
    head_angle: float = 30.0
    tail: float = 0.6
    tail_girth: tuple[float, float] = (0.05, 0.03)
    tail_angle: float = 50.0
    tail_curl: float = 10.0
    leg_girth: tuple[float, float, float, float] = (0.17, 0.1, 0.05, 0.05)
    paws: float = 0.0
    sprawl: float = 0.0
    ears: float = 0.12
    ear_form: Literal["pointed", "round", "hanging"] = "pointed"
    extras: tuple[str, ...] = ()


def jittered(mean: Proportions, rng: np.random.Generator, spread: float = 0.1) -> Proportions:
    """Return proportions around a mean: lengths times exp(n), angles plus 60 n degrees, n normal of that
    spread."""
    found: dict[str, object] = {}
    for field in fields(mean):
        value = getattr(mean, field.name)
        if field.name in ("paws", "stance") or isinstance(value, str):
            continue
        if field.name.endswith(("_angle", "_curl")) or field.name == "pitch":
            found[field.name] = value + float(rng.normal(0.0, 60 * spread))
        elif isinstance(value, float):
            found[field.name] = value * float(np.exp(rng.normal(0.0, spread)))
        elif value and isinstance(value[0], float):
            common, each = rng.normal(0.0, 0.8 * spread), rng.normal(0.0, 0.4 * spread, len(value))
            found[field.name] = tuple(float(v) for v in np.array(value) * np.exp(common + each))
    return replace(mean, **found)  # type: ignore[arg-type]


def body(plan: Proportions) -> Body:
    """Return the body of some proportions, in metres, feet on the ground."""
    spine = _spine(plan)
    base = np.array(spine[-1][:3]) + (0.0, 0.35 * plan.girth[2], 0.45 * plan.girth[2])
    neck = _line(base, plan.neck, plan.neck_angle, 2, plan.neck_girth)
    skull, nose = _head(plan, np.array(neck[-1][:3]))
    tail_base = np.array(spine[0][:3]) + (0.0, 0.45 * plan.girth[0], -0.75 * plan.girth[0])
    tail = _line(tail_base, plan.tail, 180 + plan.tail_angle, 4, plan.tail_girth, plan.tail_curl)
    narrow = (plan.width, 1.0, 1.0)
    chains = [
        Chain("spine", "", spine, 0.5 * min(plan.girth), narrow),
        Chain("neck", "spine.2", neck, 0.6 * plan.neck_girth[0], (0.85, 1, 1)),
        Chain("head", "neck.1", (skull, *nose), 0.4 * plan.head_girth[0], (0.9, 1, 1), rigid=True),
        Chain("tail", "spine.0", tail, 0.6 * plan.tail_girth[0]),
        _leg(plan, "hind", spine[0]),
    ]
    if plan.stance == "four":
        chains.append(_leg(plan, "fore", spine[-1]))
    chains += ornaments.limbs(plan.extras, np.array(spine[-1][:3]), plan.girth[2])
    landmarks = ornaments.Landmarks(
        np.array(skull[:3]), np.array(nose[-1][:3]), plan.head_girth[0],
        [np.array(n[:3]) for n in neck], plan.neck_girth, [np.array(n[:3]) for n in spine], plan.girth,
        [np.array(n[:3]) for n in tail], plan.tail_girth,
    )  # fmt: skip
    parts = ornaments.parts(plan.extras, landmarks)
    parts += ornaments.ears(plan.ears, plan.ear_form, landmarks) + _feet(plan, chains)
    side = 0.72 * plan.head_girth[0]
    eye = (side, *(np.array(skull[:3]) * 0.6 + np.array(nose[0][:3]) * 0.4 + (0, 0.35 * side, 0))[1:])
    extent = max(plan.trunk + 2 * plan.girth[0], 1.0)
    scale = plan.size
    return Body(
        tuple(replace(c, nodes=_scaled(c.nodes, scale), blend=c.blend * scale) for c in chains),
        tuple(
            replace(p, start=_scaled((p.start,), scale)[0], end=_scaled((p.end,), scale)[0], blend=p.blend * scale)
            for p in parts
        ),
        cell=scale * extent / FINEST,
        eye=_scaled(((*eye, 0.27 * plan.head_girth[0]),), scale)[0],  # type: ignore[arg-type]
    )


def _scaled(nodes: tuple[Node, ...], scale: float) -> tuple[Node, ...]:
    return tuple((x * scale, y * scale, z * scale, r * scale) for x, y, z, r in nodes)


def _spine(plan: Proportions) -> tuple[Node, ...]:
    """Return four nodes of the spine from the hips to the chest."""
    slope = float(np.radians(plan.pitch))
    middle = 1.0 + 0.06 * (plan.stance == "four")
    start = -plan.trunk / 2 if plan.stance == "four" else -0.3 * plan.trunk * np.cos(slope)
    radii = (plan.girth[0], (2 * plan.girth[1] + plan.girth[0]) / 3, plan.girth[1], plan.girth[2])
    nodes = []
    for share, radius in zip((0.0, 0.33, 0.67, 1.0), radii, strict=True):
        along = share * plan.trunk
        nodes.append((0.0, middle + along * np.sin(slope), start + along * np.cos(slope), radius))
    return tuple(nodes)


def _line(
    start: np.ndarray, length: float, angle: float, bones: int, girth: tuple[float, float], curl: float = 0.0
) -> tuple[Node, ...]:
    """Return nodes of a chain that starts at an angle above +z (degrees) and turns by ``curl`` at each bone."""
    at, nodes = start, [(float(start[0]), float(start[1]), float(start[2]), girth[0])]
    for bone in range(bones):
        turned = np.radians(angle + curl * bone)
        at = at + length / bones * np.array((0.0, np.sin(turned), np.cos(turned)))
        share = (bone + 1) / bones
        nodes.append((0.0, float(at[1]), float(at[2]), girth[0] + (girth[1] - girth[0]) * share))
    return tuple(nodes)


def _head(plan: Proportions, neck: np.ndarray) -> tuple[Node, tuple[Node, ...]]:
    down = np.radians(plan.head_angle)
    forward = np.array((0.0, -np.sin(down), np.cos(down)))
    skull, nose = plan.head_girth
    places = [neck + forward * share * plan.head for share in (0.12, 0.42, 0.85, 1.0)]
    radii = (skull, 0.9 * skull, 1.15 * nose, nose)
    found = [(0.0, float(p[1]), float(p[2]), r) for p, r in zip(places, radii, strict=True)]
    return found[0], tuple(found[1:])


HIND = {0.0: ((0.0, 1.0), (0.16, 0.73), (-0.08, 0.46), (-0.05, 0.15), (0.01, 0.045)),
        1.0: ((0.0, 1.0), (0.27, 0.66), (-0.07, 0.34), (0.02, 0.1), (0.16, 0.06))}  # fmt: skip
FORE = {0.0: ((0.05, 0.95), (-0.12, 0.72), (-0.06, 0.42), (-0.07, 0.16), (0.0, 0.045)),
        1.0: ((0.05, 0.95), (-0.18, 0.62), (-0.1, 0.24), (-0.06, 0.1), (0.08, 0.06))}  # fmt: skip
"""z and y of the joints of a leg on hooves and on paws, in hip heights from the hip downwards."""


def _leg(plan: Proportions, name: str, hip: Node) -> Chain:
    shapes = HIND if name == "hind" else FORE
    joints = np.array(shapes[0.0]) * (1 - plan.paws) + np.array(shapes[1.0]) * plan.paws
    if plan.stance != "four":
        joints[:, 1] *= hip[1]
    across = 0.6 * hip[3] * plan.width
    thigh, knee, hock, foot = plan.leg_girth
    radii = (thigh, knee, hock, 0.9 * hock, foot)
    nodes = []
    for i, ((z, y), radius) in enumerate(zip(joints, radii, strict=True)):
        share = 1.0 if i >= 2 else 0.5 * i
        nodes.append((across + plan.sprawl * share, float(max(y, 0.9 * radius)), float(hip[2] + z), radius))
    return Chain(name, "spine.0" if name == "hind" else "spine.2", tuple(nodes), 0.4 * thigh, (0.78, 1, 1),
                 mirrored=True)  # fmt: skip


def _feet(plan: Proportions, chains: list[Chain]) -> list[Part]:
    found = []
    for chain in chains:
        if chain.name not in ("hind", "fore"):
            continue
        x, y, z, radius = chain.nodes[-1]
        bone = f"{chain.name}.3"
        if plan.stance == "four" and plan.paws < 0.5:
            found.append(Part(bone, (x, y + 0.03, z, radius), (x, 0.4 * radius, z, 1.15 * radius), 0.02, "hoof",
                              mirrored=True))  # fmt: skip
        elif plan.stance != "four":
            for spread in (-0.5, 0.0, 0.5):
                toe = (x + spread * 0.14, 0.3 * radius, z + 0.2 - 0.05 * abs(spread), 0.6 * radius)
                found.append(Part(bone, (x, y, z, 0.9 * radius), toe, 0.02, "foot", mirrored=True))
    return found
