"""The lower bound writes the same bytes, and its encoders are lossless."""

import numpy as np
import pytest

from services.bench.lower_bound import choose_encoders, encoders, images_of, kind_of, run_lower_bound, write_durably
from services.bench.measure import make_in_memory
from workers.store.commit import committed_files, read_record


def test_the_floor_writes_the_bytes_that_ours_committed(bench, tmp_path):
    bench, span = bench
    record = read_record(bench.store, span.start)
    files = bench.files(span)
    chosen = choose_encoders(images_of(files))
    assert set(chosen) == {"rgb", "uint16", "uint8"}
    lap = run_lower_bound(
        bench.context.renderer, make_in_memory(bench.context, span), files, chosen, tmp_path / "floor"
    )
    assert list(lap.stages_s) == ["draw", "encode", "write"]
    assert lap.apart_s > 0, "shapes reach the GPU before the clock"
    written = {str(p.relative_to(tmp_path / "floor")): p.read_bytes() for p in (tmp_path / "floor").rglob("*.*")}
    assert written == files
    assert sum(map(len, written.values())) == sum(entry.bytes for entry in committed_files(bench.store, record))
    assert write_durably(files, tmp_path / "again") == sum(map(len, files.values()))


@pytest.mark.parametrize("name", encoders())
def test_every_encoder_that_may_be_chosen_is_lossless(bench, name):
    bench, span = bench
    images = images_of(bench.files(span))
    noise = np.random.default_rng(1).integers(0, 65536, (5, 7), np.uint16)
    images += [(noise, 0), (noise.astype(np.uint8)[:1, :1], 0)]
    encoded = {f"{n}.png": encoders()[name](pixels) for n, (pixels, _) in enumerate(images)}
    for (pixels, _), (again, _) in zip(images, images_of(encoded), strict=True):
        assert pixels.dtype == again.dtype
        np.testing.assert_array_equal(pixels, again)


def test_an_encoder_that_hardly_compresses_is_no_floor(bench):
    bench, span = bench
    rgb = [one for one in images_of(bench.files(span)) if kind_of(one[0]) == "rgb"]
    _, encode = choose_encoders(rgb)["rgb"]
    assert sum(len(encode(pixels)) for pixels, _ in rgb) <= 2 * sum(size for _, size in rgb)
    with pytest.raises(ValueError, match="empty"):  # not one of them is that small
        choose_encoders([(pixels, size // 100) for pixels, size in rgb])
