"""
Procedural targets (:monosp:`procedural_mesh`, :monosp:`procedural_envmap`)
---------------------------------------------------------------------------

``<shape type="procedural_mesh">``: one part of a model of `rgs_mi.targets`, as a stock triangle mesh.

 * - model, part: |string| names, e.g. ``helmet`` and ``visor``
 * - to_world:    |transform| object to world (Default: identity; models are z-up, centred, of radius ~1)
 * - (nested):    |bsdf|, |emitter| as on every shape

``<emitter type="procedural_envmap">``: an environment of `rgs_mi.targets.environments`, as a stock ``envmap``.

 * - name:       |string| e.g. ``studio``, or ``constant``, a uniform map to start a fit from
 * - height:     |int| height in texels; the width is twice that (Default: 512, of ``constant`` 128)
 * - radiance:   |float| of ``constant`` (Default: 0.5)
 * - scale:      |float| factor on the radiance (Default: 1)
 * - to_world:   |transform| as of ``envmap``, whose up is y: rotate by 90 degrees around x in a z-up world

Both return objects of Mitsuba itself, so everything that works with those works here; what they are called in
``mi.traverse`` is their ``id``. Unknown names raise a `UserError` that lists the known ones.
"""

import mitsuba as mi
import numpy as np

from rgs_mi import targets
from rgs_mi.targets import environments


def procedural_mesh(props: "mi.Properties") -> "mi.Mesh":
    """Make the mesh of ``<shape type="procedural_mesh">``. Raises: UserError for an unknown model or part."""
    part = targets.mesh(str(props["model"]), str(props["part"]))
    to_world = np.array(props.get("to_world", mi.ScalarTransform4f()).matrix, np.float64)
    vertices = part.vertices @ to_world[:3, :3].T + to_world[:3, 3]
    normals = part.normals @ np.linalg.inv(to_world[:3, :3])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    mesh = mi.Mesh(props.id(), len(vertices), len(part.faces), props=props, has_vertex_normals=True)
    params = mi.traverse(mesh)
    params["vertex_positions"] = mi.Float(vertices.astype(np.float32).ravel())
    params["vertex_normals"] = mi.Float(normals.astype(np.float32).ravel())
    params["faces"] = mi.UInt32(part.faces.ravel())
    params.update()
    return mesh


def procedural_envmap(props: "mi.Properties") -> "mi.Emitter":
    """Make the ``envmap`` of ``<emitter type="procedural_envmap">``. Raises: UserError for an unknown name."""
    if props["name"] == "constant":
        pixels = environments.constant(float(props.get("radiance", 0.5)), int(props.get("height", 128)))
    else:
        pixels = environments.environment(str(props["name"]), int(props.get("height", 512)))
    return mi.load_dict(
        {
            "type": "envmap",
            "id": props.id(),
            "bitmap": mi.Bitmap(pixels),
            "scale": float(props.get("scale", 1.0)),
            "to_world": props.get("to_world", mi.ScalarTransform4f()),
        }
    )


mi.register_shape("procedural_mesh", procedural_mesh)
mi.register_emitter("procedural_envmap", procedural_envmap)
