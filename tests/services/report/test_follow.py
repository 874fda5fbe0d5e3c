import shutil
import time

import numpy as np
import pytest

from services.look import live as module
from services.look.live import Follower, PictureShelf
from services.look.pictures import picture_of_colour
from workers.store.local import LocalStore


def test_the_oldest_pictures_leave_a_full_shelf():
    pictures = [picture_of_colour(np.full((64, 64, 3), shade, np.uint8), "") for shade in (0, 90, 180)]
    shelf = PictureShelf(2 * max(len(one.data) for one in pictures))
    addresses = [shelf.put(one) for one in pictures[:2]]
    shelf.put(pictures[0])  # is new again
    shelf.put(pictures[2])
    assert [shelf.get(one.name) is not None for one in pictures] == [True, False, True]
    assert addresses[0] == f"/picture/{pictures[0].name}"
    assert shelf.get("../../etc/passwd") is None


def test_a_folder_is_followed_from_nothing_to_its_report(shown, tmp_path):
    out = tmp_path / "out"
    follower = Follower(LocalStore(out), 2)
    follower.look()
    follower.report()
    assert "Waiting for a job" in follower.view.live and follower.view.shape == "" and follower.view.version == 0
    shutil.copytree(shown.root, out)
    follower.look()
    assert "Finished" in follower.view.live and follower.view.name == "small"
    follower._not_before = 0.0
    follower.report()
    assert follower.view.shape == "overview pictures compare space figures effects failures"
    assert follower.view.version == 1


def test_a_report_is_not_made_again_while_nothing_changes_nor_at_once(shown, monkeypatch):
    follower = Follower(shown, 2)
    made = []
    monkeypatch.setattr(
        module, "read_report", lambda *_: made.append(1) or (_ for _ in ()).throw(module.VersoError("x"))
    )
    follower.look()
    follower.report()
    follower.report()  # too soon
    assert len(made) == 1 and follower.view.version == 0
    follower._not_before = 0.0
    follower.report()  # the last try failed
    assert len(made) == 2
    monkeypatch.setattr(module, "read_report", lambda *_: pytest.fail("nothing changed"))
    follower._reported, follower._not_before = (4, "finished"), 0.0
    follower.report()


def test_the_thread_looks_by_itself_and_ends(shown, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "LOOK_S", 0.02)
    out = tmp_path / "out"
    follower = Follower(LocalStore(out), 1)
    follower.start()
    try:
        shutil.copytree(shown.root, tmp_path / "copy")
        (tmp_path / "copy").rename(out)
        end = time.monotonic() + 20
        while "Finished" not in follower.view.live:
            assert time.monotonic() < end
            time.sleep(0.02)
    finally:
        follower.stop()
    assert not follower._thread.is_alive()
