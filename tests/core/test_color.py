"""The sRGB curve against numbers of the standard's, and against Mitsuba's."""

import mitsuba as mi
import numpy as np

from rgs_mi.core.color import srgb_decode, srgb_encode

# Linear light and display values by IEC 61966-2-1, worked out with fifty digits: both pieces, and where they meet.
LINEAR = [0, 0.001, 0.0031308, 0.01, 0.05, 0.18, 0.5, 1]
DISPLAY = [0, 0.01292, 0.040449936, 0.0998528227, 0.2478005280, 0.4613561295, 0.7353569830, 1]


def test_values_of_the_standard():
    np.testing.assert_allclose(srgb_encode(LINEAR), DISPLAY, atol=1e-9)
    np.testing.assert_allclose(srgb_decode(DISPLAY), LINEAR, atol=1e-8)
    np.testing.assert_allclose(srgb_decode(128 / 255), 0.2158605001, atol=1e-9)  # grey 128


def test_is_mitsubas():
    linear = np.linspace(0, 1, 4096, dtype=np.float32).reshape(64, 64, 1).repeat(3, 2)
    theirs = mi.Bitmap(linear).convert(component_format=mi.Struct.Type.Float32, srgb_gamma=True)
    np.testing.assert_allclose(srgb_encode(linear), np.array(theirs), atol=2e-6)
