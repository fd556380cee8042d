"""Textures of a mesh: what surfels are like at each texel, as Mitsuba's principled BSDF and glTF's metallic-roughness take it.

Where surfels have a diffuse radiance of their own the mesh emits it, and must not reflect light diffusely as well. So its
BSDF is that of a metal throughout, whose reflectance at normal incidence is what the surfels reflect there,

    base_color' = m base_color + (1 − m) ((η − 1)/(η + 1))²,   metallic' = 1                             (19)

with metallic m and index of refraction η: metals have no diffuse lobe, and Schlick's Fresnel term nearly the dielectric's.
"""

import functools
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from scipy import ndimage

from ...shading.tables import normal_reflectance
from ...targets.meshes import Mesh, unit
from .lookup import Seen
from .surface import UVMesh, as_mitsuba


@dataclass(frozen=True)
class Textures:
    """Maps of H × W texels, float32, linear; the first row is that of v = 0.

    base_color           [H, W, 3] in [0, 1]
    roughness, metallic  [H, W, 1] in [0, 1], of Mitsuba's principled BSDF: GGX's α is roughness²
    normal    [H, W, 3] unit vectors, world space
    radiance  [H, W, 3] that is emitted; None where nothing is
    """

    base_color: np.ndarray
    roughness: np.ndarray
    metallic: np.ndarray
    normal: np.ndarray
    radiance: np.ndarray | None


@dataclass(frozen=True)
class Texels:
    """The T texels of a `UVMesh` on which the center of lies a face: ``index`` (row-major) among all of a texture of ``size``
    (columns, rows), ``face`` and ``barycentric`` [T, 3] on it, ``points`` and unit ``normals`` [T, 3] there, world space."""

    size: tuple[int, int]
    index: np.ndarray
    face: np.ndarray
    barycentric: np.ndarray
    points: np.ndarray
    normals: np.ndarray

    @classmethod
    def of(cls, mesh: UVMesh) -> "Texels":
        """Find the texels of a ``mesh``: rays meet its plane at their centers."""
        width, height = mesh.size
        flat = Mesh(np.column_stack([mesh.uv, np.zeros(len(mesh.uv))]), mesh.faces, mesh.normals)
        k = dr.arange(mi.UInt32, width * height)
        origin = mi.Point3f((mi.Float(k % width) + 0.5) / width, (mi.Float(k // width) + 0.5) / height, 1)
        plane = mi.load_dict({"type": "scene", "charts": as_mitsuba(flat)})
        hit = plane.ray_intersect_preliminary(mi.Ray3f(origin, mi.Vector3f(0, 0, -1)))
        index = np.flatnonzero(hit.is_valid().numpy())
        face, b = hit.prim_index.numpy()[index], hit.prim_uv.numpy().T[index].astype(float)
        barycentric = np.column_stack([1 - b.sum(1), b])
        at = lambda values: np.einsum("tk,tkc->tc", barycentric, values[mesh.faces[face]].astype(float))
        return cls(mesh.size, index, face, barycentric, at(mesh.vertices), unit(at(mesh.normals)))

    @functools.cached_property
    def near(self) -> np.ndarray:
        """Which of these is the nearest one for each texel of the texture, [H · W] row-major."""
        return self.nearest(np.ones(len(self.index), bool))

    def nearest(self, among: np.ndarray) -> np.ndarray:
        """Return `near` of those alone where ``among`` [T] holds, or of all where it holds nowhere."""
        if not among.any():
            return self.near
        number = np.full(self.size[0] * self.size[1], -1)
        number[self.index] = np.where(among, np.arange(len(among)), -1)
        number = number.reshape(self.size[::-1])
        row, column = np.asarray(ndimage.distance_transform_edt(number < 0, return_distances=False, return_indices=True))
        return number[row, column].ravel()

    def image(self, values: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Return the texture [H, W, channels] of ``values`` [T, channels], each of its texels like that of `near`, or of another
        ``near`` [H · W]."""
        return values[self.near if near is None else near].reshape(*self.size[::-1], -1).astype(np.float32)

    def at(self, image: np.ndarray) -> np.ndarray:
        """Return the values [T, channels] of an ``image`` [H, W, channels] at these texels."""
        return image.reshape(-1, image.shape[-1])[self.index]


def textures(texels: Texels, seen: Seen, near: np.ndarray, lit: bool, eta: float) -> Textures:
    """Return the `Textures` of a mesh from what was ``seen`` at its ``texels``; ``lit`` says whether surfels have no radiance of
    their own, and ``eta`` is their index of refraction. What no camera sees is like the texel that ``near`` [H · W] names."""
    image = lambda values: texels.image(values, near)
    base_color, metallic = np.clip(seen.base_color, 0, 1), np.clip(seen.metallic, 0, 1)
    if not lit:
        base_color, metallic = metallic * base_color + (1 - metallic) * normal_reflectance(eta), np.ones_like(metallic)
    normal = np.where(seen.known[:, None], seen.normal, texels.normals)
    return Textures(
        image(base_color),
        image(np.clip(seen.roughness, 0, 1)),
        image(metallic),
        texels.image(normal),
        None if lit else image(seen.radiance),
    )


# ---- Tangent space ----


def normal_map(mesh: UVMesh, texels: Texels, normal: np.ndarray, frames: Callable[..., np.ndarray]) -> np.ndarray:
    """Return the ``normal`` [H, W, 3] of a texture, world space, in the ``frames`` of its texels (`mitsuba_frames` or
    `gltf_frames`), in [0, 1] as images have it: n / 2 + ½."""
    local = unit(np.einsum("tij,tj->ti", frames(mesh, texels), texels.at(normal)))
    return texels.image(local / 2 + 0.5)


def mitsuba_frames(mesh: UVMesh, texels: Texels) -> np.ndarray:
    """Return [T, 3, 3] the rows s, t, n of Mitsuba's shading frame at ``texels``: s is the face's ∂x/∂u, made perpendicular to
    the normal, and t = n × s."""
    along = mesh.tangents()[texels.face, 0]
    n = texels.normals
    s = unit(along - n * (n * along).sum(1, keepdims=True))
    return np.stack([s, np.cross(n, s), n], 1)


def gltf_frames(mesh: UVMesh, texels: Texels) -> np.ndarray:
    """Return [T, 3, 3] the rows tangent, bitangent, normal at ``texels``, as glTF's readers interpolate them."""
    tangents = vertex_tangents(mesh)[mesh.faces[texels.face]]
    t = unit(np.einsum("tk,tkc->tc", texels.barycentric, tangents[..., :3]))
    return np.stack([t, np.cross(texels.normals, t) * tangents[:, 0, 3:], texels.normals], 1)


def vertex_tangents(mesh: UVMesh) -> np.ndarray:
    """Return the tangents [V, 4] of a ``mesh`` as glTF has them: unit vectors along u, perpendicular to the normals, and the sign
    w of the bitangent w n × t, which points upwards on the picture, against v."""
    du, dv = mesh.tangents().transpose(1, 0, 2)
    corners, count = mesh.faces.ravel(), len(mesh.vertices)
    total = lambda values: np.stack([np.bincount(corners, np.repeat(v, 3), count) for v in values.T], 1)
    n, along, down = mesh.normals.astype(float), total(unit(du)), total(unit(dv))
    t = along - n * (n * along).sum(1, keepdims=True)
    lost = np.linalg.norm(t, axis=1) < 1e-6
    t[lost] = np.cross(n[lost], np.eye(3)[np.abs(n[lost]).argmin(1)])
    t = unit(t)
    w = np.where((np.cross(n, t) * down).sum(1) <= 0, 1.0, -1.0)
    return np.column_stack([t, w]).astype(np.float32)
