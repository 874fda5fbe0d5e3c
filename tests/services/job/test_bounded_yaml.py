"""What a YAML text may cost, and the line that tells which key costs more."""

import subprocess
import sys
import time

import pytest
import yaml

from schemas.errors import JobError
from services.job.bounded_yaml import MOST_CHARACTERS, MOST_LEVELS, MOST_VALUES, parse_yaml


def alias_bomb(key: str, levels: int = 9) -> str:
    """A text of some hundred letters that stands for 9 to the power `levels` values."""
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]" for i in range(1, levels)]
    return "\n".join([*lines, f"{key}: *a{levels - 1}", ""])


HOSTILE = (
    (alias_bomb("name"), ["line 2", "a1.0", "'*a0'", "write it out"]),
    ("name: &a [*a]", ["name.0", "'*a'"]),
    ("physics: &p {rest: *p}", ["physics.rest", "'*p'"]),
    ("".join(f"k{i}: 1\n" for i in range(MOST_VALUES)), [f"over {MOST_VALUES}", "keys and values"]),
    (f"categories: [{'a,' * MOST_VALUES}]", ["categories.", f"over {MOST_VALUES}"]),
    (f"name: {'a' * MOST_CHARACTERS}", [str(MOST_CHARACTERS)]),
    (f"name: {'[' * 900}{']' * 900}", ["name.0.0", f"over {MOST_LEVELS} levels"]),
    (f"name: {'{a: ' * 900}{'}' * 900}", ["name.a.a", f"over {MOST_LEVELS} levels"]),
    ("".join(f"{' ' * i}a:\n" for i in range(900)), ["a.a.a", f"over {MOST_LEVELS} levels"]),
    ("name: " + "[" * 100_000, ["name.0.0", f"over {MOST_LEVELS} levels"]),
    ("physics:\n  step_hz: " + "9" * 100_000, ["line 2", "physics.step_hz", "100000 characters"]),
    ("seed: 0x" + "f" * 100_000, ["seed", "100002 characters"]),
    ("seed: 1" + ":1" * 20_000, ["seed", "40001 characters"]),
    ("seed: 1" + ":1" * 2_000 + ".5", ["seed", "4003 characters"]),
    ("name: !!python/object/apply:os.system ['true']", ["name", "os.system", "tag"]),
    ("seed: !!int abc", ["seed", "tag"]),
    ("categories: !!set {mug}", ["categories", "tag"]),
    ("a:\n  b: 1\n  b: 2", ["line 3", "'b'", "twice"]),
    ("a: {3: b}", ["line 1", "3", "not a word"]),
    ("? [a, b]\n: c", ["line 1", "['a', 'b']", "not a word"]),
    ("~: c", ["None", "not a word"]),
    ("name: a\0b", ["not YAML"]),
    ("name: a\udcff", ["not YAML"]),
    ("a:\n\tb: 3", ["not YAML", "line 2, column 1"]),
    ("a: 1\n---\nb: 2", ["not YAML", "line 2", "document"]),
    ("a: *\x1b[31m", ["not YAML"]),
)


def test_a_text_that_asks_for_too_much_is_refused_in_a_line_with_its_key():
    for text, words in HOSTILE:
        started = time.process_time()
        with pytest.raises(JobError) as caught:
            parse_yaml(text)
        assert time.process_time() - started < 2
        message = str(caught.value)
        assert all(word in message for word in words), message
        assert message.isprintable() and len(message) < 400, message


def test_the_costliest_text_that_is_read_takes_a_second_and_200_mb():
    """In a process of its own, whose memory is that of nothing else."""
    code = (
        "import re, time; from services.job.bounded_yaml import *;"
        "pair = 'k%d: abcdefghijklmnopqrstuvwxyz0123456789\\n';"
        "text = ''.join(pair % i for i in range(MOST_VALUES // 2 - 1)); before = time.process_time();"
        "assert len(parse_yaml(text)) == MOST_VALUES // 2 - 1;"
        "peak = re.search('VmHWM: *([0-9]+)', open('/proc/self/status').read().replace(chr(9), ' '))[1];"
        "print(time.process_time() - before, int(peak) / 1024)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    seconds, megabytes = map(float, done.stdout.split())
    assert seconds < 3  # 0.5 on an idle core
    assert megabytes < 200


def test_what_a_text_holds_is_what_yaml_says_but_for_dates_and_merge_keys():
    for text, value in (
        ("", None),
        ("a: &x 1", {"a": 1}),
        ("a: '" + "9" * 100 + "'", {"a": "9" * 100}),
        ("a: [1, 2.5, true, null, x, 'y', \"z\", 0x10, 1_000]", {"a": [1, 2.5, True, None, "x", "y", "z", 16, 1000]}),
        ("a: {b: [{c: d}]}\ne: |\n  two\n  lines\n", {"a": {"b": [{"c": "d"}]}, "e": "two\nlines\n"}),
        ("[a, [b, {c: d}]]", ["a", ["b", {"c": "d"}]]),
    ):
        assert parse_yaml(text) == value == yaml.safe_load(text)
    for text in ("2024-01-01", "2024-13-45", "2001-12-14t21:59:43.10-05:00", "="):
        assert parse_yaml(f"name: {text}") == {"name": text}
    assert parse_yaml("<<: {a: 1}\nb: 2") == {"<<": {"a": 1}, "b": 2}


def test_a_text_within_every_bound_is_read_whole():
    levels = MOST_LEVELS - 1
    tree = parse_yaml(f"a: {'[' * levels}{']' * levels}")
    for _ in range(levels):
        tree = tree["a"] if isinstance(tree, dict) else tree[0]
    assert tree == []
    assert len(parse_yaml(f"[{'a,' * (MOST_VALUES - 2)}]")) == MOST_VALUES - 2
