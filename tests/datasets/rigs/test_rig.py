"""Rigs: a hand-made glTF whose every pose can be worked out on paper, broken files, and real animals."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from external_stub import png
from rig_files import Builder, build

from rewild4d.datasets.rigs.colors import linear_to_srgb
from rewild4d.datasets.rigs.gltf import compose, sample
from rewild4d.datasets.rigs.reader import clips, load_rig
from rewild4d.errors import UserError


def test_skinned_vertices_follow_arithmetic(tmp_path: Path) -> None:
    animal = load_rig(build(tmp_path / "a.glb"), "Trot", frames=4)
    quad = animal.surfaces[0]
    np.testing.assert_allclose(quad.vertices, 2 * np.array([[0, 0, 0], [1, 0, 0], [0, 3, 0], [1, 3, 0]]), atol=1e-6)
    assert animal.fps == 4 / 2 and animal.parents.tolist() == [-1, 0] and animal.bone_names == ("root", "tip")
    # frame 3 is at 1.5 s: scale 1 + 2 * 1.5 / 2 = 2.5, the tip turned by half a turn

    def root(x: float, y: float) -> np.ndarray:
        return 2 * np.array([2.5 * x, 1 + 2.5 * (y - 1), 0])

    def tip(x: float, y: float) -> np.ndarray:
        return 2 * np.array([-2.5 * x, 1 + 2.5 * (2 - (y - 3)), 0])

    expected = [root(0, 0), root(1, 0), tip(0, 3), 0.2 * root(1, 3) + 0.8 * tip(1, 3)]
    np.testing.assert_allclose(animal.posed(3)[0], expected, atol=1e-5)
    np.testing.assert_allclose(animal.posed(0)[0], quad.vertices, atol=1e-5)


def test_unskinned_child_is_rigid_through_intermediate_nodes(tmp_path: Path) -> None:
    animal = load_rig(build(tmp_path / "a.glb"), "Trot", frames=4)
    # rest: armature scale 2, the tip at y = 3, 5 along z, half a turn about z
    np.testing.assert_allclose(animal.surfaces[1].vertices, [[0, 6, 10], [-2, 6, 10], [0, 4, 10]], atol=1e-5)
    # 1.5 s: everything below the root is 2.5 times larger, and the tip's half turn cancels the node's own
    y = 2 * (1 + 2.5 * 2)
    np.testing.assert_allclose(animal.posed(3)[1], [[0, y, 25], [5, y, 25], [0, y + 5, 25]], atol=1e-5)


def test_moving_intermediate_node_becomes_a_bone(tmp_path: Path) -> None:
    animal = load_rig(build(tmp_path / "a.glb", move_tag=True, attach_to=1), "Trot", frames=4)
    assert animal.bone_names == ("root", "tip", "tag") and animal.parents.tolist() == [-1, 0, 0]
    # 0.5 s: scale 1.5, slid by 1: the tag's corner is at root + scale * slide
    np.testing.assert_allclose(animal.posed(1)[1][0], [2 * 1.5 * 1.0, 2, 0], atol=1e-5)


def test_older_materials_have_their_colour(tmp_path: Path) -> None:
    """Diffuse factor and texture of KHR_materials_pbrSpecularGlossiness, which many rigs of old have alone."""
    b, corners = Builder(), [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    attributes = {
        "POSITION": b.add(corners), "TEXCOORD_0": b.add([[0, 0], [1, 0], [0, 1]]),
        "JOINTS_0": b.add([[0, 0, 0, 0]] * 3, np.uint8), "WEIGHTS_0": b.add([[1, 0, 0, 0]] * 3),
    }  # fmt: skip
    picture = b.view(np.frombuffer(png(2, 2, 2 * (b"\0" + 2 * bytes((255, 128, 0)))), np.uint8))
    older = {"diffuseFactor": [0.5, 0.25, 1.0, 1.0], "diffuseTexture": {"index": 0}}
    samplers = [{"input": b.add([0, 1]), "output": b.add([[0, 0, 0], [1, 0, 0]])}]
    channels = [{"sampler": 0, "target": {"node": 0, "path": "translation"}}]
    name = "KHR_materials_pbrSpecularGlossiness"
    tree = {
        "scene": 0, "scenes": [{"nodes": [0, 1]}], "nodes": [{"name": "root"}, {"mesh": 0, "skin": 0}],
        "meshes": [{"primitives": [{"attributes": attributes, "material": 0}]}], "skins": [{"joints": [0]}],
        "materials": [{"extensions": {name: older}}], "extensionsRequired": [name], "extensionsUsed": [name],
        "textures": [{"source": 0}], "images": [{"bufferView": picture, "mimeType": "image/png"}],
        "animations": [{"samplers": samplers, "channels": channels}],
    }  # fmt: skip
    (surface,) = load_rig(b.write(tmp_path / "a.glb", tree), "clip_0").surfaces
    np.testing.assert_allclose(surface.colors, np.tile(linear_to_srgb(np.array([0.5, 0.25, 1.0])), (3, 1)))
    assert surface.texture is not None and surface.texture[0, 0].tolist() == [255, 128, 0]


def test_scenery_is_left_out(tmp_path: Path) -> None:
    assert len(load_rig(build(tmp_path / "a.glb", attach_to=0), "Trot").surfaces) == 1


def test_colors_are_linear_factor_times_vertex_color(tmp_path: Path) -> None:
    colors = load_rig(build(tmp_path / "a.glb"), "Trot").surfaces[0].colors
    half = 1.055 * 0.5 ** (1 / 2.4) - 0.055
    np.testing.assert_allclose(colors[[0, 2]], [[half, 0, 0], [0, 1, 0]], atol=1e-9)
    assert linear_to_srgb(np.array([0.002]))[0] == pytest.approx(12.92 * 0.002)


def test_interpolation() -> None:
    keys, times = np.array([1.0, 3.0]), np.array([0.0, 2.0, 9.0])
    values = np.array([[0.0], [8.0]])
    assert sample(keys, values, "LINEAR", times, False)[:, 0].tolist() == [0, 4, 8]
    assert sample(keys, values, "STEP", times, False)[:, 0].tolist() == [0, 0, 8]
    # Hermite at the middle: (p0 + p1) / 2 + span (m0 - m1) / 8, tangents out of key 0 and into key 1
    cubic = np.array([[9.0], [0.0], [1.0], [-3.0], [8.0], [9.0]])
    assert sample(keys, cubic, "CUBICSPLINE", np.array([2.0]), False)[0, 0] == 4 + 2 * (1 - -3) / 8
    quarter = np.array([[0, 0, 0, 1.0], [0, 0, -np.sqrt(0.5), -np.sqrt(0.5)]])  # 0 and 90 degrees, opposite sign
    middle = sample(keys, quarter, None, np.array([2.0]), True)[0]
    np.testing.assert_allclose(middle, [0, 0, np.sin(np.pi / 8), np.cos(np.pi / 8)], atol=1e-12)
    turned = compose(np.zeros((1, 3)), quarter[1:], np.full((1, 3), 2.0))[0] @ [1, 0, 0, 1]
    np.testing.assert_allclose(turned, [0, 2, 0, 1], atol=1e-12)


def test_bad_files(tmp_path: Path) -> None:
    good = build(tmp_path / "good.glb")
    assert clips(good) == ["Trot"]
    with pytest.raises(UserError, match=r"good.glb: unknown clip 'Trott'. Did you mean 'Trot'\? Available: Trot\.$"):
        load_rig(good, "Trott")
    with pytest.raises(UserError, match=r"still.glb: expected a skinned mesh, but the file has none\."):
        load_rig(build(tmp_path / "still.glb", skinned=False), "Trot")
    with pytest.raises(UserError, match=r"none.glb: expected a .glb or .gltf file, but: No such file"):
        clips(tmp_path / "none.glb")
    (tmp_path / "text.glb").write_text("no glTF at all")
    with pytest.raises(UserError, match=r"text.glb: expected a .glb or .gltf file, but it cannot be parsed"):
        clips(tmp_path / "text.glb")
    (tmp_path / "cut.glb").write_bytes(good.read_bytes()[:-400])
    with pytest.raises(UserError, match=r"cut.glb: expected"):
        load_rig(tmp_path / "cut.glb", "Trot")


BROKEN = "expected a consistent glTF, but what it says does not fit"


def without(tree: dict, key: str) -> None:
    del tree[key]


@pytest.mark.parametrize(
    ("change", "sentence"),
    [
        (lambda t: without(t, "skins"), "expected a consistent glTF, but what it says does not fit (list index out of"),
        (lambda t: t["nodes"][5].update(mesh=7), BROKEN),
        (lambda t: t["nodes"][0].update(children=[999]), BROKEN),
        (lambda t: t["accessors"][0].update(bufferView=99), BROKEN),
        (lambda t: t["accessors"][0].update(count=-5), "expected joints and weights of -5 vertices, but 4, 4 came"),
        (lambda t: t["accessors"][2].update(count=3), "expected joints and weights of 4 vertices, but "),
        (lambda t: t["accessors"][0].update(byteOffset=-4), "expected data that lies in its buffer, but view 0"),
        (lambda t: t["bufferViews"][0].update(byteStride=-12), "expected data that lies in its buffer, but view 0"),
        (lambda t: t["accessors"][0].update(count=10**11), "expected joints and weights of 100000000000"),
        (lambda t: t["skins"][0].update(joints=[]), "expected joints, but skin 0 has none"),
        (lambda t: t["nodes"][0].update(children=[0]), "expected a node hierarchy without cycles"),
        (lambda t: t["nodes"][2].update(children=[1]), "expected a node hierarchy without cycles"),
        (lambda t: t["skins"][0].update(joints=[1, 99]), BROKEN),
        (lambda t: t["meshes"][0]["primitives"][0]["attributes"].pop("POSITION"), "expected a consistent glTF, but"),
        (lambda t: t["nodes"][0].update(scale=[0, 0, 0]), BROKEN),
        (lambda t: t["nodes"][1].update(rotation=[0, 0, 0, 0]), "expected a mesh of some size in every pose, but"),
        (lambda t: [m["primitives"][0].update(mode=1) for m in t["meshes"]], "expected a mesh of triangles, but"),
    ],
)  # fmt: skip
def test_a_file_that_contradicts_itself_is_one_sentence(tmp_path: Path, change, sentence: str) -> None:  # type: ignore[no-untyped-def]
    data = build(tmp_path / "a.glb").read_bytes()
    length = struct.unpack_from("<I", data, 12)[0]
    tree = json.loads(data[20 : 20 + length])
    change(tree)
    builder = Builder()
    builder.data = data[28 + length :]
    with pytest.raises(UserError) as error:
        load_rig(builder.write(tmp_path / "b.glb", tree), "Trot")
    assert str(error.value).startswith(f"{tmp_path / 'b.glb'}: {sentence}")


@pytest.mark.parametrize("name", ["horse", "wolf", "fox", "cow", "khronos_fox"])
def test_real_rigs(rigs: Path, name: str) -> None:
    animal = load_rig(rigs / f"{name}.glb", "Walk", frames=3)
    assert (animal.parents < np.arange(len(animal.parents))).all()
    assert animal.parents[0] == -1 and np.isfinite(animal.bones).all()
    for surface in animal.surfaces:
        np.testing.assert_allclose(surface.bone_weights.sum(1), 1, atol=1e-6)
    rest = np.concatenate([surface.vertices for surface in animal.surfaces])
    size = np.ptp(rest, axis=0)
    assert rest[:, 1].min() == pytest.approx(0, abs=0.03 * size[1]), "the feet stand on the ground"
    assert size[2] > 2 * size[0], "an animal is longer than wide"
    for frame in range(3):
        np.testing.assert_allclose(np.ptp(np.concatenate(animal.posed(frame)), axis=0)[1:], size[1:], rtol=0.25)
