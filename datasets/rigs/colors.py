"""Colours of glTF materials: factors, textures under any wrap mode, linear light to sRGB."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from rewild4d.datasets.rigs.animal import Glow, Surface
from rewild4d.datasets.rigs.gltf import Document, Floats
from rewild4d.datasets.rigs.gltf_file import Part
from rewild4d.errors import shown

MIRRORED, CLAMPED = 33648, 33071
UNSIGNED = {5121: 255.0, 5123: 65535.0}
"""Component type -> what full brightness is."""
PASSING = (
    ("KHR_materials_transmission", "transmissionFactor"),
    ("KHR_materials_diffuse_transmission", "diffuseTransmissionFactor"),
)
SOLID = 254.5 / 255
"""Alpha from which on a blended material is opaque."""


def base_color(material: Part) -> tuple[list[float] | None, Part | None]:
    """Return the factor and texture of a material's colour; older programs write its diffuse colour in an extension."""
    older = (material.extensions or {}).get("KHR_materials_pbrSpecularGlossiness")
    if older is not None:  # whoever writes both means the plain block for readers that do not know it
        info = older.get("diffuseTexture")
        texture = info and Part(info)
        return older.get("diffuseFactor"), texture
    pbr = material.pbrMetallicRoughness
    return (pbr.baseColorFactor, pbr.baseColorTexture) if pbr else (None, None)


def base_texture(document: Document, primitive: Part, info: Part) -> tuple[Floats, NDArray[np.uint8]]:
    """Return the texture coordinates and an image that may be repeated, whatever the file's wrap modes are."""
    extension = (info.extensions or {}).get("KHR_texture_transform", {})
    channel = extension.get("texCoord", info.texCoord or 0)
    accessor = getattr(primitive.attributes, f"TEXCOORD_{channel}", None)
    if accessor is None:
        raise document.error(f"expected TEXCOORD_{channel} in a textured mesh, but a primitive lacks it")
    angle = extension.get("rotation", 0.0)
    turned = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
    uv = document.floats(accessor) * extension.get("scale", (1.0, 1.0)) @ turned.T + extension.get("offset", (0.0, 0.0))
    texture = document.tree.textures[info.index]
    image = document.image(_image_of(texture))
    sampler = document.tree.samplers[texture.sampler] if texture.sampler is not None else None
    for axis, mode in enumerate((sampler.wrapS, sampler.wrapT) if sampler else ()):
        if mode == MIRRORED:
            image = np.concatenate((image, np.flip(image, 1 - axis)), axis=1 - axis)
            uv[:, axis] /= 2
        elif mode == CLAMPED:
            pad = [(0, 0), (0, 0), (0, 0)]
            pad[1 - axis] = (image.shape[1 - axis],) * 2
            image = np.pad(image, pad, mode="edge")
            uv[:, axis] = (np.clip(uv[:, axis], -1.0, 2.0) + 1.0) / 3
    return uv, np.ascontiguousarray(image)


def _image_of(texture: Part) -> int:
    """Return the number of a texture's image."""
    webp: int | None = (texture.extensions or {}).get("EXT_texture_webp", {}).get("source")
    source: int = texture.source if webp is None else webp
    return source


def require_opaque(document: Document, primitive: Part, material: Part) -> None:
    """Refuse a material through which one sees: the studio and the voxels of the truth know solid surfaces only.

    Raises:
        UserError: alphaMode MASK or BLEND with alpha that is not solid everywhere, or light that passes (glass).
    """
    extensions = material.extensions or {}
    mode = material.alphaMode or "OPAQUE"
    if mode not in ("OPAQUE", "MASK", "BLEND"):
        raise document.error(f"expected alphaMode OPAQUE, MASK or BLEND, got '{shown(mode)}'")
    passes = any(float(extensions.get(name, {}).get(key, 0)) > 0 for name, key in PASSING)
    least = 1.0
    if mode != "OPAQUE":
        factor, picture = base_color(material)
        least = factor[3] if factor and len(factor) > 3 else 1.0
        if picture is not None:
            least *= document.least_alpha(_image_of(document.tree.textures[picture.index]))
        if primitive.attributes.COLOR_0 is not None:
            colors = whole_range(document, primitive.attributes.COLOR_0)
            least *= colors[:, 3].min(initial=1.0) if colors.shape[1] > 3 else 1.0
    cutoff = 0.5 if material.alphaCutoff is None else material.alphaCutoff
    if passes or least < (cutoff if mode == "MASK" else SOLID):
        way = f"alphaMode {mode}, alpha down to {least:.2g}" if mode != "OPAQUE" else "it transmits light"
        name = f"'{shown(material.name)}' " if material.name else ""
        raise document.error(f"expected solid materials, but one {name}is not ({way}); made solid, it can be drawn")


def whole_range(document: Document, accessor: int) -> Floats:
    """Return colours in [0, 1]: those of integers are shares of their type, whether the file says so or not."""
    values = document.floats(accessor)
    code = document.tree.accessors[accessor].componentType
    if document.tree.accessors[accessor].normalized or code not in UNSIGNED:
        return values
    return values / UNSIGNED[code]


def glow_of(document: Document, primitive: Part, material: Part) -> Glow | None:
    """Return the light that a material sends out, None where it sends none."""
    extensions = material.extensions or {}
    if "KHR_materials_unlit" in extensions or not any(material.emissiveFactor or ()):
        return None
    strength = extensions.get("KHR_materials_emissive_strength", {}).get("emissiveStrength", 1.0)
    color = np.array(material.emissiveFactor, np.float64) * strength
    if color.shape != (3,) or not np.isfinite(color).all() or (color < 0).any():
        raise document.error("expected an emissiveFactor of three numbers from zero on, but a material has others")
    picture = material.emissiveTexture
    return Glow(color) if picture is None else Glow(color, *base_texture(document, primitive, picture))


def added(color: Floats, light: Floats) -> Floats:
    """Return sRGB colours with linear light added to them, both [n, 3]."""
    return linear_to_srgb(srgb_to_linear(color) + light)


def baked(surface: Surface) -> Surface:
    """Return the surface with its light in its colours, for what knows no light; without light, as it is.

    Raises:
        ValueError: the light has another layout than the texture.
    """
    glow = surface.glow
    if glow is None:
        return surface
    colors, texture = surface.colors, surface.texture
    if not colors.any() and glow.texture is not None:
        bright = np.tile(linear_to_srgb(glow.color), (len(colors), 1))
        return replace(surface, colors=bright, uv=glow.uv, texture=glow.texture, glow=None)
    if texture is None and glow.texture is None:
        return replace(surface, colors=added(colors, np.tile(glow.color, (len(colors), 1))), glow=None)
    same = texture is None or glow.texture is None or texture.shape == glow.texture.shape
    same = same and (surface.uv is None or glow.uv is None or np.array_equal(surface.uv, glow.uv))
    uv = surface.uv if surface.uv is not None else glow.uv
    if not same or not (colors == colors[:1]).all():
        raise ValueError("its light and its colour have textures of other layouts, or colours of vertices beside them")
    light = glow.color if glow.texture is None else glow.color * srgb_to_linear(glow.texture / 255.0)
    picture = np.rint(255 * added(colors[0] if texture is None else colors[0] * texture / 255.0, light)).astype(
        np.uint8
    )
    return replace(surface, colors=np.ones_like(colors), uv=uv, texture=picture, glow=None)


def srgb_to_linear(color: Floats) -> Floats:
    """Decode sRGB in [0, 1] to linear light (IEC 61966-2-1)."""
    color = np.clip(color, 0.0, 1.0)
    return np.where(color <= 0.04045, color / 12.92, ((color + 0.055) / 1.055) ** 2.4)


def linear_to_srgb(linear: Floats) -> Floats:
    """Encode linear light in [0, 1] as sRGB (IEC 61966-2-1)."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
