"""Hosts that a cluster loses, and whose shards those were."""

from schemas.dataset.commit import Span
from services.run.coordinator import LOOK_EVERY_S, LostNodes, hosts_of
from tests.made_up_scenes import small_scene, terms
from workers.store import attempt as module
from workers.store.attempt import Attempt, begin_attempt
from workers.store.local import LocalStore


def test_a_host_is_told_once_when_it_has_no_node_any_more():
    alive, now = ["h1", "h2", "h2", "h3"], [0.0]
    nodes = LostNodes(lambda: set(alive), lambda: now[0])
    assert nodes.take() == set()
    found = []
    for alive[:] in (["h1", "h2", "h3"], ["h1", "h3"], ["h1", "h3"], ["h1", "h3", "h2"], ["h1"]):
        assert nodes.take() == set(), "too soon to ask again"
        now[0] += LOOK_EVERY_S
        found.append(nodes.take())
    assert found == [set(), {"h2"}, set(), set(), {"h2", "h3"}]


def test_a_shards_hosts_are_those_that_began_or_committed_its_ranges(tmp_path, monkeypatch):
    store = LocalStore(tmp_path)
    store.prepare()

    def begin(start: int, host: str) -> Attempt:
        monkeypatch.setattr(module.socket, "gethostname", lambda: host)
        attempt = begin_attempt(store, Span(start=start, stop=start + 2), terms(range_size=2), "ours")
        for scene_id in attempt.span.scene_ids:
            attempt.add_scene(small_scene(scene_id))
        return attempt

    begin(0, "h-1").commit()
    begin(2, "h2")
    begin(4, "h3").abandon()
    spans = [Span(start=start, stop=start + 2) for start in (0, 2, 4, 6)]
    assert [hosts_of(store, "ours", [span]) for span in spans] == [{"h_1"}, {"h2"}, set(), set()]
    assert hosts_of(store, "ours", spans) == {"h_1", "h2"}
    assert hosts_of(store, "others", spans) == set()
