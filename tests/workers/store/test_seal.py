"""The seal of a text file: any change of any byte breaks it."""

import random

from tests.damage import cut, flip
from workers.store.commit import is_sealed, seal

TEXT = "key: 5\nname: kubek żółty\n"


def test_a_sealed_text_is_whole_and_its_text_is_kept():
    data = seal(TEXT, "seal: ")
    assert data.startswith(TEXT.encode()) and data.count(b"\n") == 3
    assert is_sealed(data, "seal: ")
    assert not is_sealed(data, "other: ")


def test_every_flipped_bit_and_every_cut_breaks_the_seal():
    data = seal(TEXT, "<!-- ", " -->\n")
    assert is_sealed(data, "<!-- ", " -->\n")
    for at in range(8 * len(data)):
        changed = bytearray(data)
        changed[at // 8] ^= 1 << at % 8
        assert not is_sealed(bytes(changed), "<!-- ", " -->\n")
    assert not any(is_sealed(data[:length], "<!-- ", " -->\n") for length in range(len(data)))


def test_the_damage_of_tests_changes_what_it_damages():
    chance = random.Random(3)
    for damage in (flip, cut):
        assert all(damage(TEXT.encode(), chance) != TEXT.encode() for _ in range(50))
