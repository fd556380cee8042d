"""Arrays that are kept: found again, computed again where damaged, and not kept where the disk takes no more."""

import numpy as np
import pytest

from rgs_mi.core.caches import cached_arrays

ARRAYS = {"a": np.arange(3), "b": np.ones((2, 2))}


def check(arrays):
    if arrays["a"].shape != (3,):
        raise ValueError("of another shape")


def never():
    raise AssertionError("computed although it was kept")


def same(arrays):
    return arrays.keys() == ARRAYS.keys() and all((arrays[name] == ARRAYS[name]).all() for name in ARRAYS)


def test_what_was_computed_is_found_again(tmp_path):
    path = tmp_path / "below" / "a.npz"
    assert same(cached_arrays(path, check, lambda: ARRAYS)) and same(cached_arrays(path, check, never))
    assert list(path.parent.iterdir()) == [path]


@pytest.mark.parametrize("damage", ["text", "short", "shape", "name"])
def test_what_is_damaged_is_computed_again(tmp_path, damage):
    path = tmp_path / "a.npz"
    cached_arrays(path, check, lambda: ARRAYS)
    if damage in ("text", "short"):
        path.write_bytes(b"text" if damage == "text" else path.read_bytes()[:-30])
    else:
        np.savez(path, **({"a": np.arange(4)} if damage == "shape" else {"c": np.arange(3)}))
    with pytest.warns(UserWarning, match="a.npz is damaged .*: computing it again"):
        assert same(cached_arrays(path, check, lambda: ARRAYS))
    assert same(cached_arrays(path, check, never))


def test_a_folder_that_takes_nothing_costs_the_cache_alone(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.warns(UserWarning, match="can't be written"):
        assert same(cached_arrays(tmp_path / "file" / "a.npz", check, lambda: ARRAYS))
