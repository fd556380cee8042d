"""Small captures of dots at known places, written in every layout: what loads them must find the dots where it says."""

import io
import json
import pickle
import struct
from dataclasses import replace

import numpy as np
from PIL import Image
from scipy import ndimage
from scipy.spatial.transform import Rotation

from rgs_mi.core.camera import Camera, focus_point
from rgs_mi.core.color import srgb_decode, srgb_encode

SIZE, FOCAL, PRINCIPAL = (120, 96), (100.0, 94.0), (59.0, 49.5)  # neither square pixels nor a central axis
POINTS = np.array([[0.3 * np.sin(5 * y + 3 * z), y, z] for y in (-1.2, -0.4, 0.4, 1.2) for z in (-0.9, -0.1, 0.7)])
COLORS = np.tile([[200, 60, 20], [20, 180, 90]], (6, 1))
_GL_TO_CV = np.diag([1.0, -1, -1, 1])
_GREY = 0.2


def poses(count=9):
    """[count, 4, 4] camera to world (x right, y down, z forward): from +x, at distance 4, each with a roll of its own."""
    angles = zip(np.linspace(-0.5, 0.5, count), np.linspace(0.4, -0.3, count))
    return [
        Camera.look_at(
            (4 * np.cos(a) * np.cos(b), 4 * np.sin(a) * np.cos(b), 4 * np.sin(b)),
            (0, 0.05, 0.02),
            (0, a / 2 + 0.1, 1),
            50,
            SIZE,
        ).to_world
        for a, b in angles
    ]


def distort(xy, k1=0.0, k2=0.0, p1=0.0, p2=0.0, k3=0.0, k4=0.0, k5=0.0, k6=0.0, poly4=0.0):
    """OpenCV's and COLMAP's formula, and nerfstudio's fourth radial coefficient ``poly4``, of points [N, 2]."""
    x, y = xy.T
    r = x**2 + y**2
    radial = (1 + k1 * r + k2 * r**2 + k3 * r**3 + poly4 * r**4) / (1 + k4 * r + k5 * r**2 + k6 * r**3)
    return np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r + 2 * x**2), y * radial + p1 * (r + 2 * y**2) + 2 * p2 * x * y], -1
    )


def photograph(to_world, scale=1, **lens):
    """[H, W, 3] linear: dots of `POINTS` on grey, seen through a lens with distortion ``lens`` (see `distort`)."""
    p = (POINTS - to_world[:3, 3]) @ to_world[:3, :3]
    pixel = (distort(p[:, :2] / p[:, 2:], **lens) * FOCAL + PRINCIPAL) * scale
    x, y = np.meshgrid(*(np.arange(round(n * scale)) + 0.5 for n in SIZE))
    image = np.full((*x.shape, 3), _GREY, np.float32)
    for (u, v), color in zip(pixel, srgb_decode(COLORS / 255)):
        image += np.exp(-((x - u) ** 2 + (y - v) ** 2) / 2)[..., None] * (color - _GREY)
    return image


def photographs(count=9, **options):
    """name -> [H, W, 3] uint8 of `poses`."""
    return {
        f"v{i:02d}": np.rint(255 * srgb_encode(np.clip(photograph(pose, **options), 0, 1))).astype(np.uint8)
        for i, pose in enumerate(poses(count))
    }


def check_dots(view, at_least=5, tolerance=0.12):
    """The dots are where ``view.camera`` projects them to."""
    linear = view.pixels[..., :3] if view.pixels.dtype != np.uint8 else srgb_decode(view.pixels[..., :3] / 255)
    pixel, depth = view.camera.project(POINTS)
    lonely = np.linalg.norm(pixel[:, None] - pixel, axis=-1) + 99 * np.eye(len(pixel)) > 9
    seen = (depth > 0) & (pixel > 4).all(1) & (pixel < np.array(view.camera.size) - 4).all(1) & lonely.all(1)
    assert seen.sum() >= at_least
    for (u, v), color in zip(pixel[seen], srgb_decode(COLORS / 255)[seen]):
        column, row = int(u) - 4, int(v) - 4
        window = linear[row : row + 9, column : column + 9] - _GREY
        weight = window @ (color - _GREY) / np.sum((color - _GREY) ** 2)
        assert 4.5 < weight.sum() < 8, "no dot there"  # 2 pi for sigma 1
        y, x = np.mgrid[row : row + 9, column : column + 9] + 0.5
        found = np.array([(weight * x).sum(), (weight * y).sum()]) / weight.sum()
        np.testing.assert_allclose(found, [u, v], atol=tolerance)


def save(path, pixels):
    """Any shape of uint8 as a file of the kind that the name says."""
    path.parent.mkdir(parents=True, exist_ok=True)
    if path.suffix == ".exr":
        return write_exr(path, srgb_decode(pixels / 255).astype(np.float32))
    Image.fromarray(pixels).save(path, **({"quality": 98, "subsampling": 0} if path.suffix == ".jpg" else {}))


def write_exr(path, rgb, alpha=None):
    import OpenEXR

    path.parent.mkdir(parents=True, exist_ok=True)
    channels = {"RGB": rgb} if alpha is None else {"RGBA": np.concatenate([rgb, alpha], -1)}
    OpenEXR.File({"type": OpenEXR.scanlineimage}, channels).write(str(path))


def write_png16(path, grey):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(grey.astype(np.uint16)).save(path)


# ---- As people take them ----


def perturbed(dataset, degrees=0.5, position=0.01, focal=0.01, stops=0.3, quality=85, dilation=3, grey=0.5, seed=0):
    """A path-traced ``dataset`` as if it were photographed, in front of ``grey``, and its cameras estimated: poses off by
    ``degrees`` and by the part ``position`` of their distance, in random directions, the focal length by the part ``focal``,
    exposures that differ by up to ``stops``, JPEG's ``quality`` (None: as it is), masks ``dilation`` pixels too large (None:
    alpha as it is, and no ``grey`` in it). Returns it and {training view's name: log2 of its exposure}, of mean zero."""
    rng = np.random.default_rng(seed)
    drawn = rng.uniform(-stops, stops, len(dataset.train))
    exposures = {view.name: stop - drawn.mean() for view, stop in zip(dataset.train, drawn)}
    center, _ = focus_point([view.camera for view in dataset.train])

    def direction():
        drawn = rng.normal(size=3)
        return drawn / np.linalg.norm(drawn)

    def other(view, stop):
        to_world = view.camera.to_world.copy()
        to_world[:3, :3] = to_world[:3, :3] @ Rotation.from_rotvec(np.radians(degrees) * direction()).as_matrix()
        to_world[:3, 3] += position * np.linalg.norm(view.camera.origin - center) * direction()
        camera = replace(view.camera, to_world=to_world, focal=tuple(f * (1 + focal) for f in view.camera.focal))
        linear = srgb_decode(view.pixels[..., :3] / 255) * 2**stop
        alpha = view.alpha[..., None] if dilation is not None else 1.0
        shown = np.rint(255 * (srgb_encode(np.clip(linear, 0, 1)) * alpha + grey * (1 - alpha))).astype(np.uint8)
        if quality is not None:
            stream = io.BytesIO()
            Image.fromarray(shown).save(stream, "JPEG", quality=quality)
            shown = np.asarray(Image.open(stream))
        mask = view.pixels[..., 3]
        if dilation is not None:
            mask = 255 * (ndimage.distance_transform_edt(mask <= 127) <= dilation).astype(np.uint8)
        return replace(view, camera=camera, pixels=np.concatenate([shown, mask[..., None]], -1))

    train = [other(view, exposures[view.name]) for view in dataset.train]
    test = [other(view, rng.uniform(-stops, stops)) for view in dataset.test]
    return replace(dataset, train=train, test=test, photographed=True), exposures


# ---- Layouts ----


def intrinsics():
    return dict(zip(("fl_x", "fl_y", "cx", "cy", "w", "h"), (*FOCAL, *PRINCIPAL, *SIZE)))


def frames(images, folder="images", suffix=".png"):
    """The frames of a transforms file."""
    return [
        {"file_path": f"{folder}/{name}{suffix}", "transform_matrix": (pose @ _GL_TO_CV).tolist()}
        for name, pose in zip(images, poses(len(images)))
    ]


def write_blender(root, images):
    for split, part in (("train", slice(1, None)), ("test", slice(1))):
        meta = intrinsics() | {"frames": frames(images, "images", "")[part]}
        (root / f"transforms_{split}.json").write_text(json.dumps(meta))
    for name, pixels in images.items():
        save(root / "images" / f"{name}.png", pixels)
    return root


def write_nerfstudio(root, images, entries=None, **meta):
    meta = intrinsics() | {"camera_model": "OPENCV", "frames": frames(images) if entries is None else entries} | meta
    for name, pixels in images.items():
        save(root / "images" / f"{name}.png", pixels)
    (root / "transforms.json").write_text(json.dumps(meta))
    return root


MODEL_NUMBERS = {
    "SIMPLE_PINHOLE": 0,
    "PINHOLE": 1,
    "SIMPLE_RADIAL": 2,
    "RADIAL": 3,
    "OPENCV": 4,
    "OPENCV_FISHEYE": 5,
    "FULL_OPENCV": 6,
}


def write_colmap(
    root, images, model="PINHOLE", parameters=(*FOCAL, *PRINCIPAL), suffix=".bin", folder="sparse/0", type=".png", size=SIZE
):
    """The model of `poses`, with one camera, keypoints in every other image, and the points `POINTS`."""
    target = root / folder
    target.mkdir(parents=True, exist_ok=True)
    records = []
    for pose in poses(len(images)):
        turn, move = pose[:3, :3].T, -pose[:3, :3].T @ pose[:3, 3]
        x, y, z, w = Rotation.from_matrix(turn).as_quat()
        records.append((w, x, y, z, *move))
    if suffix == ".bin":
        (target / "cameras.bin").write_bytes(
            struct.pack("<QiiQQ", 1, 7, MODEL_NUMBERS[model], *size) + struct.pack(f"<{len(parameters)}d", *parameters)
        )
        (target / "images.bin").write_bytes(
            struct.pack("<Q", len(images))
            + b"".join(
                struct.pack("<I7dI", i + 1, *record, 7)
                + f"{name}{type}".encode()
                + b"\0"
                + struct.pack("<Q", i % 2)
                + struct.pack("<ddq", 1.5, 2.5, -1) * (i % 2)
                for i, (name, record) in enumerate(zip(images, records))
            )
        )
        (target / "points3D.bin").write_bytes(
            struct.pack("<Q", len(POINTS))
            + b"".join(struct.pack("<Q3d3BdQ", i, *p, *c, 0.5, 0) for i, (p, c) in enumerate(zip(POINTS, COLORS)))
        )
    else:
        number = lambda values: " ".join(map(repr, map(float, values)))
        (target / "cameras.txt").write_text(
            f"# Camera list\n# Number of cameras: 1\n7 {model} {size[0]} {size[1]} {number(parameters)}\n"
        )
        (target / "images.txt").write_text(
            "# Image list\n"
            + "".join(
                f"{i + 1} {number(record)} 7 {name}{type}\n{'1.5 2.5 -1' * (i % 2)}\n"
                for i, (name, record) in enumerate(zip(images, records))
            )
        )
        (target / "points3D.txt").write_text(
            "# 3D point list\n"
            + "".join(f"{i} {number(p)} {c[0]} {c[1]} {c[2]} 0.5\n" for i, (p, c) in enumerate(zip(POINTS, COLORS)))
        )
    for name, pixels in images.items():
        save(root / "images" / f"{name}{type}", pixels)
    return root


def write_llff(root, images, folder="images", scale=1.0, suffix=".png", bounds=(2.0, 6.0)):
    """Whose images in ``folder`` may be smaller than the ``scale`` times larger ones that it counts pixels of; the optical
    axis is the centre, as the layout has it."""
    rows = [
        np.append(
            np.c_[pose[:3, 1], pose[:3, 0], -pose[:3, 2], pose[:3, 3], scale * np.array([*SIZE[::-1], FOCAL[0]])], bounds
        )
        for pose in poses(len(images))
    ]
    np.save(root / "poses_bounds.npy", rows)
    for name, pixels in images.items():
        save(root / folder / f"{name}{suffix}", pixels)
    return root


def write_nero(root, images, depths=None, protocol=4):
    """``depths``: [H, W] in units, one for all, or one each."""
    matrix = np.array([[FOCAL[0], 0, PRINCIPAL[0]], [0, FOCAL[1], PRINCIPAL[1]], [0, 0, 1]])
    for i, (pose, pixels) in enumerate(zip(poses(len(images)), images.values())):
        (root / f"{i}-camera.pkl").write_bytes(pickle.dumps([np.linalg.inv(pose)[:3], matrix], protocol))
        save(root / f"{i}.png", pixels)
        if depths is not None:
            depth = depths[i] if np.ndim(depths) == 3 else depths
            write_png16(root / f"{i}-depth.png", np.rint(np.clip(depth / 15, 0, 1) * 65535))
    return root


def write_cloud(path, points=POINTS, colors=COLORS):
    rows = np.zeros(len(points), [(n, "f4") for n in "xyz"] + [(n, "u1") for n in ("red", "green", "blue")])
    for column, name in enumerate(rows.dtype.names):
        rows[name] = np.hstack([points, colors])[:, column]
    return write_ply_rows(path, rows)


PLY_TYPES = {
    "i1": "char",
    "u1": "uchar",
    "i2": "short",
    "u2": "ushort",
    "i4": "int",
    "u4": "uint",
    "f4": "float",
    "f8": "double",
}


def write_ply_rows(path, rows, text=False, byte_order="<", before=(b"", b""), after=(b"", b"")):
    """A structured array as the vertices of a PLY; ``before`` and ``after``: (header, data) of other elements."""
    form = "ascii" if text else {"<": "binary_little_endian", ">": "binary_big_endian"}[byte_order]
    header = f"ply\nformat {form} 1.0\n".encode() + before[0] + f"element vertex {len(rows)}\n".encode()
    for name in rows.dtype.names:
        header += f"property {PLY_TYPES[rows.dtype[name].str[1:]]} {name}\n".encode()
    data = "".join(" ".join(map(repr, row)) + "\n" for row in rows.tolist()).encode()
    if not text:
        data = rows.astype(rows.dtype.newbyteorder(byte_order)).tobytes()
    path.write_bytes(header + after[0] + b"end_header\n" + before[1] + data + after[1])
    return path
