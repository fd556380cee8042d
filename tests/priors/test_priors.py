"""Depth priors: the interface, its cache, maps from files, and VGGT's interface against a stand-in with its signatures."""

import sys
import types
import warnings

import numpy as np
import pytest
from PIL import Image

from rgs_mi.core.camera import Camera
from rgs_mi.core.errors import UserError
from rgs_mi.datasets.images import resize
from rgs_mi.datasets.types import DepthPrior, View
from rgs_mi.priors import NAMES, depth_priors, hull, maps, vggt
from rgs_mi.priors.initialization import Points
from rgs_mi.priors.photometric_variation import Appearance

SIZE = (48, 40)  # width, height


def view(name="r_0", size=SIZE, seed=0, camera=None, masked=True):
    """A photograph of noise, its mask an ellipse."""
    width, height = size
    rng = np.random.default_rng(seed)
    pixels = rng.integers(0, 256, (height, width, 4), np.uint8)
    x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
    pixels[..., 3] = 255 * (np.hypot(x - 0.5, y - 0.5) < 0.4) if masked else 255
    camera = camera or Camera.look_at((3, 0, 0), (0, 0, 0), (0, 0, 1), 40, size)
    return View(name, camera, pixels, masked, None, None)


def ball(count=10, size=(40, 40)):
    """Masked photographs of the unit ball from all sides."""
    views = []
    for k in range(count):
        z, angle = 0.9 - 1.8 * k / (count - 1), 2.4 * k
        r = np.sqrt(1 - z * z)
        camera = Camera.look_at(5 * np.array([r * np.cos(angle), r * np.sin(angle), z]), (0, 0, 0), (0, 0, 1), 30, size)
        rays = camera.rays()
        distance = np.linalg.norm(np.cross(rays, -camera.origin), axis=-1) / np.linalg.norm(rays, axis=-1)
        pixels = np.full((*size[::-1], 4), 200, np.uint8)
        pixels[..., 3] = np.uint8(255 * np.clip((1 - distance) / 0.07 + 0.5, 0, 1))
        views.append(View(f"r_{k}", camera, pixels, True, None, None))
    return views


def fails(match, *args, **options):
    """A UserError of one line."""
    with pytest.raises(UserError, match=match) as error:
        depth_priors(*args, **options)
    assert "\n" not in str(error.value)


# ---- The interface ----


def test_names_and_options():
    assert NAMES == ("hull", "stereo", "files", "vggt", "none") and depth_priors("none", [view()]) is None
    fails("prior 'depth' is unknown: choose one of hull, stereo, files, vggt, none", "depth", [])
    fails("prior 'hull'.*'folder'.*options are resolution", "hull", [], folder=".")
    fails("prior 'files'.*missing.*'folder'.*options are folder, inverse, suffix", "files", [])


def test_hull():
    views = ball()
    priors = depth_priors("hull", views, resolution=48)
    for prior, v in zip(priors, views):
        assert prior.values.shape == (40, 40) and prior.values.dtype == np.float32 and not prior.inverse
        seen = np.isfinite(prior.values)
        assert (seen & maps.inside(v)).sum() / (seen | maps.inside(v)).sum() > 0.9
        assert 3.7 < np.nanmin(prior.values) < 4.1 and np.nanmax(prior.values) < 5.2


# ---- Maps ----


def test_inside_and_masked():
    v = view()
    values = np.ones(SIZE[::-1])
    values[20, 24], values[20, 25], values[20, 26] = np.inf, np.nan, 1e300
    out = maps.masked(values, v)
    assert out.dtype == np.float32 and np.isnan(out[20, 24:27]).all() and np.isnan(out[0, 0]) and out[20, 20] == 1
    linear = View("x", v.camera, v.pixels.astype(np.float32) / 255, True, None, None)
    np.testing.assert_array_equal(maps.inside(linear), maps.inside(v))


@pytest.mark.parametrize("shape", [(80, 96), (20, 24), (33, 40), (1, 1)])
def test_resize_keeps_planes_and_borders(shape):
    """A plane in the image stays that plane, whatever the grid, except within half a pixel of the border."""

    def plane(height, width):
        x, y = np.meshgrid((np.arange(width) + 0.5) / width, (np.arange(height) + 0.5) / height)
        return 2 + x - 3 * y

    out = resize(plane(*shape), 40, 48)
    assert out.shape == (40, 48) and out.dtype == np.float32
    if shape != (1, 1):
        edge = np.ceil(0.5 * 40 / shape[0]).astype(int) + 1
        np.testing.assert_allclose(out[edge:-edge, edge:-edge], plane(40, 48)[edge:-edge, edge:-edge], atol=1e-5)
    assert np.isfinite(out).all()


def test_resize_does_not_spread_the_unknown():
    values = np.full((10, 10), 3.0)
    values[:, 5:] = np.nan
    out = resize(values, 40, 40)
    assert np.all(out[:, :20] == 3) and np.isnan(out[:, 20:]).all()


# ---- Files ----


def write_exr(path, **channels):
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {name.replace("_", "."): np.ascontiguousarray(c, np.float32) for name, c in channels.items()}
    OpenEXR.File(header, channels).write(str(path))


def write_png(path, depth):
    Image.fromarray(depth.astype(np.uint16)).save(path)


@pytest.mark.parametrize("kind", ["npz", "named npz", "npy", "cube npy", "exr", "depth exr", "layer exr", "png"])
def test_files_of_all_kinds(tmp_path, kind):
    v = view()
    depth = np.random.default_rng(0).integers(1000, 60000, SIZE[::-1]).astype(np.float32)
    depth[18:22, 22:26] = 0 if kind == "png" else np.nan
    other = np.zeros_like(depth)
    write = {
        "npz": lambda: np.savez(tmp_path / "r_0.npz", anything=depth),
        "named npz": lambda: np.savez(tmp_path / "r_0.npz", confidence=other, depth=depth.astype(np.float64)),
        "npy": lambda: np.save(tmp_path / "r_0.npy", depth),
        "cube npy": lambda: np.save(tmp_path / "r_0.NPY", depth[None, ..., None]),
        "exr": lambda: write_exr(tmp_path / "r_0.exr", A=other, G=depth),
        "depth exr": lambda: write_exr(tmp_path / "r_0.exr", A=other, Z=depth, Y=other, B=other),
        "layer exr": lambda: write_exr(tmp_path / "r_0.exr", Albedo_R=other, Depth_Z=depth, Normal_Z=other),
        "png": lambda: write_png(tmp_path / "r_0.png", depth),
    }[kind]
    write()
    for path in tmp_path.glob("*.NPY.npy"):
        path.rename(tmp_path / "r_0.NPY")
    np.savez(tmp_path / "r_1.npz", other)
    (prior,) = depth_priors("files", [v], folder=tmp_path)
    expected = np.where(maps.inside(v) & (depth > 0), depth, np.nan)
    np.testing.assert_array_equal(prior.values, expected)
    assert prior.values.dtype == np.float32 and np.isfinite(prior.values).any() and prior.confidence is None


def test_files_are_resized_inverse_and_may_be_constant(tmp_path):
    views = [view("a"), view("b", (96, 80)), view("c", masked=False)]
    np.save(tmp_path / "a_disp.npy", np.full((20, 24), 7, np.int16))
    np.save(tmp_path / "b_disp.npy", np.arange(70.0)[:, None] + np.zeros(84))
    np.save(tmp_path / "c_disp.npy", np.full((40, 48), np.nan))
    np.save(tmp_path / "a.npy", np.ones(3))  # another file, of no interest
    priors = depth_priors("files", views, folder=str(tmp_path), inverse=True, suffix="_disp")
    assert [p.values.shape for p in priors] == [(40, 48), (80, 96), (40, 48)] and all(p.inverse for p in priors)
    assert np.nanmin(priors[0].values) == np.nanmax(priors[0].values) == 7
    np.testing.assert_allclose(np.diff(priors[1].values[:, 48][20:60]), 70 / 80, atol=1e-4)
    assert np.isnan(priors[2].values).all()


def test_what_is_wrong_with_files_is_said_in_a_line(tmp_path):
    views = [view()]
    fails("depth folder '.*nowhere' does not exist", "files", views, folder=tmp_path / "nowhere")
    fails(r"no r_0\{.npz,.npy,.exr,.png\} is there as the depth map of r_0: export it", "files", views, folder=tmp_path)
    np.save(tmp_path / "r_0.npy", np.ones((40, 48)))
    np.savez(tmp_path / "r_0.npz", np.ones((40, 48)))
    fails("r_0.npy and r_0.npz are there.*leave one", "files", views, folder=tmp_path)
    (tmp_path / "r_0.npz").unlink()
    for array, reason in (
        (np.ones((48, 40)), "is 40 x 48, its photograph 48 x 40"),
        (np.ones((40, 48, 3)), "40 x 48 x 3"),
        (np.float32(3), "a single number"),
        (np.ones((0, 4)), "0 x 4"),
        (np.full((40, 48), 1j), "complex128"),
        (np.full((40, 48), None), "[Oo]bject arrays"),
    ):
        np.save(tmp_path / "r_0.npy", array, allow_pickle=True)
        fails(f"r_0.npy.*{reason}", "files", views, folder=tmp_path)


@pytest.mark.parametrize("name", ["r_0.npz", "r_0.npy", "r_0.exr", "r_0.png"])
@pytest.mark.parametrize("content", [b"", b"no such thing", "half"])
def test_damaged_files(tmp_path, name, content):
    path = tmp_path / name
    if content == "half":
        depth = np.random.default_rng(0).integers(1, 60000, SIZE[::-1]).astype(np.float32)
        {
            ".npz": lambda: np.savez(path, depth),
            ".npy": lambda: np.save(path, depth),
            ".exr": lambda: write_exr(path, Z=depth),
            ".png": lambda: write_png(path, depth),
        }[path.suffix]()
        content = path.read_bytes()[: path.stat().st_size // 2]
    path.write_bytes(content)
    fails(f"{name} cannot be read as a depth map", "files", [view()], folder=tmp_path)


def test_files_of_the_wrong_sort(tmp_path):
    np.savez(tmp_path / "r_0.npz", near=np.ones((40, 48)), far=np.ones((40, 48)))
    fails(r"none of its arrays \(near, far\) is called 'depth'", "files", [view()], folder=tmp_path)
    (tmp_path / "r_0.npz").unlink()
    Image.fromarray(np.zeros((40, 48), np.uint8)).save(tmp_path / "r_0.png")
    fails("mode is L, and 16-bit grey is needed", "files", [view()], folder=tmp_path)


# ---- The cache ----


def test_cache_is_found_by_content(tmp_path, monkeypatch):
    calls = []
    carve = hull.visual_hull
    monkeypatch.setattr(hull, "visual_hull", lambda *args: calls.append(1) or carve(*args))

    def estimate(views, **options):
        """The maps, and how often the hull was carved for them."""
        calls.clear()
        priors = depth_priors("hull", views, cache=tmp_path / "priors", **options)
        return [p.values for p in priors], len(calls)

    views = ball(5)
    first, count = estimate(views, resolution=20)
    assert count == 1
    again, count = estimate([View("else", v.camera, v.pixels.copy(), True, None, tmp_path) for v in views], resolution=20)
    assert count == 0
    np.testing.assert_array_equal(first, again)
    (file,) = (tmp_path / "priors").iterdir()
    assert file.name.startswith("hull-") and file.suffix == ".npz"

    pixels = views[0].pixels.copy()
    pixels[20, 20, 0] += 1
    moved = views[0].camera.resized(41, 40).cropped(0, 0, 40, 40)
    for camera, picture in ((views[0].camera, pixels), (moved, views[0].pixels)):
        assert estimate([View("r_0", camera, picture, True, None, None), *views[1:]], resolution=20)[1] == 1
    assert estimate(views, resolution=21)[1] == 1 and estimate(views[::-1], resolution=20)[1] == 1
    assert len(list((tmp_path / "priors").iterdir())) == 5

    for damage in (b"", file.read_bytes()[:-100], file.read_bytes()[:200] + bytes(50) + file.read_bytes()[250:]):
        file.write_bytes(damage)
        with pytest.warns(UserWarning, match="is damaged.*again"):
            assert estimate(views, resolution=20)[1] == 1
        assert estimate(views, resolution=20)[1] == 0
    np.savez(file, inverse=np.zeros(5, bool), **{f"values_{i}": np.ones((3, 3), np.float32) for i in range(5)})
    with pytest.warns(UserWarning, match="wrong shape"):
        np.testing.assert_allclose(estimate(views, resolution=20)[0], first, rtol=1e-5)


def test_a_cache_that_cannot_be_written_costs_only_itself(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.warns(UserWarning, match="can't be written"):
        priors = depth_priors("hull", ball(5), cache=tmp_path / "file", resolution=20)
    assert len(priors) == 5


# ---- VGGT, what needs no torch ----


@pytest.mark.parametrize("count", [0, 1, 2, 5, 6, 7, 16, 17, 80, 81])
@pytest.mark.parametrize("batch, overlap", [(2, 1), (6, 1), (6, 5), (16, 4), (24, 6)])
def test_batches(count, batch, overlap):
    found = vggt.batches(count, batch, overlap)
    assert sorted({i for r in found for i in r}) == list(range(count))
    assert all(len(r) <= batch for r in found) and len({len(r) for r in found}) == 1
    assert all(b.start > a.start and a.stop - b.start >= overlap for a, b in zip(found, found[1:]))


def test_scale_is_a_weighted_median():
    old = np.array([[2, 4, 6, 50, np.nan]], np.float32)
    new = np.array([[1, 2, 3, 1, 1]], np.float32)
    sure = np.array([[1, 1, 1, 1, 1]], np.float32)
    pair = lambda weight: [(DepthPrior(old, False, sure), DepthPrior(new, False, np.array([weight], np.float32)))]
    assert vggt._scale(pair([1, 1, 1, 1, 9])) == 2 and vggt._scale(pair([1, 1, 1, 9, 9])) == 50
    assert vggt._scale([]) == 1 and vggt._scale([(DepthPrior(old * np.nan, False, sure), DepthPrior(new, False, sure))]) == 1


@pytest.mark.parametrize("missing", ["torch", "vggt.models.vggt"])
def test_missing_packages(monkeypatch, missing):
    for name, module in {"torch": types.ModuleType("torch"), "vggt": types.ModuleType("vggt"), missing: None}.items():
        monkeypatch.setitem(sys.modules, name, module)
    fails(
        "vggt prior needs packages.*pip install torch.*git.https://github.com/facebookresearch/vggt; "
        "the priors hull, files and none",
        "vggt",
        [view()],
    )


def test_missing_weights_and_wrong_options(tmp_path):
    for weights in (tmp_path / "model.pt", tmp_path, "models/model.safetensors"):
        fails(
            "VGGT's weights .*model.* do not exist: give a model.pt.*hull, files and none",
            "vggt",
            [view()],
            weights=weights,
            cache=tmp_path,
        )
    for batch, overlap in ((4, 4), (4, 0), (0, 0)):
        fails("overlap must be at least 1 and less than batch", "vggt", [view()], batch=batch, overlap=overlap)


def test_fingerprint(tmp_path):
    content = np.random.default_rng(0).bytes(10_000_000)
    (tmp_path / "a.pt").write_bytes(content)
    (tmp_path / "model.pt").write_bytes(content)
    (tmp_path / "b.pt").write_bytes(content[:5_000_000] + bytes(20_000) + content[5_020_000:])
    (tmp_path / "small.pt").write_bytes(b"small")
    marks = [vggt.fingerprint(tmp_path / name) for name in ("a.pt", "", "b.pt", "small.pt")]
    assert marks[0] == marks[1] and len(set(marks)) == 3
    assert vggt.fingerprint("facebook/VGGT-1B") == "hub:facebook/VGGT-1B"


# ---- VGGT, with a network of its interface ----


@pytest.fixture
def network(monkeypatch):
    """Modules named as VGGT's own, with its signatures, shapes and preprocessing, around a network that takes depth from
    brightness: 2 where white, 3 where black, times a scale that depends on the first image of the batch. Confidence is one
    more than red. Returns a record of what was called."""
    torch = pytest.importorskip("torch")
    record = types.SimpleNamespace(batches=[], hub=[], modes=[], corrupt=False)

    class Aggregator(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.gain = torch.nn.Parameter(torch.ones(1))

        def forward(self, images):
            """[B, S, 3, H, W] to 24 times [B, S, P, C], of which the first five are no patches."""
            assert images.ndim == 5 and images.shape[2] == 3 and not torch.is_grad_enabled() and not self.training
            b, s, _, h, w = images.shape
            assert h % 14 == 0 and w % 14 == 0 and 0 <= images.min() and images.max() <= 1
            record.batches.append(s)
            patches = torch.nn.functional.avg_pool2d(images.flatten(0, 1), 14).flatten(2).transpose(1, 2)
            tokens = torch.cat([torch.zeros(b * s, 5, 3), self.gain * patches], 1).unflatten(0, (b, s))
            return [tokens] * 24, 5

    class DepthHead(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.offset = torch.nn.Parameter(torch.full((1,), 3.0))

        def forward(self, aggregated_tokens_list, images, patch_start_idx, frames_chunk_size=8):
            b, s, _, h, w = images.shape
            patches = aggregated_tokens_list[23][:, :, patch_start_idx:]
            assert patches.shape == (b, s, h // 14 * (w // 14), 3)
            depth = (self.offset - images.mean(2)) * (1 + patches[:, :1].mean())
            if record.corrupt:
                depth[:, :, h // 2 : h // 2 + 20] = torch.inf
            return depth[..., None], 1 + images[:, :, 0]

    class VGGT(torch.nn.Module):
        def __init__(
            self,
            img_size=518,
            patch_size=14,
            embed_dim=1024,
            enable_camera=True,
            enable_point=True,
            enable_depth=True,
            enable_track=True,
        ):
            super().__init__()
            self.aggregator, self.depth_head = Aggregator(), DepthHead()
            self.camera_head, self.point_head, self.track_head = (torch.nn.Linear(2, 2) for _ in range(3))

        @classmethod
        def from_pretrained(cls, pretrained_model_name_or_path, **kwargs):
            record.hub.append(pretrained_model_name_or_path)
            if pretrained_model_name_or_path != vggt.HUB:
                raise OSError("We couldn't connect to the hub\nto load the files")
            return cls()

    def load_and_preprocess_images(image_path_list, mode="crop"):
        record.modes.append(mode)
        images = []
        for path in image_path_list:
            assert isinstance(path, str)
            image = Image.open(path)
            assert image.mode == "RGB"
            width, height = image.size
            if mode == "pad" and height > width:
                size = round(width * (518 / height) / 14) * 14, 518
            else:
                size = 518, round(height * (518 / width) / 14) * 14
            pixels = np.float32(image.resize(size, Image.Resampling.BICUBIC)) / 255
            if mode == "crop" and size[1] > 518:
                pixels = pixels[(size[1] - 518) // 2 :][:518]
            if mode == "pad":
                rows, columns = 518 - size[1], 518 - size[0]
                pixels = np.pad(
                    pixels,
                    ((rows // 2, rows - rows // 2), (columns // 2, columns - columns // 2), (0, 0)),
                    constant_values=1,
                )
            images.append(torch.from_numpy(pixels).permute(2, 0, 1))
        return torch.stack(images)

    for name, content in {
        "vggt": {},
        "vggt.models": {},
        "vggt.models.vggt": {"VGGT": VGGT},
        "vggt.utils": {},
        "vggt.utils.load_fn": {"load_and_preprocess_images": load_and_preprocess_images},
    }.items():
        module = types.ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    record.VGGT = VGGT
    return record


def shaded(name, size, masked=True, level=0.0, camera=None):
    """A photograph whose brightness is a plane, so that its depth is one, too."""
    v = view(name, size, masked=masked, camera=camera)
    x, y = np.meshgrid((np.arange(size[0]) + 0.5) / size[0], (np.arange(size[1]) + 0.5) / size[1])
    v.pixels[..., :3] = np.round(255 * (level + 0.3 + 0.3 * x - 0.2 * y))[..., None]
    return v


def expected(v, scale):
    return np.where(maps.inside(v), scale * (3 - v.pixels[..., 0] / 255.0), np.nan)


@pytest.mark.parametrize(
    "sizes, mode",
    [
        ([(48, 40)] * 3, "crop"),
        ([(40, 40)] * 2, "crop"),
        ([(700, 400)], "crop"),
        ([(40, 71)] * 2, "pad"),
        ([(48, 40), (40, 48), (60, 31)], "pad"),
    ],
)
def test_vggt_maps_lie_on_the_photographs(network, sizes, mode):
    """Whatever was resized, padded or rounded to patches is undone: depths are where their pixels are."""
    views = [shaded(f"{i}", size, masked=False) for i, size in enumerate(sizes)]
    priors = depth_priors("vggt", views)
    assert network.modes == [mode] and network.batches == [len(sizes)] and network.hub == ["facebook/VGGT-1B"]
    for prior, v in zip(priors, views):
        height, width = v.pixels.shape[:2]
        assert prior.values.shape == prior.confidence.shape == (height, width) and not prior.inverse
        assert prior.values.dtype == prior.confidence.dtype == np.float32
        ratio = prior.values / expected(v, 1)
        np.testing.assert_allclose(ratio, np.median(ratio), rtol=4e-3)
        np.testing.assert_allclose(prior.confidence, 1 + v.pixels[..., 0] / 255, atol=0.02)


@pytest.mark.parametrize("background", [0.0, 1.0])
def test_vggt_and_masks(network, background):
    v, hdr = shaded("0", (48, 40)), shaded("1", (48, 40))
    hdr = View("1", hdr.camera, hdr.pixels / np.float32(255), True, None, None)
    prior, linear = depth_priors("vggt", [v, hdr], background=background)
    inner = maps.inside(v)
    assert np.isnan(prior.values[~inner]).all() and np.isfinite(prior.values[inner]).all()
    assert np.all(prior.confidence[~inner] == 0) and np.all(prior.confidence[inner] >= 1)
    assert np.nanmedian(linear.values) < np.nanmedian(prior.values)  # linear light, encoded, is brighter
    inset = slice(14, 26), slice(18, 30)  # far from the mask's border, where the background shines through
    ratio = (prior.values / expected(v, 1))[inset]
    np.testing.assert_allclose(ratio, np.median(ratio), rtol=4e-3)
    # The scale of the stand-in's batch tells what the first image's mean was, background included.
    shown = np.where(inner, v.pixels[..., 0] / 255, background).mean()
    assert np.median(ratio) == pytest.approx(1 + shown, abs=0.01)


def test_vggt_batches_are_brought_to_one_scale(network):
    views = [shaded(f"{i}", (48, 40), level=0.03 * i) for i in range(11)]
    whole = depth_priors("vggt", views)
    parts = depth_priors("vggt", views, batch=5, overlap=2)
    assert network.batches == [11, 5, 5, 5]
    for a, b in zip(whole, parts):
        np.testing.assert_allclose(b.values, a.values, rtol=1e-3)
    np.testing.assert_array_equal(np.isnan(parts[-1].values), ~maps.inside(views[-1]))


def test_vggt_leaves_out_what_is_not_finite(network):
    network.corrupt = True
    (prior,) = depth_priors("vggt", [shaded("0", (48, 40))])
    lost = maps.inside(view()) & np.isnan(prior.values)
    assert 0 < lost.sum() <= 144 and np.all(prior.confidence[lost] == 0) and not np.isinf(prior.values).any()


@pytest.mark.parametrize("name", ["model.pt", "model.safetensors"])
def test_vggt_local_weights(network, tmp_path, name):
    import torch

    model = network.VGGT()
    torch.nn.init.constant_(model.depth_head.offset, 6)
    state = {k: v for k, v in model.state_dict().items() if not k.startswith("track")}  # depth can do without
    if name == "model.pt":
        torch.save(state, tmp_path / name)
    else:
        pytest.importorskip("safetensors.torch").save_file(state, tmp_path / name)
    v = shaded("0", (48, 40), masked=False)
    for weights in (tmp_path / name, tmp_path):
        (prior,) = depth_priors("vggt", [v], weights=weights)
        assert np.ptp(prior.values / (6 - v.pixels[..., 0] / 255.0)) < 0.02
    assert network.hub == []


def test_vggt_weights_that_cannot_be_loaded(network, tmp_path):
    import torch

    fails(
        r"weights someone/else cannot be loaded \(We couldn't connect to the hub to load the files\): check the network.*"
        "hull, files and none",
        "vggt",
        [view()],
        weights="someone/else",
    )
    path = tmp_path / "model.pt"
    path.write_bytes(b"nothing")
    fails("model.pt cannot be loaded.*download it again", "vggt", [view()], weights=path)
    torch.save({"aggregator.gain": torch.ones(1)}, path)
    fails("1 weights are missing, the first is depth_head.offset", "vggt", [view()], weights=path)
    torch.save({"aggregator.gain": torch.ones(7)}, path)
    fails("model.pt cannot be loaded", "vggt", [view()], weights=path)


def test_vggt_without_memory(network, monkeypatch):
    import torch

    def fail(self, images):
        raise torch.cuda.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(network.VGGT().aggregator.__class__, "forward", fail)
    fails("no memory for batches of 1 views: lower its option batch", "vggt", [view()])


def test_vggt_cache_needs_neither_torch_nor_cameras(network, tmp_path, monkeypatch):
    views = [shaded(f"{i}", (48, 40), level=0.1 * i) for i in range(3)]
    first = depth_priors("vggt", views, cache=tmp_path)
    for name in ("torch", "vggt", "vggt.models.vggt"):
        monkeypatch.setitem(sys.modules, name, None)
    moved = [shaded(f"{i}", (48, 40), level=0.1 * i, camera=views[0].camera.resized(48, 39)) for i in range(3)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = depth_priors("vggt", moved, cache=tmp_path, weights=vggt.HUB)
    for a, b in zip(first, again):
        np.testing.assert_array_equal(a.values, b.values)
        np.testing.assert_array_equal(a.confidence, b.confidence)
        assert b.inverse is False
    fails("needs packages", "vggt", views, cache=tmp_path, background=0.5)
    fails("needs packages", "vggt", views, cache=tmp_path, weights="someone/else")


@pytest.mark.parametrize("on_surface", [True, False])
def test_points_in_places_are_the_same_and_near_those_before_them(on_surface):
    at = np.random.default_rng(0).uniform(-1, 1, (2000, 3)).astype(np.float32)
    points = Points(at, 2 * at if on_surface else None, at[:, 0], Appearance(at + 1, at + 2, at[:, 1]))
    found = points.in_places()
    np.testing.assert_array_equal(np.sort(found.positions, axis=0), np.sort(at, axis=0))
    moved = found.positions
    for values, expected in zip((found.spacing, *found.appearance), (moved[:, 0], moved + 1, moved + 2, moved[:, 1])):
        np.testing.assert_array_equal(values, expected)
    assert (found.normals == 2 * moved).all() if on_surface else found.normals is None
    step = lambda p: np.linalg.norm(np.diff(p, axis=0), axis=1).mean()
    assert step(moved) < 0.2 * step(at)
