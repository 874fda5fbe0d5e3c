"""The example that measures reading: both sides read the same images."""

import sys

import load_pairs
import numpy as np


def test_a_pair_and_opencv_by_hand_have_the_same_pixels_and_both_are_timed(few, monkeypatch, capsys):
    pairs = load_pairs.Pairs(few.root, ["rgb", "depth", "region"])
    for number in range(len(pairs)):
        for ours, theirs in zip(pairs[number], pairs.by_hand(number), strict=True):
            assert ours.dtype == theirs.dtype and np.array_equal(ours, theirs)
    monkeypatch.setattr(sys, "argv", ["load_pairs", str(few.root), "--kinds", "rgb,depth,region"])
    monkeypatch.setattr(load_pairs, "find_spec", lambda name: None)
    load_pairs.main()
    assert "ms of processor, OpenCV by hand" in capsys.readouterr().out
