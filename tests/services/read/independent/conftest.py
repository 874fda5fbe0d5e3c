"""Wrong formulas, planted in the producer's modules."""

import sys
from collections.abc import Callable

import pytest

from schemas.dataset.shard import Fingerprint
from workers.render.raster.gbuffer import shared_renderer
from workers.shard.fingerprint import take_fingerprint


@pytest.fixture(scope="package")
def fingerprint() -> Fingerprint:
    """Taken before anything is planted: its canary scene has stricter checks."""
    return take_fingerprint(shared_renderer(), "raster")


@pytest.fixture
def plant(monkeypatch, fingerprint) -> Callable[[Callable, Callable], None]:
    """Puts a function in another's place in every module that has it by name."""
    monkeypatch.setattr("tests.datasets.take_fingerprint", lambda *_: fingerprint)

    def replace(original: Callable, planted: Callable) -> None:
        for module in list(sys.modules.values()):
            if getattr(module, original.__name__, None) is original:
                monkeypatch.setattr(module, original.__name__, planted)

    return replace
