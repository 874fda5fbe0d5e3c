"""What is typed for an argument: taken where it can be meant, and told in a short line where not."""

import argparse

import pytest

from services.cli.arguments import read_span
from services.cli.parser import build_parser


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["run", "j", "--scenes", "9" * 100_000], "'999"),
        (["run", "j", "--scenes", "²"], "whole number"),
        (["run", "j", "--out", "a\0b"], "'a\\x00b'"),
        (["run", "j", "--out", "a\udcff"], "'a\\udcff'"),
        (["run", "j", "--out", ""], "''"),
        (["run", "j", "--out", "\x1b[31m"], "\\x1b[31m"),
        (["run", "x" * 100_000], "'xxx"),
        (["status", "a\0b"], "'a\\x00b'"),
        (["scene", "o", "1", "--glb", "a\0b"], "'a\\x00b'"),
        (["run", "j", "--address", "x" * 70 + ":6379"], "HOST:PORT"),
        (["run", "j", "--address", "localhost:99999"], "HOST:PORT"),
        (["run", "j", "--address", "localhost:²"], "HOST:PORT"),
        (["run", "j", "--address", "a\0b:6379"], "HOST:PORT"),
        (["run", "j", "--address", "nonsense"], "HOST:PORT"),
        (["run", "j", "--metrics", "9464"], "HOST:PORT"),
        (["run", "j", "--metrics", "auto"], "HOST:PORT"),
        (["\x1b[31m" * 10_000], "\\x1b[31m"),
    ],
)
def test_a_hostile_argument_is_told_in_a_short_line(words, told, capsys):
    with pytest.raises(SystemExit) as caught:
        build_parser().parse_args(words)
    assert caught.value.code == 2
    *_, line = capsys.readouterr().err.splitlines()
    assert told in line
    assert line.isprintable() and len(line) < 500, line


@pytest.mark.parametrize("address", ["auto", "127.0.0.1:6379", "head.cluster.local:6379", "[::1]:6379", "a_b-c:1"])
def test_an_address_as_ray_prints_it_is_taken(address):
    assert build_parser().parse_args(["run", "j", "--address", address]).address == address


def test_an_address_of_rays_client_is_refused_with_the_ways_that_work(capsys):
    with pytest.raises(SystemExit) as caught:
        build_parser().parse_args(["run", "j", "--address", "ray://head:10001"])
    assert caught.value.code == 2
    told = capsys.readouterr().err
    assert "'ray://head:10001'" in told and "HOST:PORT" in told and "deploy/submit.py" in told


def test_a_span_is_two_ids_or_one():
    assert (read_span("0-63"), read_span("7")) == ((0, 63), (7, 7))
    for text in ("", "-", "3-", "5-3", "a-b", "1-2-3"):
        with pytest.raises(argparse.ArgumentTypeError):
            read_span(text)
