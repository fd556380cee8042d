"""Surfels that rays meet: a mesh of quads for Mitsuba's ray tracer."""

import drjit as dr
import mitsuba as mi

from ..core.bounding_box import BoundingBox
from .surfels import SurfelColumns

_SOLID = 0.2  # a ray meets a surfel where it is at least this opaque
_CLEARANCE = 2.0  # rays start that many standard deviations of a typical surfel above the surface
_THICKNESS = 5.0  # of a surface made of surfels, in clearances
_CORNERS = ((-1, -1), (1, -1), (1, 1), (-1, 1))
_TRIANGLES = (0, 1, 2, 0, 2, 3)


def corners(surfels: SurfelColumns, extent: "mi.Float") -> "list[mi.Point3f]":
    """Return the four corners of every surfel's quad in world space, each of width N; ``extent`` is half its width in
    standard deviations."""
    t_u, t_v, _ = surfels.frames()
    center, scale = surfels.column(mi.Point3f, "centers"), extent * surfels.column(mi.Vector2f, "scales")
    return [center + i * scale.x * t_u + j * scale.y * t_v for i, j in _CORNERS]


def quads(corners: "list[mi.Point3f]") -> "tuple[mi.Float, mi.UInt32]":
    """Return the vertex positions and faces of a mesh of two triangles per surfel: face i is of surfel i // 2."""
    n = dr.width(corners)
    i = dr.arange(mi.UInt32, n)
    positions, faces = dr.empty(mi.Float, 12 * n), dr.empty(mi.UInt32, 6 * n)
    for k, corner in enumerate(corners):
        dr.scatter(positions, corner, 4 * i + k)
    for k, vertex in enumerate(_TRIANGLES):
        dr.scatter(faces, 4 * i + vertex, 6 * i + k)
    return positions, faces


class Proxies:
    """Where the surfels were when this was built, for rays to meet: each as the quad in which its alpha exceeds the
    threshold ``solid``; only those in the ``box``, where there is one. Not differentiated.

      scene      what rays meet: surfel i is the triangles 2 i and 2 i + 1
      extent     half the width of each quad, in standard deviations
      normal     geometric normals, world space
      clearance  how far above the surface rays start, world units, of width 1
      thickness  how far from there a surface may show them its back, world units, of width 1
    """

    def __init__(self, surfels: SurfelColumns, solid: float = _SOLID, box: BoundingBox | None = None) -> None:
        with dr.suspend_grad():
            opacity = surfels.column(mi.Float, "opacities")
            if box is not None:
                opacity = dr.select(box.contains(surfels.column(mi.Point3f, "centers")), opacity, 0)
            self.extent = dr.sqrt(2 * dr.log(dr.maximum(opacity / solid, 1)))
            positions, faces = quads(corners(surfels, self.extent))
            self.normal = surfels.frames()[2]
            scale = surfels.column(mi.Vector2f, "scales")
            count = dr.opaque(mi.Float, len(surfels))  # dr.mean would compile it into a kernel
            self.clearance = _CLEARANCE * dr.sum(dr.minimum(scale.x, scale.y)) / count
            self.thickness = _THICKNESS * self.clearance
            dr.eval(positions, faces, self.extent, self.normal, self.clearance, self.thickness)
            mesh = mi.Mesh("proxies", 4 * len(surfels), 2 * len(surfels))
            params = mi.traverse(mesh)
            params["vertex_positions"], params["faces"] = positions, faces
            params.update()
            self.scene = mi.load_dict({"type": "scene", "proxies": mesh})
        self.two_sided = surfels.two_sided

    def intersect(
        self, origin: "mi.Point3f", normal: "mi.Vector3f", direction: "mi.Vector3f", active: "mi.Bool | bool" = True
    ) -> "tuple[mi.Bool, mi.UInt32, mi.Point2f]":
        """Return (found, index, uv): whether ``active`` rays meet a surfel, which, and where on it (see `Surfels.normals`): the
        front of one, or the back where it is two-sided and not part of the surface that the rays leave, by its thickness. All
        vectors are in world space; ``normal`` is that of this surface."""
        with dr.suspend_grad():
            ray = mi.Ray3f(mi.Point3f(origin + self.clearance * normal), mi.Vector3f(direction))
            hit = self.scene.ray_intersect_preliminary(ray, coherent=False, active=active)
            found, index = hit.is_valid(), hit.prim_index // 2
            away = dr.dot(dr.gather(mi.Vector3f, self.normal, index, found), ray.d) > 0
            found &= ~(away & (hit.t < self.thickness)) if self.two_sided else ~away
            uv = dr.gather(mi.Float, self.extent, index, found) * mi.Point2f(*self.position(hit))
            dr.eval(found, index, uv)
            return found, index, uv

    @staticmethod
    def position(hit: "mi.PreliminaryIntersection3f") -> "tuple[mi.Float, mi.Float]":
        """Return where on its quad a ray tracer's ``hit`` is, (x, y) from −1 to 1 along t_u and t_v."""
        b_1, b_2 = hit.prim_uv
        first = (hit.prim_index & 1) == 0  # of `_TRIANGLES`: the corners 0 1 2, then 0 2 3
        return 2 * (dr.select(first, b_1 + b_2, b_1)) - 1, 2 * dr.select(first, b_2, b_1 + b_2) - 1
