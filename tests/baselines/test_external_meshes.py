"""Meshes of others: animated glTF, OBJ files whole and damaged, and the discs that they become."""

import math
import re
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import torch
from external_program import fit, posed
from external_stub import png
from rig_files import Builder

from rewild4d.baselines.external import ExternalConfig
from rewild4d.baselines.external_folder import find_outputs
from rewild4d.baselines.external_gltf import read_animation
from rewild4d.baselines.external_profiles import PROFILES
from rewild4d.errors import UserError
from rewild4d.io.meshes import Mesh, discs, read_mesh
from rewild4d.types import Case

pytestmark = pytest.mark.usefixtures("coarse_grid")


def glb(path: Path, morph: bool, moving: bool, clips: int = 1) -> None:
    """A square that grows by a morph target, or moves with its node, over one second."""
    points = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], np.float32)
    faces = np.array([0, 1, 2, 0, 2, 3], np.uint16)
    offsets = np.array([(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0)], np.float32)
    keys, shift = np.array([0, 1], np.float32), np.array([(0, 0, 0), (0, 0, 8)], np.float32)
    blocks = [points, faces, offsets, keys, np.array([0, 1], np.float32), shift]
    data, views, at = b"", [], 0
    for block in blocks:
        raw = block.tobytes() + b"\0" * (-block.nbytes % 4)
        views.append(pygltflib.BufferView(buffer=0, byteOffset=at, byteLength=block.nbytes))
        data, at = data + raw, at + len(raw)
    floats, shorts = 5126, 5123
    accessors = [
        pygltflib.Accessor(bufferView=0, componentType=floats, count=4, type="VEC3", min=[0, 0, 0], max=[1, 1, 0]),
        pygltflib.Accessor(bufferView=1, componentType=shorts, count=6, type="SCALAR"),
        pygltflib.Accessor(bufferView=2, componentType=floats, count=4, type="VEC3"),
        pygltflib.Accessor(bufferView=3, componentType=floats, count=2, type="SCALAR", min=[0], max=[1]),
        pygltflib.Accessor(bufferView=4, componentType=floats, count=2, type="SCALAR"),
        pygltflib.Accessor(bufferView=5, componentType=floats, count=2, type="VEC3"),
    ]
    primitive = pygltflib.Primitive(
        attributes=pygltflib.Attributes(POSITION=0), indices=1, targets=[{"POSITION": 2}] if morph else []
    )
    target = pygltflib.AnimationChannelTarget(node=0, path="weights" if morph else "translation")
    animation = pygltflib.Animation(
        samplers=[pygltflib.AnimationSampler(input=3, output=4 if morph else 5)],
        channels=[pygltflib.AnimationChannel(sampler=0, target=target)],
    )
    tree = pygltflib.GLTF2(
        scene=0, scenes=[pygltflib.Scene(nodes=[0])], nodes=[pygltflib.Node(mesh=0)],
        meshes=[pygltflib.Mesh(primitives=[primitive])], accessors=accessors, bufferViews=views,
        buffers=[pygltflib.Buffer(byteLength=len(data))], animations=[animation] * clips if moving else [],
    )  # fmt: skip
    tree.set_binary_blob(data)
    tree.save_binary(str(path))


def test_an_animated_glb_moves_by_morphs_and_by_nodes(tmp_path: Path) -> None:
    """Moments of a video from 2 s to 8 s in a clip of one second: the first at its start, the last at its end."""
    glb(tmp_path / "morph.glb", morph=True, moving=True)
    times = [2.0, 4.0, 5.0, 8.0]
    moments = read_animation(tmp_path / "morph.glb", times)
    assert [float(parts[0].vertices[2, 0]) for parts in moments] == pytest.approx([1 + (t - 2) / 6 for t in times])
    glb(tmp_path / "node.glb", morph=False, moving=True)
    moments = read_animation(tmp_path / "node.glb", times)
    assert [float(parts[0].vertices[0, 2]) for parts in moments] == pytest.approx([8 * (t - 2) / 6 for t in times])
    glb(tmp_path / "still.glb", morph=False, moving=False)
    with pytest.raises(UserError, match="still.glb: expected one animation, got none"):
        read_animation(tmp_path / "still.glb", times)
    glb(tmp_path / "two.glb", morph=False, moving=True, clips=2)
    with pytest.raises(UserError, match="two.glb: expected one animation, got clip_0, clip_1"):
        read_animation(tmp_path / "two.glb", times)


def test_a_glb_is_a_result(case: Case, tmp_path: Path) -> None:
    glb(tmp_path / "square.glb", morph=True, moving=True)
    config = ExternalConfig(folder=str(tmp_path), profile="glb", points=500)
    found = fit(case, config)
    sizes = [float(found.at(time).means[:, 0].amax()) for time in case.clip.times]
    assert sizes == pytest.approx([1.0, 1.5, 2.0], abs=0.05)
    glb(tmp_path / "other.glb", morph=True, moving=True)
    with pytest.raises(UserError, match=re.escape("expected one animated file *.glb or *.gltf, found 2")):
        fit(case, config)


def test_files_are_ordered_by_their_numbers(tmp_path: Path) -> None:
    for index in range(1, 12):
        (tmp_path / f"frame_{index}.ply").touch()
    found = find_outputs(tmp_path, PROFILES["frames"], 11)
    assert [path.stem for path in found] == [f"frame_{index}" for index in range(1, 12)]


@pytest.mark.parametrize(
    ("names", "fault"),
    [
        (("0000", "0002", "0003"), "found 3; the first that is missing is 1."),
        (("0001", "0002", "0004"), "found 3; the first that is missing is 3."),
        (("0002", "0003", "0004"), "found 3; the first that is missing is 0."),
        (("0000", "0000_final", "0002"), "found 3; more than one has the number 0."),
        (("0000", "0001", "0002", "0003"), "found 4."),
    ],
)
def test_files_are_numbered_like_the_frames(tmp_path: Path, names: tuple[str, ...], fault: str) -> None:
    for name in names:
        (tmp_path / f"frame_{name}.ply").touch()
    with pytest.raises(
        UserError, match=re.escape(f"expected 3 files frame_*.ply or frame_*.obj, one a frame, {fault}")
    ):
        find_outputs(tmp_path, PROFILES["frames"], 3)


DREAM = "32 files extracted_textured_meshes/extracted_mesh_*.obj or **/extracted_mesh_*.obj (or 8, one a frame)"
GVF = "at least 2 files gaussians/*.ply or *.ply, numbered one after another"


@pytest.mark.parametrize(
    ("profile", "numbers", "fault"),
    [
        ("dreammesh4d", range(32), ""),
        ("dreammesh4d", range(8), ""),  # somebody made it one a frame
        ("dreammesh4d", range(16), f"expected {DREAM}, found 16; the first that is missing is 16."),
        ("dreammesh4d", (*range(5), *range(6, 32)), f"expected {DREAM}, found 31; the first that is missing is 5."),
        ("dreammesh4d", (0, 1, 2, 4, 5, 6, 7), f"expected {DREAM}, found 7; the first that is missing is 3."),
        ("dreammesh4d", (0,), f"expected {DREAM}, found 1; the first that is missing is 1."),
        ("dreammesh4d", range(33), f"expected {DREAM}, found 33."),
        ("gvfdiffusion", range(24), ""),
        ("gvfdiffusion", range(1, 5), ""),
        ("gvfdiffusion", (0, 1, 2, 4, 5, 6, 7), f"expected {GVF}, found 7; the first that is missing is 3."),
        ("gvfdiffusion", ("0", "1", "01", "2"), f"expected {GVF}, found 4; more than one has the number 1."),
        ("gvfdiffusion", (0,), f"expected {GVF}, found 1; the first that is missing is 1."),
        ("gvfdiffusion", ("canonical", 0, 1), f"expected {GVF}, found 3; at least one has no number in its name."),
    ],
)
def test_spread_files_are_whole_too(tmp_path: Path, profile: str, numbers: Iterable[int | str], fault: str) -> None:
    """A program with a number of moments of its own: nothing that it lost is spread over the clip unsaid."""
    paths = [tmp_path / (f"extracted_mesh_{i}.obj" if profile == "dreammesh4d" else f"{i}.ply") for i in numbers]
    for path in paths:
        path.touch()
    if fault:
        with pytest.raises(UserError, match=re.escape(fault)):
            find_outputs(tmp_path, PROFILES[profile], 8)
    else:
        assert find_outputs(tmp_path, PROFILES[profile], 8) == paths


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\n"
TEXTURED = f"mtllib a.mtl\n{OBJ}f 1/1 2/2 3/3\n"


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        (OBJ + "f 1 2 9\n", "expected faces of vertices 1 to 4, got one of another"),
        (OBJ + "f 1 2 x\n", "expected numbers in line 5, got 'f 1 2 x'"),
        (OBJ + "f 0 1 2\n", "expected a face of three or more corners, counted from 1, in line 5, got 'f 0 1 2'"),
        (OBJ + "f 1 2 3\nf 2 3\n", "expected a face of three or more corners, counted from 1, in line 6, got 'f 2 3'"),
        ("v 0 0\nf 1 1 1\n", "expected vertices with three coordinates, got fewer"),
        ("", "expected vertices with three coordinates, got no vertex"),
        (OBJ, "expected a mesh with triangles, got 4 points without any"),
        ("v 0 0 nan\n" + OBJ + "f 1 2 3\n", "expected finite coordinates, got a NaN or an infinite value in vertex 0"),
        (OBJ + "v 0 0 -1e30\nf 1 2 3\n", "expected coordinates of at most 1e+09, got 1e+30 in vertex 4"),
        (OBJ + f"f 1 2 {10**30}\n", "expected faces of vertices 1 to 4, got one of another"),
        ("v 0 0 0 nan 1 1\n" * 3 + "f 1 2 3\n", "expected finite colours, got a NaN or an infinite value in vertex 0"),
        (TEXTURED + "vt 0\nvt 0 0\nvt 0 1 0\n", "expected texture coordinates of two numbers, got 1 in vt 0"),
        (TEXTURED + "vt 0 0\nvt\nvt 0 1\n", "expected texture coordinates of two numbers, got 0 in vt 1"),
        (TEXTURED + "vt 0 0\nvt 0 1\nvt 0 inf\n", "expected finite texture coordinates, got a NaN or an infinite"),
        (TEXTURED + "vt 0 0\n", "expected faces of texture coordinates 1 to 1, got one of another"),
    ],
)
def test_a_damaged_obj_is_one_sentence(tmp_path: Path, text: str, sentence: str) -> None:
    (tmp_path / "a.obj").write_text(text)
    (tmp_path / "a.mtl").write_text("map_Kd a.png\n")
    (tmp_path / "a.png").write_bytes(png(1, 1, b"\0\1\2\3"))
    with pytest.raises(UserError, match=re.escape(f"a.obj: {sentence}")):
        read_mesh(tmp_path / "a.obj")


def test_texture_coordinates_may_have_a_third_number(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text(TEXTURED.replace("f ", "vt 0 0\nvt 0 0 0\nvt 1 1\nf "))
    (tmp_path / "a.mtl").write_text("map_Kd a.png\n")
    (tmp_path / "a.png").write_bytes(png(1, 1, b"\0\1\2\3"))
    mesh = read_mesh(tmp_path / "a.obj")
    assert mesh.uv is not None and mesh.uv.tolist() == [[[0, 0], [0, 0], [1, 1]]]


def test_an_obj_has_polygons_backward_indices_and_colours(tmp_path: Path) -> None:
    square = "v 0 0 0 1 0 0\nv 1 0 0 1 0 0\nv 1 1 0 0 1 0\nv 0 1 0 0 1 0\nf -4 -3 -2 -1\n"
    (tmp_path / "a.obj").write_text(square)
    mesh = read_mesh(tmp_path / "a.obj")
    assert mesh.faces.tolist() == [[0, 1, 2], [0, 2, 3]]
    (found,) = discs([mesh], 2000, 0)
    assert found.colors is not None
    torch.testing.assert_close(found.colors[:, 1], found.points[:, 1], atol=1e-5, rtol=0)
    assert found.radius == pytest.approx(math.sqrt(1 / (math.pi * 2000)))
    # Uniform on the unit square.
    torch.testing.assert_close(found.points[:, :2].mean(0), torch.full((2,), 0.5), atol=0.03, rtol=0)
    flat = Mesh(torch.zeros(3, 3), torch.tensor([[0, 1, 2]]))
    with pytest.raises(ValueError, match="expected triangles with an area, got 1 triangles without"):
        discs([flat], 10, 0)


def test_meshes_of_one_topology_keep_their_points(case: Case) -> None:
    meshes = [Mesh(posed(case, index).float(), case.prior.faces) for index in range(2)]
    moved = meshes[0].vertices + torch.tensor((1.0, 0.0, 0.0))
    first, second = discs([meshes[0], replace(meshes[0], vertices=moved)], 300, 0)
    torch.testing.assert_close(second.points - first.points, torch.tensor((1.0, 0, 0)).expand(300, 3))


def skinned(path: Path, weights: list[float] | None) -> Path:
    """A triangle that hangs on a sliding joint and has a morph target along y, and another that hangs on nothing."""
    b = Builder()
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0]]
    attributes = {
        "POSITION": b.add(corners), "JOINTS_0": b.add([[0, 0, 0, 0]] * 3, np.uint8),
        "WEIGHTS_0": b.add([[1, 0, 0, 0]] * 3), "TEXCOORD_0": b.add([[0, 0], [1, 0], [0, 1]]),
    }  # fmt: skip
    picture = b.view(np.frombuffer(png(2, 2, 2 * (b"\0" + 6 * b"\xff")), np.uint8))
    primitive = {"attributes": attributes, "targets": [{"POSITION": b.add([[0, 2, 0]] * 3)}], "material": 0}
    samplers = [{"input": b.add([0, 1]), "output": b.add([[0, 0, 0], [0, 0, 4]])}]
    channels = [{"sampler": 0, "target": {"node": 0, "path": "translation"}}]
    node = {"mesh": 0, "skin": 0, "translation": [50, 0, 0]} | ({} if weights is None else {"weights": weights})
    pbr = {"baseColorFactor": [1.0, 0.0, 0.0, 1.0], "baseColorTexture": {"index": 0}}
    tree = {
        "scene": 0, "scenes": [{"nodes": [0, 1, 2]}], "nodes": [{"name": "joint"}, node, {"mesh": 1}],
        "meshes": [{"primitives": [primitive], "weights": [0.25]}, {"primitives": [{"attributes": attributes}]}],
        "skins": [{"joints": [0]}], "materials": [{"pbrMetallicRoughness": pbr}],
        "textures": [{"source": 0}], "images": [{"bufferView": picture, "mimeType": "image/png"}],
        "animations": [{"samplers": samplers, "channels": channels}],
    }  # fmt: skip
    return b.write(path, tree)


@pytest.mark.parametrize(("weights", "share"), [(None, 0.25), ([0.5], 0.5)])
def test_a_skinned_glb_keeps_its_morphs_and_what_stands_beside_it(
    tmp_path: Path, weights: list[float] | None, share: float
) -> None:
    """A node's weights go before its mesh's; a skinned mesh ignores the transform of its node."""
    first, last = read_animation(skinned(tmp_path / "a.glb", weights), [0.0, 3.0])
    assert len(first) == len(last) == 2
    assert first[0].vertices[0].tolist() == [0, 2 * share, 0] and last[0].vertices[0].tolist() == [0, 2 * share, 4]
    assert torch.equal(first[1].vertices, last[1].vertices)
    (found,) = discs([first[0]], 20, 0)
    assert found.colors is not None
    assert torch.equal(found.colors, torch.tensor((1.0, 0.0, 0.0)).expand(20, 3)), "a white texture times red"
