"""Rig files as programs write them: names twice, morph targets, animations against the specification."""

import json
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rig_files import Builder, build

from rewild4d.datasets.rigs.reader import clips, load_rig
from rewild4d.errors import UserError


def rewritten(folder: Path, change: Callable[[Builder, dict[str, Any]], object]) -> Path:
    """The hand-made rig with a change to what its file says."""
    data = build(folder / "a.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + length])
    builder = Builder()
    builder.data = data[28 + length :]
    builder.views, builder.accessors = tree.pop("bufferViews"), tree.pop("accessors")
    tree.pop("buffers")
    change(builder, tree)
    return builder.write(folder / "b.glb", tree)


def test_a_second_clip_of_one_name_can_be_had(tmp_path: Path) -> None:
    def double(builder: Builder, tree: dict[str, Any]) -> None:
        samplers = tree["animations"][0]["samplers"]
        still = {"samplers": samplers[:1], "channels": [{"sampler": 0, "target": {"node": 1, "path": "translation"}}]}
        tree["animations"] += [{"name": "Trot", **still}, {"name": "Trot_1", **still}]

    path = rewritten(tmp_path, double)
    assert clips(path) == ["Trot", "Trot_1", "Trot_1_2"]
    first, second = load_rig(path, "Trot"), load_rig(path, "Trot_1")
    assert second.motion == "Trot_1" and np.abs(first.bones - second.bones).max() > 0.5


def test_a_name_in_any_script_is_kept(tmp_path: Path) -> None:
    path = rewritten(tmp_path, lambda builder, tree: tree["animations"][0].update(name="走る 1/2"))
    assert load_rig(path, "走る 1/2").motion == "走る_1_2"


def animate(**said: object) -> Callable[[Builder, dict[str, Any]], object]:
    return lambda builder, tree: tree["animations"][0]["samplers"][0].update(said)


FAULTS: dict[str, tuple[Callable[[Builder, dict[str, Any]], object], str]] = {
    "key times that fall": (
        lambda builder, tree: animate(input=builder.add([2.0, 1.0]))(builder, tree),
        r"b\.glb: expected a consistent glTF, .* \(the key times of an animation fall\)\.",
    ),
    "an unknown interpolation": (
        animate(interpolation="CUBIC"),
        r"\(an animation is interpolated by 'CUBIC', not by LINEAR, STEP, CUBICSPLINE\)\.",
    ),
    "more keys than values": (
        lambda builder, tree: animate(input=builder.add([0.0, 1.0, 2.0]))(builder, tree),
        r"\(an animation has 3 key times and 2 values\)\.",
    ),
    "rotations of three numbers": (
        lambda builder, tree: tree["animations"][0]["channels"][0]["target"].update(path="rotation"),
        r"\(a rotation has 3 numbers, not 4\)\.",
    ),
    "no such scene": (
        lambda builder, tree: tree.update(scene=5),
        r"b\.glb: expected a default scene from 0 to 0, got 5\.",
    ),
}


@pytest.mark.parametrize("fault", FAULTS)
def test_an_animation_against_the_specification(tmp_path: Path, fault: str) -> None:
    change, sentence = FAULTS[fault]
    with pytest.raises(UserError, match=sentence):
        load_rig(rewritten(tmp_path, change), "Trot")


def with_targets(
    weights: list[float], keys: list[list[float]] | None = None
) -> Callable[[Builder, dict[str, Any]], None]:
    """Two morph targets of the quad: one lifts its upper corners by 1, one moves all by 2 along z."""

    def change(builder: Builder, tree: dict[str, Any]) -> None:
        lift = builder.add([[0, 0, 0], [0, 0, 0], [0, 1, 0], [0, 1, 0]])
        push = builder.add([[0, 0, 2]] * 4)
        tree["meshes"][0]["primitives"][0]["targets"] = [{"POSITION": lift}, {"POSITION": push}]
        tree["meshes"][0]["weights"] = weights
        if keys is not None:
            clip = tree["animations"][0]
            clip["samplers"].append({"input": builder.add([0.0, 2.0]), "output": builder.add(np.ravel(keys))})
            clip["channels"].append({"sampler": len(clip["samplers"]) - 1, "target": {"node": 5, "path": "weights"}})

    return change


@pytest.mark.parametrize(("weights", "keys"), [([0.5, 0.25], None), ([0.0, 0.0], [[0.5, 0.25]] * 2)])
def test_morph_targets_that_keep_still_shape_the_animal(
    tmp_path: Path, weights: list[float], keys: list[list[float]] | None
) -> None:
    plain = load_rig(build(tmp_path / "plain.glb"), "Trot").surfaces[0].vertices
    shaped = load_rig(rewritten(tmp_path, with_targets(weights, keys)), "Trot").surfaces[0].vertices
    scale = 2.0  # of the armature
    moved = scale * np.array([[0, 0, 0.25 * 2], [0, 0, 0.25 * 2], [0, 0.5, 0.25 * 2], [0, 0.5, 0.25 * 2]])
    np.testing.assert_allclose(shaped - plain, moved, atol=1e-6)


def test_morph_targets_that_move_are_refused(tmp_path: Path) -> None:
    path = rewritten(tmp_path, with_targets([0.0, 0.0], [[0.0, 0.0], [1.0, 0.0]]))
    sentence = r"b\.glb: expected an animal that bones alone move, but clip 'Trot' changes morph targets, by up to 0\.3"
    with pytest.raises(UserError, match=sentence):
        load_rig(path, "Trot")
