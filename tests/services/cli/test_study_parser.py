"""What the commands that measure take."""

import pytest

from services.cli.parser import build_parser
from services.cli.rows import STUDY_COMMANDS


@pytest.mark.parametrize("name", STUDY_COMMANDS)
def test_the_example_of_each_is_taken(name):
    options = build_parser().parse_args([name, *STUDY_COMMANDS[name].example.split()])
    assert options.handler == STUDY_COMMANDS[name].handler


def test_a_bench_starts_ray_only_for_workers_or_nodes():
    starts = [build_parser().parse_args(["bench", *words]) for words in ([], ["--workers", "2"], ["--nodes", "1,4"])]
    assert [options.starts_ray(options) for options in starts] == [False, True, True]
