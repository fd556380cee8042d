"""What the page of a capture advises: each line where it is due, and none where all is well."""

import numpy as np
import pytest

from rgs_mi.core.camera import Camera
from rgs_mi.datasets.masks import Silhouette
from rgs_mi.datasets.sources import Source
from rgs_mi.report import plots
from rgs_mi.report.advice import advice, largest_gap


def cameras(azimuths=range(0, 360, 12), elevations=(10, 45)):
    found = {}
    for e in np.radians(elevations):
        for a in np.radians(azimuths):
            place = 4 * np.array([np.cos(a) * np.cos(e), np.sin(a) * np.cos(e), np.sin(e)])
            found[f"v{len(found):02d}"] = Camera.look_at(place, (0, 0, 0), (0, 0, 1), 50, (8, 6))
    return found


def said(views=None, sharpness=None, errors=None, exposures=None, silhouette=None, left_out=0, **masks):
    views = cameras() if views is None else views
    names = [*views, *(f"lost{k}" for k in range(left_out))]
    sources = [
        Source(name, name, (sharpness or {}).get(name, 100.0), exposures[k % len(exposures)] if exposures else None)
        for k, name in enumerate(names)
    ]
    silhouettes = dict.fromkeys(views, silhouette or Silhouette(0.3, False))
    return advice(views, sources, dict.fromkeys(views, 0.5) | (errors or {}), silhouettes if silhouette != "none" else {})


def test_all_is_well():
    assert said() == []


@pytest.mark.parametrize(
    "options, words",
    [
        ({"views": cameras(range(0, 360, 30), (10, 50))}, "24 photographs are few for a shiny object"),
        ({"left_out": 9}, "9 of 69 photographs have no place"),
        ({"views": cameras(range(0, 300, 8))}, "64 degrees of the way around have no photograph, between v75 and v00"),
        ({"views": cameras(elevations=(10, 12))}, "All cameras are at one height, within 2 degrees"),
        ({"views": cameras(elevations=(-10, 20))}, r"Few photographs (0 of 60) look down"),
        ({"sharpness": {"v03": 9.0, "v05": 30.0}}, "Much less sharp than the others: v03, v05."),
        ({"sharpness": {f"v0{k}": 9.0 for k in range(9)}}, "v05 and 3 more"),
        ({"errors": {"v07": 2.0}}, "These do not fit the others as well: v07"),
        ({"errors": {f"v{k:02d}": 2.0 for k in range(60)}}, "Points are 2.0 pixels off in the median"),
        ({"exposures": [8.0, 8.4, 9.0]}, "The exposure changed by 1.0 stops"),
        ({"silhouette": "none"}, "There are no masks"),
        ({"silhouette": Silhouette(0.3, True)}, "The border cuts the object off in 60 of 60"),
        ({"silhouette": Silhouette(0.02, False)}, "The object is small"),
    ],
)
def test_a_line_for_each(options, words):
    (line,) = said(**options)
    assert words in line


def test_empty_masks():
    assert any("Masks with nothing in them" in line for line in said(silhouette=Silhouette(0.0, False)))


def test_gaps_go_through_north():
    start, width, before, after = largest_gap(cameras(range(20, 330, 10), (0,)))
    assert (round(start), round(width), before, after) == (320, 60, "v30", "v00")


def test_plots_of_cameras():
    views = cameras().values()
    origins, axes = (np.stack([c.to_world[:3, k] for c in views]) for k in (3, 2))
    above, beside = plots.cameras(origins, axes, np.random.default_rng(0).normal(size=(50, 3)), (90.0, 60.0))
    assert above.startswith("<svg") and beside.startswith("<svg") and "cameras from above" in above
    assert plots.bars([1, 2, float("nan")], [False, True, False], "x", "y").count("<path") > 3
