"""The transfer curve of sRGB at values that everybody knows."""

import numpy as np

from splinecli.transfer import encode_srgb


def test_srgb():
    # Half of the codes is 0.2159 of the light; 18 % gray is 118; the linear part near black; what lies outside is cut off.
    values = np.array([0, 0.001, 0.18, 0.2159, 0.5, 1, -1, 3])
    assert encode_srgb(values).tolist() == [0, 3, 118, 128, 188, 255, 0, 255]
