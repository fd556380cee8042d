"""Where photographs were taken from, by what they have in common: COLMAP (Schönberger and Frahm 2016), as ``pycolmap`` has it.

Features and matches are asked for in small portions, so that progress is known and Ctrl-C is heard. Photographs of one size
share a lens, Brown's model with two radial and two tangential coefficients (`distortion`), which starts from the focal length
in EXIF where there is one. The world is COLMAP's own: its place, turn and unit mean nothing (`world_frame`).
"""

import itertools
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ..core.camera import Camera
from ..core.errors import UserError
from .colmap_files import Image, read_model

REMEDY = (
    "walk around the object, never turning on the spot, with two thirds of a picture in common from one to the next, and the "
    "textured room in it"
)
_SIDE, _FEATURES = 1200, 3000  # pixels of the longer side, and features of a photograph
_EXHAUSTIVE = 150  # photographs up to which all pairs are matched: 11 000 pairs
_NEIGHBOURS, _LEAPS = 12, (16, 24, 32, 48, 64, 96)  # of more, in their order: the next ones, and some farther on
_BLOCK = 20  # photographs a side of what is matched at once: their features are indexed once
_LEAST_FEATURES, _LEAST_INLIERS = 50, 15  # of a photograph; of a pair
# of a model; degrees from camera to camera at the points' median, which a lens makes up where cameras only turn
_LEAST_VIEWS, _LEAST_POINTS, _LEAST_ANGLE = 3, 60, 6.0
_TRUE_TRACK, _TRUE_ERROR = 3, 2.0  # points are kept that so many photographs show, pixels off at most
_CENTRE_VIEWS, _CENTRE_SHIFT = 25, 0.025  # the principal point is estimated from so many; a larger shift is no lens's


@dataclass(frozen=True)
class Structure:
    """What photographs tell of their cameras.

    Attributes
      images:       placed photographs by name, their lenses and poses in COLMAP's world
      errors:       name -> mean reprojection error in pixels
      observations: name -> number of points that the photograph shows
      points:       [N, 3] float64, positions in COLMAP's world
      colors:       [N, 3] uint8, as the photographs encode them
      left_out:     name -> why the photograph has no place
    """

    images: list[Image]
    errors: dict[str, float]
    observations: dict[str, int]
    points: np.ndarray
    colors: np.ndarray
    left_out: dict[str, str]

    @property
    def cameras(self) -> list[Camera]:
        """The pinholes of the `images`, in their order."""
        return [
            Camera(np.linalg.inv(image.to_camera), image.lens.focal, image.lens.principal, image.lens.size)
            for image in self.images
        ]


def check() -> None:
    """Check that COLMAP is installed. Raises: UserError where it is not."""
    try:
        import pycolmap  # noqa: F401
    except ImportError as error:
        raise UserError("poses of photographs need COLMAP: pip install 'rgs-mi[capture]'") from error


def structure_from_motion(
    folder: Path,
    sizes: dict[str, tuple[int, int]],
    work: Path,
    done: Callable[[str, float], None],
    threads: int = -1,
) -> Structure:
    """Place the photographs in ``folder``.

    Args:
      sizes: name, without spaces, -> (width, height), in the order in which the photographs were taken
      work:  an empty folder, for COLMAP's own files
      done:  is told what is going on, in a word, and which fraction of it is done
      threads: of COLMAP (-1: as many as there are cores)

    Raises: UserError where COLMAP is not installed, or too few photographs can be placed, with what to photograph instead.
    """
    check()
    import pycolmap

    pycolmap.logging.minloglevel = 3  # what it complains of is told below, in a line
    if len(sizes) < _LEAST_VIEWS:
        raise UserError(f"{len(sizes)} photographs are too few: give {_LEAST_VIEWS} at the very least, better 60; {REMEDY}")
    database, names = work / "database.db", list(sizes)
    try:
        _extract(database, folder, sizes, done, threads)
        _match(database, work / "pairs.txt", names, done, threads)
        models = _map(database, folder, work / "models", len(names), done, threads)
    except RuntimeError as error:
        reason = (str(error).strip().splitlines() or ["no reason given"])[-1][:200]
        raise UserError(f"COLMAP can't place these photographs ({reason}): {REMEDY}") from error
    reasons = _reasons(database)
    if not models:
        raise UserError(_unplaced(reasons, names))
    why = {name: _why(*reasons.get(name, (0, 0))) for name in names}
    for model in reversed(models):
        group = [image.name for image in model.images.values() if image.has_pose]
        why |= dict.fromkeys(group, f"fits {len(group) - 1} others, but not the rest: nothing was taken from between them")
    return _checked(_with_centre(models[0], threads), work / "model", names, why)


def pairs(names: Sequence[str]) -> list[tuple[str, str]]:
    """Return the pairs of ``names`` that are matched: all where there are few, else those that are near in their order."""
    if len(names) <= _EXHAUSTIVE:
        return list(itertools.combinations(names, 2))
    steps = [*range(1, _NEIGHBOURS + 1), *_LEAPS]
    return [(names[i], names[i + step]) for i in range(len(names)) for step in steps if i + step < len(names)]


# ---- COLMAP's three steps ----


def _extract(database, folder, sizes, done, threads):
    import pycolmap

    options = pycolmap.FeatureExtractionOptions(num_threads=threads, use_gpu=False, max_image_size=_SIDE)
    options.sift.max_num_features = _FEATURES
    finished = 0
    for size in dict.fromkeys(sizes.values()):
        reader = pycolmap.ImageReaderOptions(camera_model="OPENCV")
        some = [name for name in sizes if sizes[name] == size]
        for chunk in (some[:1], *(some[k : k + 8] for k in range(1, len(some), 8))):
            pycolmap.extract_features(
                database,
                folder,
                image_names=chunk,
                camera_mode=pycolmap.CameraMode.SINGLE,
                reader_options=reader,
                extraction_options=options,
                device=pycolmap.Device.cpu,
            )
            reader.existing_camera_id = _query(database, "SELECT max(camera_id) FROM cameras")[0][0]
            finished += len(chunk)
            done("features", finished / len(sizes))


def _match(database, file, names, done, threads):
    import pycolmap

    matching = pycolmap.FeatureMatchingOptions(num_threads=threads, use_gpu=False)
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = 0
    number, blocks, listed = {name: k for k, name in enumerate(names)}, {}, pairs(names)
    for a, b in listed:
        blocks.setdefault((number[a] // _BLOCK, number[b] // _BLOCK), []).append(f"{a} {b}")
    finished = 0
    for lines in blocks.values():
        file.write_text("\n".join(lines) + "\n", "utf-8")
        pycolmap.match_image_pairs(
            database,
            matching_options=matching,
            pairing_options=pycolmap.ImportedPairingOptions(match_list_path=file),
            verification_options=verification,
            device=pycolmap.Device.cpu,
        )
        finished += len(lines)
        done("matching", finished / len(listed))


def _map(database, folder, models, count, done, threads):
    """The reconstructions, each of photographs that have something in common, the largest first."""
    import pycolmap

    options = pycolmap.IncrementalPipelineOptions(num_threads=threads, random_seed=0, min_model_size=_LEAST_VIEWS)
    placed = itertools.count(3)
    models.mkdir()
    found = pycolmap.incremental_mapping(
        database, folder, models, options, next_image_callback=lambda: done("poses", min(next(placed) / count, 1.0))
    )
    return sorted(found.values(), key=lambda model: model.num_reg_images(), reverse=True)


def _with_centre(model, threads):
    """The reconstruction with the principal points estimated, too, where photographs are enough to tell them."""
    import pycolmap

    if model.num_reg_images() < _CENTRE_VIEWS:
        return model
    refined = pycolmap.Reconstruction(model)
    options = pycolmap.BundleAdjustmentOptions(refine_principal_point=True, print_summary=False)
    options.ceres.solver_options.num_threads = threads
    config = pycolmap.BundleAdjustmentConfig()
    for number in refined.reg_image_ids():
        config.add_image(number)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, refined).solve()
    refined.update_point_3d_errors()
    for camera in refined.cameras.values():
        centre = camera.width / 2, camera.height / 2
        shift = np.hypot(camera.principal_point_x - centre[0], camera.principal_point_y - centre[1])
        if not shift < _CENTRE_SHIFT * max(camera.width, camera.height):  # True for NaN
            return model
    return refined


# ---- What came out ----


def _checked(model, folder, names, why) -> Structure:
    """The `Structure` of a reconstruction. Raises: UserError where it is none to rely on."""
    folder.mkdir()
    model.write_binary(folder)
    images = sorted(read_model(folder, ".bin"), key=lambda image: names.index(image.name))
    if len(images) < _LEAST_VIEWS:
        raise UserError(f"only {len(images)} of {len(names)} photographs could be placed: {REMEDY}")
    kept = [p for p in model.points3D.values() if p.track.length() >= _TRUE_TRACK and 0 <= p.error < _TRUE_ERROR]
    points = np.array([p.xyz for p in kept]).reshape(-1, 3)
    if len(kept) < _LEAST_POINTS:
        raise UserError(f"photographs have only {len(kept)} points in common, too few to rely on: {REMEDY}")
    if not (angle := _angle(images, points)) >= _LEAST_ANGLE:  # True for NaN
        raise UserError(f"cameras stand nearly in one place ({angle:.1f} degrees apart, as seen from the object): {REMEDY}")
    errors, observations = _quality(model)
    placed = {image.name for image in images}
    return Structure(
        images,
        errors,
        observations,
        points,
        np.array([p.color for p in kept], np.uint8),
        {name: why[name] for name in names if name not in placed},
    )


def _angle(images, points) -> float:
    """The angle in degrees between the two cameras that are farthest apart, as the median point sees them."""
    origins = np.stack([np.linalg.inv(image.to_camera)[:3, 3] for image in images])
    rays = origins - np.median(points, axis=0)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return float(np.degrees(np.arccos(np.clip((rays @ rays.T).min(), -1, 1))))


def _quality(model) -> tuple[dict[str, float], dict[str, int]]:
    """Mean reprojection error in pixels, and number of points, of each photograph."""
    errors, observations = {}, {}
    for image in model.images.values():
        if not image.has_pose:
            continue
        seen = [point for point in image.points2D if point.has_point3D()]
        observations[image.name] = len(seen)
        if not seen:
            errors[image.name] = float("nan")
            continue
        world = np.array([model.points3D[point.point3D_id].xyz for point in seen])
        there = image.cam_from_world() * world
        pixels = model.cameras[image.camera_id].img_from_cam(there)
        errors[image.name] = float(np.linalg.norm(pixels - np.array([point.xy for point in seen]), axis=1).mean())
    return errors, observations


def _reasons(database) -> dict[str, tuple[int, int]]:
    """Name -> (number of features, matches with the photograph that has most in common with it)."""
    features = _query(database, "SELECT images.image_id, name, rows FROM images LEFT JOIN keypoints USING (image_id)")
    most = dict.fromkeys((number for number, *_ in features), 0)
    for pair, rows in _query(database, "SELECT pair_id, rows FROM two_view_geometries"):
        for number in divmod(pair, 2147483647)[::-1]:  # COLMAP's numbering of pairs
            most[number] = max(most.get(number, 0), rows)
    return {name: (rows or 0, most[number]) for number, name, rows in features}


def _why(features: int, matches: int) -> str:
    if features < _LEAST_FEATURES:
        return f"too little to see in it ({features} features): blurred, dark or without texture"
    if matches < _LEAST_INLIERS:
        return "has nothing in common with another photograph"
    return f"has too little in common with the others ({matches} matches with the nearest)"


def _unplaced(reasons, names) -> str:
    features = float(np.median([reasons.get(name, (0, 0))[0] for name in names]))
    matches = float(np.median([reasons.get(name, (0, 0))[1] for name in names]))
    if features < _LEAST_FEATURES:
        return f"photographs have too little texture ({features:.0f} features in the median): put the object on a textured ground"
    if matches < _LEAST_INLIERS:
        return f"photographs have nothing in common with each other: {REMEDY}"
    return f"photographs match, and yet show no depth: {REMEDY}"


def _query(database, statement):
    with closing(sqlite3.connect(database)) as connection:
        return connection.execute(statement).fetchall()
