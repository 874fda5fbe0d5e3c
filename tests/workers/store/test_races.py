import subprocess
import sys

from tests.kit.faults import check_published
from tests.made_up_scenes import TERMS
from tests.stored_images import iter_records
from workers.store.attempt import sweep
from workers.store.local import LocalStore

RACER = """
import sys, time
from pathlib import Path
from tests.made_up_scenes import attempt_at, small_scene, terms
from workers.store.local import LocalStore
store, me = LocalStore(sys.argv[1]), sys.argv[2]
attempts = [attempt_at(store, start, start + 4, terms(fingerprint=me), small_scene) for start in range(0, 80, 4)]
Path(sys.argv[1], me).touch()
while not all(Path(sys.argv[1], name).exists() for name in "ab"):
    pass
for attempt in attempts:
    result = attempt.commit()
    print(result.won, result.conflict, result.record.terms.fingerprint)
"""


def test_of_two_processes_that_commit_the_same_ranges_one_wins_each_and_nothing_is_lost(tmp_path):
    store = LocalStore(tmp_path)
    store.prepare()
    racers = [
        subprocess.Popen([sys.executable, "-c", RACER, str(tmp_path), name], stdout=subprocess.PIPE, text=True)
        for name in "ab"
    ]
    told = [racer.communicate(timeout=120)[0].splitlines() for racer in racers]
    assert [racer.returncode for racer in racers] == [0, 0]
    assert len(told[0]) == len(told[1]) == 20
    for mine, theirs in zip(*told, strict=True):
        won = [line.split()[0] == "True" for line in (mine, theirs)]
        assert sum(won) == 1
        assert {line.split()[1] for line in (mine, theirs)} == {"None"}
        assert {line.split()[2] for line in (mine, theirs)} == {"ab"[won.index(True)]}
    records = list(iter_records(store))
    assert [record.span.start for record in records] == list(range(0, 80, TERMS.range_size))
    for record in records:
        check_published(store, record)
    sweep(store)
    assert not list(store.files("_staging"))
