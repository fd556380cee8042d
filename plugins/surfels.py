"""
Surfels (:monosp:`surfels`)
---------------------------

Flat Gaussians with a principled material (`rgs_mi.surfels.surfels.Surfels`), for the integrator :monosp:`rgs_deferred`.

.. pluginparameters::

 * - filename
   - |string|
   - PLY of surfels, from rgs_mi, 2DGS or 3DGS; relative to the scene's folder (Default: no surfels)

 * - centers, rotations, scales, opacities, sh, base_color, roughness, metallic, delta_normal, curvature
   - |tensor|
   - The fields themselves, in physical ranges, a row for each surfel (`rgs_mi.surfels.surfels.Surfels` has the numbers in a
     row); in a dictionary only. They replace those of the file. ``rotations`` are unit quaternions (x, y, z, w), Mitsuba's
     order; the columns ``rot_0`` to ``rot_3`` of a PLY are (w, x, y, z), as 3DGS has them, and are turned round on reading.
   - |exposed|, |differentiable|; the first three also |discontinuous|

 * - two_sided
   - |bool|
   - Whether surfels show from behind; not needed for closed objects whose normals point outwards. (Default: |true|)

 * - photographs
   - |string|
   - What a fit learns from: a data folder, or a Mitsuba scene to path-trace. Kept for `rgs_mi.fit`, not opened here.

 * - proxies
   - |bool|
   - Whether rays hit the surfels, as quads of three standard deviations, two triangles each: surfel i is
     ``prim_index // 2``. They are opaque and diffuse to Mitsuba's integrators, and moving them rebuilds the
     acceleration structure. (Default: |false|, rays pass)

 * - (Nested plugin)
   - |bsdf|
   - A :monosp:`principled` BSDF: the dielectric lobe has its constant ``eta`` or ``specular`` as it was when loaded,
     from 1 to 3.07; the rest of it is ignored. (Default: eta = 1.5)

Tensors of another length may be assigned, which is how a fit adds and removes surfels: all ten before
``params.update()``. Surfels live in world space: a ``to_world`` is an error. Without proxies rays meet nothing, yet
``bbox()`` is right, by means of one triangle of no area along its diagonal.
"""

from dataclasses import replace

import drjit as dr
import mitsuba as mi

from rgs_mi.core.bounding_box import BoundingBox
from rgs_mi.core.errors import UserError
from rgs_mi.core.turntable import Turntable
from rgs_mi.shading.room import Room
from rgs_mi.shading.split_sum import DEFAULT_ETA
from rgs_mi.shading.tables import eta_of, specular_nodes
from rgs_mi.surfels.ply import read_ply
from rgs_mi.surfels.proxies import corners, quads
from rgs_mi.surfels.surfels import CHANNELS, Surfels

EXTENT = 3.0  # half the width of a proxy, in standard deviations
GEOMETRY = ("centers", "rotations", "scales")


class _MeshBuffers(mi.TraversalCallback):
    """Writes the buffers of the C++ mesh, which a Python `traverse` hides."""

    def __init__(self, buffers):
        super().__init__()
        self.buffers = buffers

    def put(self, name, value, _flags, cpptype=None):
        if name in self.buffers:
            mi.set_property(value, cpptype, self.buffers[name])


class SurfelShape(mi.Mesh):
    """This is the shape that the module describes."""

    def __init__(self, props: "mi.Properties") -> None:
        super().__init__(props)
        if "to_world" in props:
            raise UserError(f"surfels '{self.id()}': 'to_world' is not supported: transform the file instead")
        self.photographs = resolve(props.get("photographs", ""))
        self.proxies = props.get("proxies", False)
        self.two_sided = props.get("two_sided", True)
        self.eta = _eta(self, props)
        fields = _load(props)
        for name in CHANNELS:
            setattr(self, name, mi.TensorXf(props.get(name, fields[name])))  # a copy: Mitsuba writes in place
        self._check()
        self._rebuild()

    @property
    def surfels(self) -> Surfels:
        """The shape's `Surfels`: the live tensors, with their gradients."""
        return Surfels(**{name: getattr(self, name) for name in CHANNELS}, two_sided=self.two_sided)

    def traverse(self, callback: "mi.TraversalCallback") -> None:
        """Show the fields of the surfels to ``callback``; those that move edges are discontinuous."""
        for name in CHANNELS:
            flags = mi.ParamFlags.Differentiable
            if name in GEOMETRY:
                flags = flags | mi.ParamFlags.Discontinuous
            callback.put(name, getattr(self, name), flags)

    def parameters_changed(self, keys: list[str]) -> None:
        """Check the fields, and rebuild the proxies where ``keys`` (none: all) have some of `GEOMETRY` among them.

        Raises: UserError for fields of different lengths, or of a wrong shape.
        """
        self._check()
        if not keys or set(GEOMETRY) & set(keys):
            self._rebuild()

    def _check(self):
        """Raises: UserError where fields differ in length, or one has a wrong number of channels."""
        shapes = {name: tuple(getattr(self, name).shape) for name in CHANNELS}
        if len({shape[0] for shape in shapes.values()}) > 1:
            lengths = ", ".join(f"{name} {shape[0]}" for name, shape in shapes.items())
            raise UserError(f"surfels '{self.id()}': fields differ in length ({lengths}): assign all of them")
        for name, shape in shapes.items():
            expected = (CHANNELS[name],) if CHANNELS[name] else (3, 12, 27, 48)
            if len(shape) != 2 or shape[1] not in expected:
                raise UserError(
                    f"surfels '{self.id()}': '{name}' has shape {shape}: needs [N, {' or '.join(map(str, expected))}]"
                )

    def _rebuild(self):
        """Geometry of the mesh: the proxies, or a diagonal of their bounding box."""
        with dr.suspend_grad():
            if len(self.surfels) == 0:
                positions, faces = dr.zeros(mi.Float, 9), mi.UInt32(0, 1, 2)
            elif self.proxies:
                positions, faces = quads(corners(self.surfels, EXTENT))
            else:
                positions, faces = _diagonal(corners(self.surfels, EXTENT)), mi.UInt32(0, 1, 2)
            dr.eval(positions, faces)
            mi.Mesh.traverse(self, _MeshBuffers({"vertex_positions": positions, "faces": faces}))
        mi.Mesh.parameters_changed(self, ["vertex_positions", "faces"])

    def to_string(self) -> str:
        return f"Surfels[id = {self.id()}, count = {len(self.surfels)}, proxies = {self.proxies}]"


def surfels_in(scene: "mi.Scene") -> tuple[Surfels, float]:
    """Return all surfels of the scene as one `Surfels`, and their index of refraction.

    Raises: UserError where there are none, or they differ in what all have to share.
    """
    shapes = [shape for shape in scene.shapes() if isinstance(shape, SurfelShape) and len(shape.surfels)]
    if not shapes:
        raise UserError("the scene has no surfels: add a <shape type=\"surfels\"> with a 'filename'")
    for name in ("eta", "two_sided"):
        if len(values := {getattr(shape, name) for shape in shapes}) > 1:
            raise UserError(f"shapes of surfels differ in '{name}' ({', '.join(map(str, values))})")
    clouds = [shape.surfels for shape in shapes]
    return clouds[0] if len(clouds) == 1 else _concatenate(clouds), shapes[0].eta


def _concatenate(clouds):
    """Several `Surfels` as one. Spherical harmonics of lower order are padded with zeros."""
    channels = max(cloud.sh.shape[1] for cloud in clouds)

    def column(cloud, name):
        value = getattr(cloud, name)
        missing = channels - value.shape[1] if name == "sh" else 0
        return dr.concat((value, dr.zeros(mi.TensorXf, (len(cloud), missing))), axis=1) if missing else value

    fields = {name: dr.concat([column(cloud, name) for cloud in clouds], axis=0) for name in CHANNELS}
    return replace(clouds[0], **fields)


def box_of(props: "mi.Properties") -> BoundingBox | None:
    """Return the property ``box`` of an integrator, None where it has none. Raises: UserError for a bad one."""
    return _of_numbers(props, "box", BoundingBox.of)


def turntable_of(props: "mi.Properties") -> Turntable | None:
    """Return the property ``turntable`` of an integrator, None where it has none. Raises: UserError for a bad one."""
    return _of_numbers(props, "turntable", Turntable.of)


def room_of(props: "mi.Properties") -> Room | None:
    """Return the property ``room`` of an integrator, None where it has none. Raises: UserError for a bad one."""
    return _of_numbers(props, "room", Room.of)


def _of_numbers(props, name, make):
    """What ``make`` makes of the numbers of the property ``name``; None where there is none."""
    text = props.get(name, "")
    try:
        return make(text.replace(",", " ").split()) if text else None
    except ValueError as error:
        raise UserError(f"{name} '{text}': {error}") from error


def resolve(path: str) -> str:
    """Return ``path`` as Mitsuba's own plugins find files, relative to the scene; '' stays."""
    return str(mi.file_resolver().resolve(path)) if path else ""


def _load(props):
    """The fields of the PLY, or empty ones; what properties leave out of these can only be the curvature, which is 0."""
    if "filename" in props:
        return {name: mi.TensorXf(array) for name, array in read_ply(resolve(props["filename"])).items()}
    empty = {name: dr.zeros(mi.TensorXf, (0, channels or 3)) for name, channels in CHANNELS.items()}
    if "centers" in props:
        empty["curvature"] = dr.zeros(mi.TensorXf, (mi.TensorXf(props["centers"]).shape[0], 3))
    return empty


def _eta(shape, props):
    """Index of refraction of the nested BSDF. Raises: UserError where that is not a principled one."""
    if not any(isinstance(value, mi.BSDF) for _, value in props.objects()):
        return DEFAULT_ETA
    bsdf = shape.bsdf()
    if bsdf.class_name() != "Principled":
        raise UserError(f"surfels '{shape.id()}': the nested BSDF is a {bsdf.class_name()}: surfels need 'principled'")
    params = mi.traverse(bsdf)
    eta = round(params["eta"][0] if "eta" in params else eta_of(params["specular"][0]), 6)
    low, high = (eta_of(s) for s in specular_nodes()[[0, -1]])
    if not low <= eta <= high:
        raise UserError(
            f"surfels '{shape.id()}': eta {eta:.4g} is not one of surfels: choose one from {low:.2f} to {high:.2f}"
        )
    return eta


def _diagonal(corners):
    """Positions of a triangle of no area from the lowest to the highest corner of the bounding box."""
    reduce = lambda op, pick: [op(component) for component in pick(pick(*corners[:2]), pick(*corners[2:]))]
    lower, upper = reduce(dr.min, dr.minimum), reduce(dr.max, dr.maximum)
    return dr.concat([*lower, *upper, *upper])


mi.register_shape("surfels", SurfelShape)
