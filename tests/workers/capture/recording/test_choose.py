"""The choice of frames, for a made-up camera that moves over a random texture, stands still, comes back and blurs."""

import cv2
import numpy as np
import pytest

from workers.capture.recording.choose import FrameMeasure, choose_frames, measure_frame

WIDTH, HEIGHT = 320, 180


def scene(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = cv2.resize(rng.integers(0, 256, (5, 30)).astype(np.uint8), (2400, 400), interpolation=cv2.INTER_CUBIC)
    return (0.8 * coarse + 0.2 * rng.integers(0, 256, coarse.shape)).astype(np.uint8)


def filmed(seed: int, places: np.ndarray, blurred: np.ndarray) -> list[FrameMeasure]:
    """Frames at horizontal places, pixels of the scene."""
    whole = scene(seed)
    rng = np.random.default_rng(seed + 100)
    noise = rng.normal(0, 2, (2 * HEIGHT, WIDTH))
    made = []
    for place, is_blurred in zip(places, blurred, strict=True):
        frame = whole[100 : 100 + HEIGHT, int(place) : int(place) + WIDTH]
        if is_blurred:
            frame = cv2.blur(frame, (9, 1))
        start = rng.integers(HEIGHT)  # sensor noise, other in each frame
        noisy = np.clip(frame + noise[start : start + HEIGHT], 0, 255).astype(np.uint8)
        made.append(measure_frame(noisy))
    return made


def path() -> np.ndarray:
    """A slow way to the right, a long stand, a way back, and on to the far end."""
    return np.concatenate(
        [np.linspace(0, 900, 60), np.full(120, 900), np.linspace(900, 300, 40), np.linspace(300, 2000, 80)]
    )


@pytest.mark.parametrize("seed", range(6))
def test_chosen_frames_cover_the_path_and_a_stand_counts_once(seed):
    places = path()
    chosen = choose_frames(filmed(seed, places, np.zeros(len(places), bool)), 24)
    at = np.sort(places[chosen])
    assert len(chosen) == 24 and chosen == sorted(set(chosen))
    assert np.diff(at).max() < 250 and at[0] < 85 and at[-1] > 1915, "at most three times the even spacing"
    assert sum(60 <= i < 180 for i in chosen) <= 2, "40 % of the time is spent standing"


@pytest.mark.parametrize("seed", range(4))
def test_blurred_frames_are_not_chosen_where_sharp_ones_are_beside_them(seed):
    places = np.linspace(0, 2000, 300)
    blurred = np.random.default_rng(seed).random(300) < 0.6
    chosen = choose_frames(filmed(seed, places, blurred), 30)
    assert not blurred[chosen].any()


def test_a_whole_stretch_of_blur_is_left_out():
    places = np.linspace(0, 2000, 300)
    blurred = (np.arange(300) >= 100) & (np.arange(300) < 140)
    chosen = choose_frames(filmed(1, places, blurred), 20)
    assert not blurred[chosen].any()


def test_all_frames_are_taken_where_there_are_not_more():
    measures = filmed(0, np.linspace(0, 500, 7), np.zeros(7, bool))
    assert choose_frames(measures, 7) == choose_frames(measures, 50) == list(range(7))
    assert len(choose_frames(measures, 6)) == 6, "even where few are the sharpest of their time"
    assert choose_frames([], 5) == []


def test_black_frames_have_no_sharpness_and_no_look():
    measure = measure_frame(np.zeros((HEIGHT, WIDTH), np.uint8))
    assert measure.sharpness == 0.0 and not measure.look.any()
    assert len(choose_frames([measure] * 10, 4)) == 4


def test_brightness_and_contrast_do_not_change_the_look():
    frame = scene(0)[:HEIGHT, :WIDTH]
    darker = (frame * 0.5 + 20).astype(np.uint8)
    assert measure_frame(darker).look == pytest.approx(measure_frame(frame).look, abs=0.01)
