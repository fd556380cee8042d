"""How the exported mesh of a run looks in stock Mitsuba, and in Blender, against the photographs that the run has not seen.

``python tests/mesh_viewers.py RUN DATA [--light kitchen] [--scene XML] [--mesh DIR] [--views 5] [--spp 256] [--blender]
[--out DIR]`` prints the PSNR over white. DATA is the capture whose test views are the truth; ``--light``, an image or an
environment of the suite, lights the mesh in place of its own, as that truth was lit, and ``--scene`` is the scene that it shows:
of that, and of the mesh, all that the test views see is so far from the other (Chamfer). ``--mesh`` is a folder that `rgs-mi
export --to mesh` wrote (otherwise one is exported), ``--blender`` asks for Cycles, too (see CONTRIBUTING.md), and ``--out``
keeps the pictures.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np
from scipy.spatial import KDTree

import rgs_mi

from judges import blender, filmed

GRID = 4  # rays along a pixel's side that say how much of it the mesh fills


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("run", type=Path)
    parser.add_argument("data", type=Path)
    parser.add_argument("--light")
    parser.add_argument("--scene", type=Path)
    parser.add_argument("--mesh", type=Path)
    parser.add_argument("--views", type=int, default=5)
    parser.add_argument("--spp", type=int, default=256)
    parser.add_argument("--blender", action="store_true")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    rgs_mi.set_variant("llvm_ad_rgb")
    import mitsuba as mi

    from rgs_mi.commands.export import export, to_y_up
    from rgs_mi.core.color import display
    from rgs_mi.core.files import write_exr, write_png
    from rgs_mi.core.scene_files import load_scene
    from rgs_mi.datasets import load_dataset
    from rgs_mi.evaluation.metrics import psnr
    from rgs_mi.export.mesh import gltf, stock_scene
    from rgs_mi.export.relight import relight
    from rgs_mi.shading.environment import Environment

    views = load_dataset(args.data).test
    cameras = [view.camera for view in views]
    views = [views[k] for k in sorted({round(k) for k in np.linspace(0, len(views) - 1, args.views)})]
    with tempfile.TemporaryDirectory() as temporary:
        folder = args.mesh or Path(temporary)
        if not args.mesh:
            export(args.run, "mesh", out=folder, quiet=True)
        path, light = folder / stock_scene.SCENE, Path(temporary) / "light.exr"
        scene = mi.load_file(str(path), parallel=False)
        relight(scene, path, args.light)
        write_exr(light, Environment.from_emitter(scene.environment()).texels.numpy())
        rotation = to_y_up(load_scene(args.run / "scene.xml", {}), args.run)
        programs = {"Mitsuba": lambda v: np.array(mi.render(scene, sensor=filmed(v), spp=args.spp))}
        if args.blender:
            programs["Blender"] = lambda v: blender(folder / gltf.NAME, light, v, rotation, Path(temporary), args.spp)
        scores, colors = ({name: [] for name in programs} for _ in range(2))
        for k, view in enumerate(views):
            truth = display(view.pixels, 1)
            alpha, behind = background(scene, view.camera)
            pictures = [truth]
            for name, draw in programs.items():
                straight = (draw(view.camera)[..., :3] - behind) / np.maximum(alpha, 1 / GRID**2)
                picture = display(np.concatenate([straight, alpha], 2).astype(np.float32), 1)
                scores[name].append(psnr(picture, truth))
                colors[name].append((picture * alpha).sum((0, 1)) / (truth * alpha).sum((0, 1)))
                pictures.append(picture)
            if args.out:
                write_png(args.out / f"{k}.png", np.concatenate(pictures, 1))
        if args.scene:
            there, back = apart(scene, load_scene(args.scene, {}), cameras)
            print(
                f"mesh to truth: {np.mean(there):.4f}, 99 % within {np.quantile(there, 0.99):.4f}; back: {np.mean(back):.4f}"
            )
        for name, found in scores.items():
            mean = ", ".join(f"{color:.3f}" for color in np.mean(colors[name], 0))
            print(f"{name}: {np.mean(found):.2f} dB ({min(found):.1f} to {max(found):.1f}); colours {mean} of the truth's")


def background(scene, camera):
    """([H, W, 1] how much of each pixel the mesh fills, [H, W, 3] the light that the rest of it shows), on that film."""
    import drjit as dr
    import mitsuba as mi

    from rgs_mi.core.camera import opaque, pixel_directions
    from rgs_mi.core.film import GAUSSIAN, Film

    film = Film.gaussian(GAUSSIAN, GRID**2)
    fine = film.samples(camera)
    direction = pixel_directions(fine, dr.arange(mi.UInt32, int(np.prod(fine.size))))
    hit = scene.ray_test(mi.Ray3f(opaque(camera).origin, direction))
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(hit))
    si.wi = -direction
    behind = dr.select(hit, 0, scene.environment().eval(si))
    pixels = film.develop([mi.Float(dr.select(hit, 1, 0)), *behind], camera.size)
    filled, *light = (values.numpy().reshape(camera.size[::-1]) for values in pixels)
    return filled[..., None], np.stack(light, -1)


def apart(one, other, cameras):
    """World units from each point that ``cameras`` see of the scene ``one`` to the surface of the ``other``, and back: to the
    plane of the nearest point that they see."""
    (points, normals), (others, theirs) = (met(scene, cameras) for scene in (one, other))
    away = lambda p, q, n: (lambda k: abs(((p - q[k]) * n[k]).sum(1)))(KDTree(q).query(p)[1])
    return away(points, others, theirs), away(others, points, normals)


def met(scene, cameras):
    """Positions and geometric normals [N, 3] where the ``cameras`` see a ``scene``."""
    import drjit as dr
    import mitsuba as mi

    from rgs_mi.core.camera import opaque, pixel_directions

    found = []
    for camera in cameras:
        index = dr.arange(mi.UInt32, camera.size[0] * camera.size[1])
        si = scene.ray_intersect(mi.Ray3f(opaque(camera).origin, pixel_directions(camera, index)))
        seen = si.is_valid().numpy()
        found.append([v.numpy().T[seen] for v in (si.p, si.n)])
    return [np.concatenate(values) for values in zip(*found)]


if __name__ == "__main__":
    main()
