import csv

import numpy as np
import pytest
from PIL import Image

from rgs_mi.commands import growth
from rgs_mi.commands.growth import LARGE, SMALL, Load
from rgs_mi.core.errors import UserError


def test_what_is_measured():
    loads = growth._all_loads()
    assert loads[0] == SMALL and loads[-1] == LARGE and len(set(loads)) == len(loads)
    for name in ("surfels", "side", "views"):
        row = growth._row(dict.fromkeys(loads, growth.Cost(1.0, 2.0, None)), name, SMALL)
        assert list(row[name]) == sorted({getattr(load, name) for load in loads})
        assert np.isnan(row["memory_mb"]).all() and (row["step_ms"] == 2).all()


def test_enlarged(dataset):
    few = growth.enlarged(dataset, 48, len(dataset.train) + 2)
    assert len({view.name for view in few.train}) == len(dataset.train) + 2 and not few.test
    first, again = few.train[0], few.train[len(dataset.train)]
    assert (first.pixels == again.pixels).all() and not np.shares_memory(first.pixels, again.pixels)
    assert max(first.camera.size) == 48 and first.pixels.shape[1::-1] == tuple(first.camera.size)
    assert first.pixels.dtype == dataset.train[0].pixels.dtype
    ratio = 48 / max(dataset.train[0].camera.size)
    assert np.allclose(first.camera.focal, ratio * np.array(dataset.train[0].camera.focal), rtol=0.05)
    assert len(growth.enlarged(dataset, 48, 2).train) == 2


def test_growth(inputs, tmp_path, capsys):
    scene, data = inputs
    growth.growth(scene, data, tmp_path, [Load(300, 32, 8)])
    with open(tmp_path / "growth.csv") as text:
        rows = list(csv.DictReader(text))
    assert [row[name] for row in rows for name in ("surfels", "side", "views")] == ["300", "32", "8"]
    assert all(float(rows[0][name]) > 0 for name in ("start_s", "step_ms", "memory_mb"))
    assert len(capsys.readouterr().out.splitlines()) == 2
    with Image.open(tmp_path / "growth.png") as picture:
        assert picture.width > picture.height > 300


def test_what_fails_is_told(inputs, tmp_path):
    scene, _ = inputs
    with pytest.raises(UserError, match="nothing"):
        growth.growth(scene, tmp_path / "nothing", tmp_path, [Load(300, 32, 8)])
