"""A textured mesh as glTF 2.0 with metallic-roughness material, in one GLB."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from PIL import Image

from ...core.color import srgb_encode, to_8bit
from ..glb import ELEMENT_ARRAY_BUFFER, Buffer
from .surface import UVMesh
from .textures import Texels, Textures, gltf_frames, normal_map, vertex_tangents

NAME = "mesh.glb"
STRENGTH = "KHR_materials_emissive_strength"
_LINEAR, _LINEAR_MIPMAP_LINEAR, _CLAMP = 9729, 9987, 33071
_BRIGHT = 99.9  # percentile of the radiance that an emissive texture still holds


def write(
    folder: str | Path,
    mesh: UVMesh,
    texels: Texels,
    textures: Textures,
    rotation: np.ndarray,
    origin: Sequence[float] = (0, 0, 0),
) -> list[Path]:
    """Write the ``mesh`` with its ``textures`` as `NAME` into ``folder``, turned by ``rotation`` [3, 3] into a world whose y axis
    points up, in which a node puts its own origin at ``origin`` [3], and return the path, in a list. glTF's α is roughness²,
    as Mitsuba's is. What surfels radiate is emitted; where it is brighter than white the extension `STRENGTH` scales it.

    Raises: UserError where the disk is full or the folder can't be written.
    """
    buffer, extensions = Buffer(), set()
    turned = lambda v: np.ascontiguousarray(v.astype(float) @ rotation.T, "<f4")
    tangents = vertex_tangents(mesh)
    primitive = {
        "attributes": {
            "POSITION": buffer.add_array(turned(mesh.vertices), bounds=True),
            "NORMAL": buffer.add_array(turned(mesh.normals)),
            "TANGENT": buffer.add_array(np.column_stack([turned(tangents[:, :3]), tangents[:, 3:]]).astype("<f4")),
            "TEXCOORD_0": buffer.add_array(mesh.uv.astype("<f4")),
        },
        "indices": buffer.add_array(mesh.faces.astype("<u4").ravel(), ELEMENT_ARRAY_BUFFER),
        "material": 0,
    }
    ones = np.ones_like(textures.roughness)
    images = [
        srgb_encode(textures.base_color),
        np.concatenate([ones, textures.roughness, textures.metallic], -1),
        normal_map(mesh, texels, textures.normal, gltf_frames),
    ]
    material: dict = {
        "pbrMetallicRoughness": {"baseColorTexture": {"index": 0}, "metallicRoughnessTexture": {"index": 1}},
        "normalTexture": {"index": 2},
    }
    if textures.radiance is not None:
        strength = max(float(np.percentile(textures.radiance, _BRIGHT)), 1.0)
        images.append(srgb_encode(np.clip(textures.radiance / strength, 0, 1)))
        material |= {"emissiveTexture": {"index": 3}, "emissiveFactor": [1.0, 1.0, 1.0]}
        if strength > 1:
            extensions.add(STRENGTH)
            material["extensions"] = {STRENGTH: {"emissiveStrength": strength}}
    files = [{"bufferView": buffer.add(_png(image)), "mimeType": "image/png"} for image in images]
    path = Path(folder) / NAME
    document = buffer.document(
        primitive,
        extensions,
        origin,
        materials=[material],
        textures=[{"source": k, "sampler": 0} for k in range(len(files))],
        images=files,
        samplers=[{"magFilter": _LINEAR, "minFilter": _LINEAR_MIPMAP_LINEAR, "wrapS": _CLAMP, "wrapT": _CLAMP}],
    )
    buffer.write(path, document)
    return [path]


def _png(image):
    """The file of display values [H, W, 3]."""
    stream = io.BytesIO()
    Image.fromarray(to_8bit(image)).save(stream, "PNG")
    return stream.getvalue()
