"""Patches: where they are, and how much of one its object fills."""

import dataclasses

import numpy as np

from schemas.job.views import Patch
from schemas.scene.view import ObjectLabel
from tests.workers.labels.planes import HERE, plane_view
from workers.scene.labels import crop_box, patch_object_fraction


def label(u: int, v: int) -> ObjectLabel:
    return ObjectLabel(3, "mug", "m", np.eye(4), u, v, (0, 0, 0, 0), 1, 1.0)


def test_a_patch_is_centred_on_the_object_and_left_out_where_it_would_leave_the_image():
    patch = Patch(width=128, height=96)
    assert crop_box(label(80, 60), HERE, patch) == (slice(12, 108), slice(16, 144))
    assert crop_box(label(64, 48), HERE, patch) == (slice(0, 96), slice(0, 128))
    assert crop_box(label(63, 60), HERE, patch) is None
    assert crop_box(label(97, 60), HERE, patch) is None
    assert crop_box(label(80, 73), HERE, patch) is None
    assert crop_box(label(-1, -1), HERE, patch) is None


def test_an_object_that_the_view_does_not_see_has_no_patch():
    hidden = dataclasses.replace(label(80, 60), pixels=0)
    assert crop_box(hidden, HERE, Patch(width=128, height=96)) is None


def test_the_share_of_a_patch_that_is_its_object_is_counted_in_the_mask():
    view = plane_view("input", HERE)
    region = np.full_like(view.region, 2)
    region[:60] = 3
    view, patch = dataclasses.replace(view, region=region), Patch(width=32, height=24)
    assert patch_object_fraction(view, label(80, 60), patch) == 0.5
    assert patch_object_fraction(view, label(80, 40), patch) == 1.0
    assert patch_object_fraction(view, label(5, 60), patch) is None
    assert patch_object_fraction(dataclasses.replace(view, region=None), label(80, 60), patch) is None
