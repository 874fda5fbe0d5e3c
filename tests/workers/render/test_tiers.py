"""Whether a tier's packages are asked for where they are needed, and what is said without them."""

import importlib.util

import pytest

from schemas.errors import InputError
from schemas.job.job import Job
from workers.render import tiers
from workers.render.tiers import require_mitsuba


def test_without_mitsuba_the_message_says_how_to_get_it(monkeypatch):
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)
    with pytest.raises(InputError, match=r"\./verso extra pathtraced.*render\.tier") as caught:
        require_mitsuba()
    assert caught.value.exit_code == 2


def test_path_tracing_is_not_needed_where_no_rgb_is_asked(monkeypatch):
    def refuse() -> None:
        raise AssertionError("Mitsuba is looked for")

    monkeypatch.setattr(tiers, "require_mitsuba", refuse)
    job = Job.model_validate({"name": "t", "render": {"tier": "pathtraced", "rgb": False}})
    tiers.require_tier(job.render)
    with pytest.raises(AssertionError):
        tiers.require_tier(job.render.model_copy(update={"rgb": True}))
