"""Materials of glTF files: solid ones are drawn as the specification says, those that one sees through are refused."""

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from rig_files import Builder

from rewild4d.datasets.rigs.animal import Surface
from rewild4d.datasets.rigs.colors import baked, linear_to_srgb
from rewild4d.datasets.rigs.reader import load_rig
from rewild4d.datasets.rigs.shading import Picture, raycaster, sample_texture
from rewild4d.errors import UserError
from rewild4d.transforms import look_at
from rewild4d.types import Camera

CORNERS = [[-1, -1, 0], [3, -1, 0], [-1, 3, 0]]
GREY = np.array([0.25, 0.5, 0.125])


def surface(
    folder: Path, material: dict[str, Any], *, pixels: bytes = b"", width: int = 1, wrap: int = 10497,
    colors: Any = None, kind: type = np.float32, uv: Any = ((0, 0), (1, 0), (0, 1)), faces: tuple[int, ...] = (0, 1, 2),
) -> Surface:  # fmt: skip
    """The one triangle of a rig with a material; ``pixels`` are the rows of its texture 0, RGB or RGBA."""
    b = Builder()
    attributes = {
        "POSITION": b.add(CORNERS), "TEXCOORD_0": b.add(uv),
        "JOINTS_0": b.add([[0, 0, 0, 0]] * 3, np.uint8), "WEIGHTS_0": b.add([[1, 0, 0, 0]] * 3),
    }  # fmt: skip
    if colors is not None:
        attributes["COLOR_0"] = b.add(colors, kind)
    samplers = [{"input": b.add([0, 1]), "output": b.add([[0, 0, 0], [1, 0, 0]])}]
    channels = [{"sampler": 0, "target": {"node": 0, "path": "translation"}}]
    primitive = {"attributes": attributes, "material": 0, "indices": b.add(faces, np.uint16)}
    tree: dict[str, Any] = {
        "nodes": [{"name": "root"}, {"mesh": 0, "skin": 0}], "skins": [{"joints": [0]}],
        "meshes": [{"primitives": [primitive]}], "materials": [material],
        "animations": [{"samplers": samplers, "channels": channels}],
    }  # fmt: skip
    if pixels:
        rows = np.frombuffer(pixels, np.uint8).reshape(1, width, -1)
        image = cv2.imencode(".png", rows[..., [2, 1, 0, 3][: rows.shape[2]]])[1]
        tree |= {"images": [{"bufferView": b.view(image)}], "samplers": [{"wrapS": wrap}]}
        tree |= {"textures": [{"source": 0, "sampler": 0}]}
    (found,) = load_rig(b.write(folder / "a.glb", tree), "clip_0", 1).surfaces
    return found


def seen(drawn: Surface, behind: bool = False) -> np.ndarray:
    """The colour in the middle of a picture, from the front (+z) or from behind; the sun shines from above."""
    scene = raycaster([drawn.vertices], [drawn])
    up = np.array([0.0, 1.0, 0.0])
    picture = Picture(scene, [drawn], drawn.vertices, np.zeros(3), up, up)
    eye = torch.tensor((0.0, 0.0, -4.0 if behind else 4.0)).double()
    view = look_at(eye, torch.zeros(3).double(), torch.tensor((0.0, 1.0, 0.0)).double())
    intrinsics = torch.tensor(((9.0, 0, 4.5), (0, 9, 4.5), (0, 0, 1))).double()
    rgb, alpha = picture.render(Camera(view, intrinsics, 9, 9))
    assert alpha[4, 4] == 255
    return rgb[4, 4] / 255


def factor(*rgba: float) -> dict[str, Any]:
    return {"pbrMetallicRoughness": {"baseColorFactor": list(rgba)}}


GLASS = {"extensions": {"KHR_materials_transmission": {"transmissionFactor": 0.9}}}
PAINTED = {"pbrMetallicRoughness": {"baseColorTexture": {"index": 0}}}


@pytest.mark.parametrize(
    ("material", "given", "way"),
    [
        (factor(1, 1, 1, 0.4) | {"alphaMode": "MASK", "name": "fur"}, {}, "'fur' is not (alphaMode MASK, alpha"),
        ({**factor(1, 1, 1, 0.9), "alphaMode": "MASK", "alphaCutoff": 0.95}, {}, "alphaMode MASK, alpha down to 0.9"),
        ({**factor(1, 1, 1, 0.9), "alphaMode": "BLEND"}, {}, "alphaMode BLEND, alpha down to 0.9"),
        ({**PAINTED, "alphaMode": "BLEND"}, {"pixels": bytes((9, 9, 9, 51))}, "alphaMode BLEND, alpha down to 0.2"),
        ({"alphaMode": "BLEND"}, {"colors": [[1, 1, 1, 0.5]] * 3}, "alphaMode BLEND, alpha down to 0.5"),
        (GLASS, {}, "it transmits light"),
        ({"alphaMode": "DITHER"}, {}, "expected alphaMode OPAQUE, MASK or BLEND, got 'DITHER'"),
    ],
)  # fmt: skip
def test_what_one_sees_through_is_refused(
    material: dict[str, Any], given: dict[str, Any], way: str, tmp_path: Path
) -> None:
    with pytest.raises(UserError) as caught:
        surface(tmp_path, material, **given)
    assert str(caught.value).startswith(f"{tmp_path / 'a.glb'}: expected ") and way in str(caught.value)


@pytest.mark.parametrize(
    ("material", "given"),
    [
        ({**factor(1, 0, 0, 0.1)}, {}),
        ({**factor(1, 0, 0, 0.5), "alphaMode": "MASK"}, {}),
        ({**factor(1, 0, 0, 1.0), "alphaMode": "BLEND"}, {}),
        ({**PAINTED, "alphaMode": "BLEND"}, {"pixels": bytes((255, 0, 0, 255))}),
        ({**PAINTED, "alphaMode": "BLEND"}, {"pixels": bytes((255, 0, 0))}),
    ],
)
def test_what_is_solid_all_over_is_drawn(material: dict[str, Any], given: dict[str, Any], tmp_path: Path) -> None:
    shown = seen(surface(tmp_path, material, **given))
    assert shown[0] > 0.69 and shown[1:].tolist() == [0, 0]


def test_an_unlit_material_has_its_own_colour(tmp_path: Path) -> None:
    unlit = {**factor(*GREY, 1), "extensions": {"KHR_materials_unlit": {}}, "emissiveFactor": [1, 1, 1]}
    np.testing.assert_allclose(seen(surface(tmp_path, unlit)), linear_to_srgb(GREY), atol=0.6 / 255)
    lit = seen(surface(tmp_path, factor(*GREY, 1)))
    assert (lit < linear_to_srgb(GREY) - 0.02).all(), "a wall under the sun of noon is shaded"


def test_light_of_its_own_is_added_unshaded(tmp_path: Path) -> None:
    alone = surface(tmp_path, {**factor(0, 0, 0, 1), "emissiveFactor": GREY.tolist()})
    np.testing.assert_allclose(seen(alone), linear_to_srgb(GREY), atol=0.6 / 255)
    strong = {"KHR_materials_emissive_strength": {"emissiveStrength": 2.0}}
    both = surface(tmp_path, {**factor(*GREY, 1), "emissiveFactor": (GREY / 4).tolist(), "extensions": strong})
    shaded = seen(surface(tmp_path, factor(*GREY, 1)))
    linear = np.where(shaded <= 0.04045, shaded / 12.92, ((shaded + 0.055) / 1.055) ** 2.4)
    np.testing.assert_allclose(seen(both), linear_to_srgb(linear + GREY / 2), atol=2 / 255)
    assert baked(both).glow is None
    np.testing.assert_allclose(baked(both).colors[0], linear_to_srgb(GREY + GREY / 2))


def test_light_has_a_texture(tmp_path: Path) -> None:
    material = {**factor(0, 0, 0, 1), "emissiveFactor": [1, 1, 1], "emissiveTexture": {"index": 0}}
    alone = surface(tmp_path, material, pixels=bytes((200, 30, 10)))
    np.testing.assert_allclose(seen(alone), np.array((200, 30, 10)) / 255, atol=0.6 / 255)
    plain = baked(alone)
    assert plain.texture is not None and plain.texture[0, 0].tolist() == [200, 30, 10]
    np.testing.assert_allclose(plain.colors, 1.0)


def test_a_mirrored_texture_runs_back(tmp_path: Path) -> None:
    """Two texels, red and green: mirrored they are red, green, green, red; repeated red, green, red, green."""
    pixels, places = bytes((255, 0, 0, 0, 255, 0)), np.array([[0.25, 0.5], [0.75, 0.5], [1.25, 0.5], [1.75, 0.5]])
    for mode, order in ((33648, "rggr"), (10497, "rgrg"), (33071, "rggg")):
        found = surface(tmp_path, PAINTED, pixels=pixels, width=2, wrap=mode, uv=places[[0, 1, 2]])
        more = surface(tmp_path, PAINTED, pixels=pixels, width=2, wrap=mode, uv=places[[3, 1, 2]])
        assert found.uv is not None and more.uv is not None and found.texture is not None
        shown = sample_texture(found.texture, np.concatenate((found.uv, more.uv[:1])))
        assert "".join("rg"[int(row[1] > row[0])] for row in shown) == order


@pytest.mark.parametrize("material", [factor(*GREY, 1), {**factor(*GREY, 1), "doubleSided": True}])
def test_both_sides_of_a_face_look_the_same(material: dict[str, Any], tmp_path: Path) -> None:
    drawn = surface(tmp_path, material)
    np.testing.assert_allclose(seen(drawn), seen(drawn, behind=True), atol=0.6 / 255)
    np.testing.assert_allclose(seen(drawn), seen(surface(tmp_path, material, faces=(0, 2, 1))), atol=0.6 / 255)


def test_colours_of_bytes_are_shares_of_255_whatever_the_file_says(tmp_path: Path) -> None:
    found = surface(tmp_path, {}, colors=[[200, 30, 10, 255]] * 3, kind=np.uint8)
    np.testing.assert_allclose(found.colors, linear_to_srgb(np.array([[200, 30, 10]] * 3) / 255))
