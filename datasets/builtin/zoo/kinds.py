"""Kinds of animals in the zoo: mean proportions, coats and clips."""

from dataclasses import dataclass, field

from rewild4d.datasets.builtin.zoo.bodies import Proportions

PAINTS = {
    "hoof": "3a322c", "eye": "14100d", "nose": "8a5048", "horn": "cbbf9f", "mane": "2f2019", "ear": "4a3526",
    "tip": "efe8da", "tusk": "efe6cf", "beak": "d99a34", "foot": "b7813a", "wing": "4d4038",
}  # fmt: skip
"""Plain colours by paint name."""

GRAZER = (("walk",), ("graze",), ("trot",), ("gallop",), ("walk", "graze"), ("stand", "turn"), ("jump",))
HUNTER = (("walk",), ("trot",), ("gallop",), ("sit",), ("shake",), ("walk", "sit"), ("jump",), ("turn", "shake"))
HEAVY = (("walk",), ("stand",), ("graze",), ("turn",), ("walk", "stand"))


@dataclass(frozen=True)
class Kind:
    """One kind of animal.

    Attributes:
        proportions: mean.
        palettes: colours of its coats, names in `coats.PALETTES`.
        patterns: names in `coats.PATTERNS`.
        clips: what it does, names in `motions.MOTIONS`.
        paints: plain colours of its parts.
    """

    proportions: Proportions
    palettes: tuple[str, ...]
    patterns: tuple[str, ...]
    clips: tuple[tuple[str, ...], ...]
    paints: dict[str, str] = field(default_factory=lambda: PAINTS)


HOOFED = ("plain", "belly", "blotches", "saddle", "spots")
FURRY = ("plain", "belly", "blotches", "stripes", "saddle")

KINDS = {
    "dog": Kind(
        Proportions(size=0.55, trunk=1.0, girth=(0.19, 0.2, 0.25), neck=0.42, neck_girth=(0.17, 0.12), head=0.48,
                    head_girth=(0.13, 0.06), head_angle=18, tail=0.65, tail_angle=10, tail_curl=-15, paws=0.8,
                    ears=0.16, ear_form="hanging"),
        ("earth", "black", "white", "orange", "sand"), FURRY, HUNTER,
    ),
    "stag": Kind(
        Proportions(size=1.1, trunk=0.9, girth=(0.18, 0.19, 0.2), neck=0.6, neck_angle=58, neck_girth=(0.16, 0.09),
                    head=0.42, head_girth=(0.09, 0.045), head_angle=32, tail=0.16, tail_girth=(0.05, 0.04),
                    leg_girth=(0.14, 0.08, 0.038, 0.038), ears=0.16, extras=("antlers",)),
        ("earth", "orange", "sand"), ("belly", "plain", "spots"), GRAZER,
    ),
    "elephant": Kind(
        Proportions(size=2.0, trunk=0.95, girth=(0.31, 0.37, 0.33), width=0.8, neck=0.24, neck_angle=28,
                    neck_girth=(0.27, 0.23), head=0.38, head_girth=(0.22, 0.14), head_angle=48, tail=0.55,
                    tail_girth=(0.045, 0.025), tail_angle=75, tail_curl=4,
                    leg_girth=(0.21, 0.165, 0.12, 0.125), paws=0.25, ears=0.42, ear_form="round",
                    extras=("trunk", "tusks", "tuft")),
        ("grey",), ("plain", "belly"), (("walk",), ("stand",), ("turn",), ("walk", "stand")),
        {**PAINTS, "ear": "77736f", "hoof": "6f6a64"},
    ),
    "cat": Kind(
        Proportions(size=0.3, trunk=1.15, girth=(0.19, 0.19, 0.19), neck=0.28, neck_angle=35, neck_girth=(0.15, 0.13),
                    head=0.32, head_girth=(0.17, 0.08), head_angle=10, tail=1.0, tail_girth=(0.05, 0.04), tail_angle=20,
                    tail_curl=-18, leg_girth=(0.16, 0.11, 0.06, 0.06), paws=1.0, ears=0.17),
        ("grey", "orange", "black", "white"), ("stripes", "plain", "blotches", "belly"), HUNTER,
    ),
    "ostrich": Kind(
        Proportions(stance="two", size=1.3, trunk=0.62, girth=(0.2, 0.25, 0.2), pitch=6, neck=0.95, neck_angle=68,
                    neck_girth=(0.09, 0.05), head=0.2, head_girth=(0.065, 0.04), head_angle=10, tail=0.28,
                    tail_girth=(0.12, 0.06), tail_angle=15, leg_girth=(0.14, 0.1, 0.04, 0.04), ears=0.0,
                    extras=("beak", "folded-wings", "fan")),
        ("black", "grey", "earth"), ("plain", "belly"), (("stride",), ("peck",), ("stride", "peck")),
        {**PAINTS, "wing": "e2ddd4"},
    ),
    "cow": Kind(
        Proportions(size=1.25, trunk=1.05, girth=(0.26, 0.3, 0.27), width=0.78, neck=0.38, neck_angle=20,
                    neck_girth=(0.2, 0.15), head=0.46, head_girth=(0.13, 0.09), head_angle=38, tail=0.75,
                    tail_girth=(0.035, 0.03), tail_angle=70, leg_girth=(0.18, 0.11, 0.055, 0.055), ears=0.14,
                    ear_form="hanging", extras=("horns", "tuft")),
        ("black", "white", "earth", "sand", "red"), ("blotches", "plain", "belly", "blotches"), GRAZER,
    ),
    "crocodile": Kind(
        Proportions(size=0.5, trunk=2.5, girth=(0.38, 0.46, 0.38), width=1.15, neck=0.5, neck_angle=4,
                    neck_girth=(0.34, 0.3), head=1.3, head_girth=(0.28, 0.13), head_angle=5, tail=3.0,
                    tail_girth=(0.28, 0.06), tail_angle=8, tail_curl=4, leg_girth=(0.22, 0.16, 0.11, 0.1), paws=1.0,
                    sprawl=0.35, ears=0.0, extras=("ridge",)),
        ("green", "earth", "grey"), ("belly", "blotches", "stripes"), (("walk",), ("stand",), ("walk", "stand")),
    ),
    "horse": Kind(
        Proportions(size=1.45, trunk=0.98, girth=(0.2, 0.22, 0.24), neck=0.6, neck_angle=50, neck_girth=(0.17, 0.09),
                    head=0.46, head_girth=(0.095, 0.06), head_angle=42, tail=0.65, tail_girth=(0.05, 0.06),
                    tail_angle=58, leg_girth=(0.17, 0.1, 0.046, 0.046), ears=0.12, extras=("mane",)),
        ("earth", "black", "white", "grey", "orange"), HOOFED, GRAZER,
    ),
    "bear": Kind(
        Proportions(size=0.9, trunk=1.2, girth=(0.3, 0.33, 0.32), width=0.85, neck=0.36, neck_angle=15,
                    neck_girth=(0.25, 0.19), head=0.48, head_girth=(0.19, 0.09), head_angle=15, tail=0.12,
                    tail_girth=(0.06, 0.05), leg_girth=(0.24, 0.17, 0.115, 0.1), paws=1.0, ears=0.16, ear_form="round"),
        ("earth", "black", "white", "sand"), ("plain", "belly", "saddle"),
        (("walk",), ("sit",), ("rear",), ("walk", "rear"), ("gallop",), ("shake",)),
    ),
    "kangaroo": Kind(
        Proportions(stance="two", size=0.75, trunk=0.95, girth=(0.26, 0.24, 0.18), pitch=48, neck=0.24, neck_angle=60,
                    neck_girth=(0.12, 0.09), head=0.34, head_girth=(0.11, 0.05), head_angle=18, tail=1.2,
                    tail_girth=(0.14, 0.05), tail_angle=38, tail_curl=-8, leg_girth=(0.22, 0.15, 0.06, 0.06), paws=1.0,
                    ears=0.26, extras=("arms",)),
        ("sand", "grey", "orange"), ("belly", "plain"), (("hop",), ("stand",)), {**PAINTS, "foot": "5a4636"},
    ),
    "fox": Kind(
        Proportions(size=0.4, trunk=1.15, girth=(0.17, 0.18, 0.19), neck=0.36, neck_angle=30, neck_girth=(0.15, 0.12),
                    head=0.46, head_girth=(0.14, 0.045), head_angle=14, tail=1.0, tail_girth=(0.075, 0.05),
                    tail_angle=22, tail_curl=-3, leg_girth=(0.14, 0.09, 0.045, 0.045), paws=0.85, ears=0.26,
                    extras=("brush",)),
        ("orange", "grey", "white", "sand"), ("belly", "plain", "saddle"), HUNTER,
    ),
    "giraffe": Kind(
        Proportions(size=2.3, trunk=0.62, girth=(0.17, 0.19, 0.21), pitch=14, neck=1.1, neck_angle=65,
                    neck_girth=(0.14, 0.06), head=0.3, head_girth=(0.06, 0.036), head_angle=35, tail=0.42,
                    tail_girth=(0.025, 0.02), tail_angle=75, tail_curl=3, leg_girth=(0.13, 0.075, 0.035, 0.038),
                    ears=0.1, extras=("mane", "tuft")),
        ("orange", "sand", "earth"), ("net", "spots"), (("walk",), ("stand",), ("gallop",), ("walk", "stand")),
    ),
    "crow": Kind(
        Proportions(stance="wings", size=0.35, trunk=0.6, girth=(0.14, 0.2, 0.18), pitch=12, neck=0.2, neck_angle=38,
                    neck_girth=(0.13, 0.1), head=0.24, head_girth=(0.11, 0.06), head_angle=8, tail=0.42,
                    tail_girth=(0.08, 0.06), tail_angle=6, tail_curl=0, leg_girth=(0.09, 0.06, 0.026, 0.026), ears=0.0,
                    extras=("beak", "wings", "fan")),
        ("black", "white", "blue", "red", "grey"), ("plain", "belly", "spots"), (("fly",),),
    ),
    "pig": Kind(
        Proportions(size=0.6, trunk=1.35, girth=(0.34, 0.38, 0.34), width=0.85, neck=0.24, neck_angle=8,
                    neck_girth=(0.29, 0.24), head=0.56, head_girth=(0.22, 0.1), head_angle=22, tail=0.3,
                    tail_girth=(0.035, 0.025), tail_angle=-30, tail_curl=60, leg_girth=(0.2, 0.13, 0.07, 0.07),
                    ears=0.2, extras=("snout",)),
        ("pink", "black", "earth"), ("plain", "blotches", "spots"), HEAVY, {**PAINTS, "ear": "c48b7f"},
    ),
    "camel": Kind(
        Proportions(size=1.7, trunk=0.85, girth=(0.2, 0.24, 0.22), neck=0.75, neck_angle=32, neck_girth=(0.13, 0.085),
                    head=0.34, head_girth=(0.085, 0.055), head_angle=12, tail=0.35, tail_girth=(0.03, 0.025),
                    tail_angle=72, leg_girth=(0.14, 0.085, 0.045, 0.05), ears=0.07, extras=("hump", "tuft")),
        ("sand", "earth", "white"), ("plain", "belly"), GRAZER,
    ),
    "duck": Kind(
        Proportions(stance="two", size=0.3, trunk=0.9, girth=(0.24, 0.32, 0.28), pitch=14, neck=0.45, neck_angle=68,
                    neck_girth=(0.13, 0.09), head=0.3, head_girth=(0.14, 0.07), head_angle=8, tail=0.3,
                    tail_girth=(0.15, 0.06), tail_angle=-12, leg_girth=(0.14, 0.09, 0.05, 0.05), ears=0.0,
                    extras=("bill", "folded-wings")),
        ("white", "earth", "grey", "blue"), ("plain", "belly", "spots"), (("stride",), ("peck",), ("stand",)),
    ),
    "goat": Kind(
        Proportions(size=0.75, trunk=1.0, girth=(0.22, 0.25, 0.23), neck=0.42, neck_angle=48, neck_girth=(0.15, 0.1),
                    head=0.4, head_girth=(0.105, 0.055), head_angle=35, tail=0.18, tail_girth=(0.05, 0.04),
                    tail_angle=-20, leg_girth=(0.16, 0.095, 0.048, 0.048), ears=0.17, ear_form="hanging",
                    extras=("curved-horns",)),
        ("white", "earth", "black", "grey"), HOOFED, GRAZER,
    ),
    "trex": Kind(
        Proportions(stance="two", size=1.8, trunk=0.85, girth=(0.25, 0.25, 0.2), pitch=8, neck=0.4, neck_angle=45,
                    neck_girth=(0.17, 0.14), head=0.62, head_girth=(0.17, 0.11), head_angle=8, tail=1.5,
                    tail_girth=(0.2, 0.03), tail_angle=2, tail_curl=-2, leg_girth=(0.23, 0.16, 0.075, 0.075), ears=0.0,
                    extras=("arms",)),
        ("green", "earth", "red", "blue"), ("stripes", "belly", "saddle", "spots"), (("stride",), ("stand",)),
        {**PAINTS, "foot": "4a4a3a"},
    ),
    "lion": Kind(
        Proportions(size=0.95, trunk=1.1, girth=(0.2, 0.22, 0.25), neck=0.38, neck_angle=28, neck_girth=(0.19, 0.16),
                    head=0.42, head_girth=(0.15, 0.085), head_angle=18, tail=0.9, tail_girth=(0.04, 0.035),
                    tail_angle=40, tail_curl=-6, leg_girth=(0.19, 0.12, 0.07, 0.065), paws=1.0, ears=0.13,
                    ear_form="round", extras=("ruff", "tuft")),
        ("sand", "orange", "white"), ("plain", "belly"), HUNTER, {**PAINTS, "mane": "5a351a"},
    ),
    "rhino": Kind(
        Proportions(size=1.3, trunk=1.2, girth=(0.33, 0.38, 0.34), neck=0.3, neck_angle=5, neck_girth=(0.28, 0.22),
                    head=0.6, head_girth=(0.19, 0.12), head_angle=28, tail=0.4, tail_girth=(0.04, 0.025),
                    tail_angle=70, leg_girth=(0.23, 0.17, 0.11, 0.105), paws=0.2, ears=0.16, extras=("nose-horn",)),
        ("grey", "earth"), ("plain", "belly"), HEAVY,
    ),
}  # fmt: skip
"""Kinds by name."""

NAMES = tuple(KINDS)
