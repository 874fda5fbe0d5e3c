"""Object stores that fail one request in ten, are slow, full, or lack what commits need."""

import itertools
import random
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from schemas.dataset.layout import commit_path
from schemas.errors import MachineError, OutputError
from tests.kit.faults import check_published
from tests.kit.made_up_runs import FIRST, RANGE, make_dataset, settings_of
from tests.kit.s3_server import FAULTS, Bucket, Fault, s3_server
from tests.made_up_scenes import attempt_at, small_scene
from workers.store.local import LocalStore
from workers.store.objects import ObjectStore

pytestmark = pytest.mark.usefixtures("unflushed")


@contextmanager
def store_in(bucket: Bucket, timeout_s: float = 30.0) -> Iterator[ObjectStore]:
    with s3_server(bucket, timeout_s) as client:
        yield ObjectStore(client, "s3://mine")


def on_disk(root: Path) -> str:
    return make_dataset(LocalStore(root), "tar").digest


def decisions(bucket: Bucket) -> dict[str, int]:
    """How often each commit record was written."""
    return {key: times for key, times in bucket.puts.items() if key.startswith("manifest/_commits/")}


@pytest.mark.parametrize(
    "seed",
    [pytest.param(1, marks=pytest.mark.minute), *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 22))],
)
def test_a_store_that_fails_one_request_in_ten_gets_the_dataset_of_a_disk(seed, tmp_path, record_figure):
    expected = on_disk(tmp_path)
    bucket = Bucket()
    bucket.share, bucket.chance = 0.1, random.Random(seed)
    with store_in(bucket, timeout_s=0.5) as store:
        assert make_dataset(store, "tar").digest == expected
        bucket.share = 0.0
        assert not list(store.files("_staging"))
    faults, requests = bucket.requests["fault"], bucket.requests.total() - bucket.requests["fault"]
    print(f"seed {seed}: {faults} of {requests} requests met a fault")
    record_figure("requests that met a fault", "passed", faults)
    assert faults > requests / 20
    assert len(decisions(bucket)) == 2
    assert set(decisions(bucket).values()) == {1}


@pytest.mark.parametrize("fault", FAULTS)
def test_a_decision_that_meets_a_fault_three_times_is_made_once(fault: Fault):
    bucket = Bucket()
    with store_in(bucket, timeout_s=0.3) as store:
        attempt = attempt_at(store, FIRST, FIRST + RANGE, settings_of("tar"), small_scene)
        fail_puts_of(bucket, commit_path(FIRST), [fault] * (2 if fault == "silence" else 3))
        result = attempt.commit()
        assert result.won
        check_published(store, result.record)
    assert set(decisions(bucket).values()) == {1}


def test_a_decision_that_is_sent_again_and_meets_somebody_elses_is_lost():
    bucket = Bucket()
    with store_in(bucket, timeout_s=0.3) as store:
        mine = attempt_at(store, FIRST, FIRST + RANGE, settings_of("tar"), small_scene)
        theirs = attempt_at(store, FIRST, FIRST + RANGE, settings_of("tar"), small_scene)
        won = []
        fail_puts_of(bucket, commit_path(FIRST), ["503"], meanwhile=lambda: won.append(theirs.commit()))
        result = mine.commit()
        assert (result.won, result.conflict, won[0].won) == (False, None, True)
        assert result.record == won[0].record
        check_published(store, result.record)
    assert decisions(bucket) == {commit_path(FIRST): 1}


def fail_puts_of(
    bucket: Bucket, key: str, faults: list[Fault], meanwhile=lambda: None, method: str = "PUT", skip: int = 0
) -> None:
    """The next requests for `key`, after `skip`, meet these faults; `meanwhile` happens after the first one."""
    left: list[Fault | None] = [*[None] * skip, *faults]
    real = bucket.counted

    @contextmanager
    def counted(asked: str, of: str) -> Iterator[Fault | None]:
        with real(asked, of) as fault:
            if asked == method and of == key and left:
                fault = left.pop(0)
                if len(left) == len(faults) - 1:
                    meanwhile()
            yield fault

    vars(bucket)["counted"] = counted


@pytest.mark.parametrize("conditional", ["ignored", pytest.param("refused", marks=pytest.mark.minute)])
def test_a_store_without_conditional_puts_is_refused_before_anything_is_made(conditional):
    bucket = Bucket(conditional)
    with (
        store_in(bucket) as store,
        pytest.raises(
            OutputError, match=r"^s3://mine does not refuse a second put .* Use a store with conditional puts"
        ),
    ):
        make_dataset(store, "tar")
    assert bucket.objects == {}


@pytest.mark.minute
def test_a_store_whose_quota_is_used_up_at_any_put_loses_nothing(tmp_path):
    expected = on_disk(tmp_path)
    whole = Bucket()
    with store_in(whole) as store:
        make_dataset(store, "tar")
    total = sum(map(len, whole.objects.values()))
    for share in (0.0, 0.1, 0.4, 0.6, 0.8, 0.95):
        bucket = Bucket()
        with store_in(bucket) as store:
            store.prepare()
            bucket.quota = int(share * total)
            with pytest.raises((MachineError, OutputError), match=r"^[^\n]*QuotaExceeded[^\n]*$"):
                make_dataset(store, "tar")
            bucket.quota = None
            assert make_dataset(store, "tar").digest == expected, share
            assert not list(store.files("_staging")), share


@pytest.mark.minute
def test_files_that_are_put_in_parts_arrive_whole_through_faults(tmp_path):
    bucket = Bucket()
    bucket.share, bucket.chance = 0.2, random.Random(3)
    data = random.Random(0).randbytes(12 << 20)
    local = tmp_path / "large"
    with store_in(bucket, timeout_s=2.0) as store:
        stage = store.stage("_staging/0/r0-x")
        for number in itertools.count():
            with stage.stream(f"{number}.tar") as file:
                file.write(data)
            local.write_bytes(data)
            store.replace(local, f"{number}.csv")
            assert store.read(f"_staging/0/r0-x/{number}.tar") == store.read(f"{number}.csv") == data
            if bucket.requests["fault"] >= 5:
                break
        fail_puts_of(bucket, "_staging/0/r0-x/last.tar", ["reset when done"], method="POST", skip=1)
        with stage.stream("last.tar") as file:
            file.write(data)  # the parts are joined, and nobody hears of it
        assert store.read("_staging/0/r0-x/last.tar") == data
