"""The transfer curve of sRGB at values that everybody knows."""

import numpy as np
import pytest

from splinecli.errors import UsageError
from splinecli.maths.transfer import decode_transfer, encode_srgb, parse_transfer


def test_srgb():
    # Half of the codes is 0.2159 of the light; 18 % gray is 118; what lies outside 0 to 1 is cut off.
    values = np.array([0, 0.001, 0.18, 0.2159, 0.5, 1, -1, 3])
    assert encode_srgb(values).tolist() == [0, 3, 118, 128, 188, 255, 0, 255]


def test_decoding_turns_encoding_back():
    codes = np.arange(256)
    assert encode_srgb(decode_transfer((codes / 255).astype(np.float32), None)).tolist() == codes.tolist()
    np.testing.assert_allclose(decode_transfer(np.float32([0.25, 0.5]), 2.0), [0.0625, 0.25])


def test_names_of_curves():
    assert [parse_transfer(text) for text in ("auto", "linear", "srgb", "gamma:2.2")] == [1.0, 1.0, None, 2.2]
    for text in ("", "sRGB", "gamma", "gamma:", "gamma:0", "gamma:1.2.3", "gamma:99"):
        with pytest.raises(UsageError, match=r"expected auto, linear, srgb, or gamma:G with G from 0\.1 to 10"):
            parse_transfer(text)
