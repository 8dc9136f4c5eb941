"""Animals and motions to train on, drawn anew each time: of neither set of the zoo's seeds.

They are wider than the zoo: kinds are mixed, extras exchanged, gaits have any footfall, stride and speed, and slow
waves move every chain.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from functools import partial

import numpy as np

from rewild4d.datasets.builtin import anatomy, building
from rewild4d.datasets.builtin.gait import FEET
from rewild4d.datasets.builtin.zoo import bodies, coats, motions
from rewild4d.datasets.builtin.zoo.kinds import KINDS, PAINTS
from rewild4d.datasets.builtin.zoo.motions import Motion, Posture
from rewild4d.datasets.builtin.zoo.points import body_points
from rewild4d.datasets.rigs.animal import Surface

COARSER = 1.6
"""Cells of the surface over those of the zoo's."""
SPREAD = 0.16
"""Spread of the proportions about their kinds'; see `bodies.jittered`."""
FOUR_FOOTED = tuple(name for name, kind in KINDS.items() if kind.proportions.stance == "four")
TWO_LEGGED = tuple(name for name in KINDS if name not in FOUR_FOOTED)
"""Kinds that animals are mixed of."""
ADDED = sorted({extra for name in FOUR_FOOTED for extra in KINDS[name].proportions.extras} - {"trunk", "tusks"})
"""Extras that any four-footed animal may have besides its own."""
STRETCHED = {
    "trunk": 0.22, "girth": 0.15, "width": 0.1, "neck": 0.22, "neck_girth": 0.12, "head": 0.15, "head_girth": 0.12,
    "tail": 0.2, "leg_girth": 0.2,
}  # fmt: skip
"""Spread of the logarithm of each factor of an animal that is stretched."""
FOOTFALLS = ((0.0, 0.25, 0.5, 0.75), (0.0, 0.5, 0.5, 0.0), (0.0, 0.0, 0.5, 0.5), (0.0, 0.42, 0.1, 0.54),
             (0.0, 0.5, 0.0, 0.5))  # fmt: skip
"""Touchdown of the feet in a walk, trot, pace, gallop and bound."""
PLACED = ("stand", "graze", "sit", "rear", "turn", "shake", "jump")
UPRIGHT = {"two": ("stride", "peck", "hop", "stand"), "wings": ("fly",)}
"""Motions by stance."""
LIMBS = ("arms", "wings")
"""Extras that no animal of such a kind lacks."""
WAVES = {
    "neck": (9.0, 6.0, 2.0), "head": (9.0, 8.0, 3.0), "tail": (9.0, 8.0, 2.0), "spine": (2.5, 3.0, 2.0),
}  # fmt: skip
"""Spread of constant pitch, yaw and roll of each bone of a chain, degrees; waves have half of it."""


@dataclass(frozen=True)
class VariedAnimal:
    """An animal at rest in the body frame (see `anatomy`), metres.

    Attributes:
        skeleton: its bones.
        surface: skinned and coloured.
        stance: as in `bodies.Proportions`.
        size: hip height.
        names: of its points.
        point_bones: bone of each point, int64, [L].
        points: places at rest, [L, 3].
    """

    skeleton: anatomy.Skeleton
    surface: Surface
    stance: str
    size: float
    names: tuple[str, ...]
    point_bones: np.ndarray
    points: np.ndarray


def draw_animal(
    rng: np.random.Generator, kinds: Sequence[str] = FOUR_FOOTED, *, stretched: bool = False
) -> VariedAnimal:
    """Draw an animal between two of some kinds, of the stance and with extras of the first.

    One that is ``stretched`` has parts as long, short, thick or thin as no kind has them.
    """
    plan = _proportions(rng, kinds)
    if stretched:
        plan = _stretched(plan, rng)
    palettes, patterns = (tuple(coats.PALETTES), tuple(coats.PATTERNS))
    coat, _ = coats.draw(rng, palettes, patterns, 0.3 * plan.size * float(np.exp(rng.normal(0, 0.4))))
    body = bodies.body(plan)
    skeleton, surface = building.dressed(replace(body, cell=COARSER * body.cell), coat, PAINTS)
    return VariedAnimal(skeleton, surface, plan.stance, plan.size, *body_points(skeleton, plan))


def _proportions(rng: np.random.Generator, kinds: Sequence[str]) -> bodies.Proportions:
    one, two = (KINDS[str(name)].proportions for name in rng.choice(kinds, 2))
    amount = float(rng.uniform(0.0, 0.6)) if rng.random() < 0.6 else 0.0
    plan = bodies.jittered(mixed(one, two, amount), rng, SPREAD)
    extras = [extra for extra in one.extras if extra in LIMBS or rng.random() < 0.8]
    if one.stance == "four" and rng.random() < 0.15:
        extras.append(str(rng.choice(ADDED)))
    paws = float(np.clip(plan.paws + rng.normal(0, 0.15), 0.0, 1.0))
    pitch = plan.pitch + float(rng.normal(0, 3.0))
    tail = plan.tail * float(np.exp(rng.normal(0, 0.3)))
    return replace(plan, extras=tuple(dict.fromkeys(extras)), paws=paws, pitch=pitch, tail=tail)


def _stretched(plan: bodies.Proportions, rng: np.random.Generator) -> bodies.Proportions:
    found: dict[str, object] = {}
    for name, spread in STRETCHED.items():
        value, factor = getattr(plan, name), float(np.exp(rng.normal(0, spread)))
        found[name] = value * factor if isinstance(value, float) else tuple(factor * part for part in value)
    return replace(plan, neck_angle=plan.neck_angle + float(rng.normal(0, 10)), **found)  # type: ignore[arg-type]


def mixed(one: bodies.Proportions, two: bodies.Proportions, amount: float) -> bodies.Proportions:
    """Return proportions ``amount`` of the way from one kind to another; what is no number stays the first's."""
    found: dict[str, object] = {}
    for field in fields(one):
        first, second = getattr(one, field.name), getattr(two, field.name)
        if isinstance(first, float):
            found[field.name] = (1 - amount) * first + amount * second
        elif isinstance(first, tuple) and first and isinstance(first[0], float):
            found[field.name] = tuple((1 - amount) * a + amount * b for a, b in zip(first, second, strict=True))
    return replace(one, **found)  # type: ignore[arg-type]


def draw_clip(animal: VariedAnimal, frames: int, rng: np.random.Generator) -> np.ndarray:
    """Draw a motion and return rest-to-posed transforms of all bones in the body frame, float64, [frames, J, 4, 4]."""
    steps = _timeline(frames, rng)
    first, second = _motion(animal.stance, rng), _motion(animal.stance, rng)
    change = _change(frames, rng)
    adding = _waves(frames, rng)
    postures = []
    for frame in range(frames):
        posture = first(float(steps[frame] % 1.0))
        if change[frame] > 0:
            posture = posture.mixed(second(float(steps[frame] % 1.0)), float(change[frame]))
        postures.append(_sum(posture, adding(frame)))
    return np.stack([motions.pose(animal.skeleton, posture, animal.size) for posture in postures])


def _timeline(frames: int, rng: np.random.Generator) -> np.ndarray:
    """Return the time in cycles at each frame: a cycle has 8 to 48 frames; some clips run backwards or slow down."""
    speed = 1 / np.exp(rng.uniform(np.log(8), np.log(48)))
    pace = 1 + 0.3 * rng.uniform(-1, 1) * np.linspace(-1, 1, frames)
    return np.asarray(rng.random() + np.cumsum(speed * pace))


def _change(frames: int, rng: np.random.Generator) -> np.ndarray:
    """Return how much of the second motion each frame has: none, a constant share, or a change in the middle."""
    kind = rng.random()
    if kind < 0.5:
        return np.zeros(frames)
    if kind < 0.7:
        return np.full(frames, rng.uniform(0.2, 0.8))
    middle, width = rng.uniform(0, frames), rng.uniform(2.0, 10.0)
    share = np.clip((np.arange(frames) - middle) / width + 0.5, 0, 1)
    return np.asarray(share * share * (3 - 2 * share))


def _motion(stance: str, rng: np.random.Generator) -> Motion:
    if stance == "two" and rng.random() < 0.3:
        return _gait(rng)
    if stance != "four":
        return motions.MOTIONS[str(rng.choice(UPRIGHT[stance]))]
    kind = rng.random()
    if kind < 0.35:
        name = str(rng.choice(("walk", "trot", "gallop")))
        return motions.MOTIONS[name]
    if kind < 0.7:
        return _gait(rng)
    name = str(rng.choice(PLACED))
    if name == "graze":
        return partial(motions.graze, lowering=float(rng.uniform(10, 60)))
    return motions.MOTIONS[name]


def _gait(rng: np.random.Generator) -> Motion:
    """Return a gait of any footfall, with the feet's centres moved."""
    footfall = np.array(FOOTFALLS[int(rng.integers(len(FOOTFALLS)))]) + rng.normal(0, 0.06, 4)
    duty, stride = float(rng.uniform(0.3, 0.75)), float(rng.uniform(0.15, 0.95))
    steps = motions.stepping(
        footfall.tolist(), duty, stride, float(rng.uniform(0.04, 0.32)), float(rng.uniform(15, 70))
    )
    ahead = dict(zip(FEET, rng.normal(0, 0.06, 4), strict=True))
    bob, sway, phase = rng.normal(0, 0.02), rng.normal(0, 2.0), rng.random()
    low = float(rng.uniform(-0.2, 0.0)) if rng.random() < 0.3 else -0.02

    def gait(time: float) -> Posture:
        posture = steps(time)
        feet = {name: value + (0.0, 0.0, ahead[name], 0.0) for name, value in posture.feet.items()}
        wave = np.sin(2 * np.pi * (np.array((2, 1)) * time + phase))
        return Posture(np.array((low + bob * wave[0], 0.0, 0.0, 0.0, sway * wave[1])), {}, feet)

    return gait


def _waves(frames: int, rng: np.random.Generator) -> Callable[[int], Posture]:
    """Return what is added to each frame: a constant bend and a slow wave of every chain, and a drift of the root."""
    strength = float(rng.choice((0.3, 1.0, 1.6)))
    speed = 2 * np.pi / rng.uniform(8, 60)
    held = {name: strength * rng.normal(0, spread) for name, spread in WAVES.items()}
    amplitude = {name: 0.5 * strength * rng.normal(0, spread) for name, spread in WAVES.items()}
    phase = {name: rng.uniform(0, 2 * np.pi, 3) for name in WAVES}
    root = strength * rng.normal(0, (0.03, 0.03, 3.0, 0.0, 2.0))
    turning = rng.normal(0, 1.5) if rng.random() < 0.4 else 0.0
    wide = float(rng.normal(0, 0.03))

    def at(frame: int) -> Posture:
        chains = {n: held[n] + amplitude[n] * np.sin(speed * frame + phase[n]) for n in WAVES}
        drift = np.array((0.0, 0.0, 0.0, turning * (frame - frames / 2), 0.0))
        feet = {foot: np.array((wide if foot.endswith("L") else -wide, 0.0, 0.0, 0.0)) for foot in FEET}
        return Posture(root + drift, chains, feet)

    return at


def _sum(one: Posture, two: Posture) -> Posture:
    def added(first: dict[str, np.ndarray], second: dict[str, np.ndarray]) -> dict[str, np.ndarray]:
        return {n: first.get(n, np.zeros(1)) + second.get(n, np.zeros(1)) for n in dict.fromkeys((*first, *second))}

    return Posture(one.root + two.root, added(one.chains, two.chains), added(one.feet, two.feet))
