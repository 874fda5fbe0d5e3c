"""One committed range of small scenes, and the same scenes as the other systems get them."""

import pytest

from services.bench.measure import make_in_memory, open_workbench
from services.bench.script import hand_over
from services.job.job_file import validate_job
from tests.services.bench.small_job import SMALL


@pytest.fixture(scope="package")
def bench(tmp_path_factory):
    """A workbench with one committed range, and that range."""
    bench = open_workbench(validate_job(SMALL, "test"), tmp_path_factory.getbasetemp(), tmp_path_factory.mktemp("ours"))
    span = bench.next_span(4)
    bench.run(span)
    return bench, span


@pytest.fixture(scope="package")
def given(bench, tmp_path_factory):
    """The range's scenes as the others get them."""
    bench, span = bench
    folder = tmp_path_factory.mktemp("given")
    return [
        hand_over(scene, bench.context.job, folder / str(n))
        for n, scene in enumerate(make_in_memory(bench.context, span))
    ]
