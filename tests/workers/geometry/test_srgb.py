"""sRGB against the values of IEC 61966-2-1, and codes against decimals."""

import numpy as np
import pytest

from workers.geometry.colour import SRGB_STEPS, decode_codes, decode_srgb, encode_codes, encode_srgb


def test_known_values():
    assert decode_srgb(np.array([0.0, 0.04045, 0.5, 1.0])) == pytest.approx([0.0, 0.0031308, 0.2140411, 1.0], abs=1e-7)


def test_encoding_undoes_decoding_and_clips():
    encoded = np.concatenate([np.linspace(0.0, 1.0, 101), np.linspace(0.0, 1.0, 256)])
    assert encode_srgb(decode_srgb(encoded)) == pytest.approx(encoded, abs=1e-12)
    assert encode_srgb(np.array([-1.0, 2.0])) == pytest.approx([0.0, 1.0], abs=1e-15)


def test_every_code_comes_back_and_light_between_two_codes_goes_to_the_nearest():
    codes = np.arange(256, dtype=np.uint8)
    assert (encode_codes(decode_codes(codes)) == codes).all()
    light = np.random.default_rng(0).uniform(-0.1, 1.1, 2000)
    assert (encode_codes(light) == np.rint(255.0 * encode_srgb(light))).all()
    assert SRGB_STEPS.shape == (256,)
