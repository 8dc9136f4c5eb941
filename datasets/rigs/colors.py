"""Colours of glTF materials: factors, textures under any wrap mode, linear light to sRGB."""

import numpy as np
from numpy.typing import NDArray

from rewild4d.datasets.rigs.gltf import Document, Floats
from rewild4d.datasets.rigs.gltf_file import Part

MIRRORED, CLAMPED = 33648, 33071


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
    webp = (texture.extensions or {}).get("EXT_texture_webp", {})
    image = document.image(webp.get("source", texture.source))
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


def linear_to_srgb(linear: Floats) -> Floats:
    """Encode linear light in [0, 1] as sRGB (IEC 61966-2-1)."""
    linear = np.clip(linear, 0.0, 1.0)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
