"""What EXIF tells of exposures, written by Pillow."""

import numpy as np
import pytest
from PIL import Image

from rgs_mi.datasets.exif import exposure_value, kept, log_gains

EXPOSURE, APERTURE, ISO, FOCAL, MAKER = 0x829A, 0x829D, 0x8827, 0xA405, 0x927C


def exif(**tags):
    made = Image.Exif()
    made.get_ifd(0x8769).update({globals()[name.upper()]: value for name, value in tags.items()})
    return made


def photograph(path, **tags):
    Image.new("RGB", (16, 16)).save(path, exif=exif(**tags))
    return path


def test_stops():
    assert exposure_value(exif(exposure=1 / 64, aperture=2.0, iso=100)) == pytest.approx(8)
    assert exposure_value(exif(exposure=1 / 64, aperture=2.0, iso=(200, 0))) == pytest.approx(7)
    assert exposure_value(exif(aperture=2.0)) is None
    assert exposure_value(exif(exposure=0.0)) is None


def test_gains_of_a_bracket(tmp_path):
    """Twice as long is twice as bright; the mean of the logarithms is zero; one that tells nothing leaves all at zero."""
    paths = [photograph(tmp_path / f"{k}.jpg", exposure=2.0**-k, iso=100) for k in range(6, 9)]
    assert np.exp(log_gains(paths)) == pytest.approx([2, 1, 0.5])
    assert not log_gains([*paths, photograph(tmp_path / "none.jpg", focal=28)]).any()
    assert not log_gains([*paths, tmp_path / "missing.jpg"]).any()


def test_only_what_serves_is_kept(tmp_path):
    path = photograph(tmp_path / "a.jpg", exposure=0.01, iso=100, focal=28, maker=b"secret")
    with Image.open(path) as image:
        Image.new("RGB", (16, 16)).save(tmp_path / "b.jpg", exif=kept(image.getexif()))
    with Image.open(tmp_path / "b.jpg") as image:
        assert set(image.getexif().get_ifd(0x8769)) == {EXPOSURE, ISO, FOCAL}
