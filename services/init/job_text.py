"""Pure: the commented job file of a folder of meshes."""

import json
import re
from collections.abc import Mapping, Sequence

from services.init.guess import plain_axis
from services.init.model import Guess, Scale, UpRule
from services.job.bounded_yaml import parse_yaml

SCENES = 64

HEAD = """\
# A dataset of your own meshes: {objects} in {categories}, from {folder}
# Written by `verso init`. What it guessed is said beside each key: look at the pictures{sheet}, and change what is wrong.
#
#   verso run {job} --scenes 8        a first look, then
#   verso run {job} --scenes 10000    goes on from there
#
# Every key that is not here has the default that docs/job.md tells.

verso: 1
name: {name}

# Everything that is drawn follows from this number and a scene's id.
seed: 1
scenes: {scenes}

# How often each is drawn: equal weights. A weight of 2 makes a category twice as frequent.
categories:
{weights}

assets:
  objects:
{sources}
  # What they stand on: tables made from a seed.
  tables:
    - source: procedural

start:
  # upright: as it stands in the pictures, at any yaw; tumbled: dropped in any rotation.
  pose: upright
"""

SOURCE = """\
    - source: urdf # a folder of meshes or URDFs
      folder: {folder}
      weight: {weight} # its number of files

      # {scale_why}.
      # Objects keep their own size; in place of that, `diagonal_m: 0.25` makes each as large as the article's objects are,
      # for which the cameras stand where they do. Or move them: cameras.orbit.radius_m and cameras.mirror.T_z_m.
{scale}

      # Which axis of the files points up.
{up}

      # Category by file pattern; the first match wins. Rename them as you like, and the keys of `categories` with them.
      category_map:
{category_map}

      # State the licence of the shapes; with `copy_assets: true` the dataset holds the shapes too.
      licence: unknown
      copy_assets: false
"""


def write_job(
    name: str,
    job: str,
    folder: str,
    sheet: str | None,
    counts: Mapping[str, int],
    suffix_counts: Mapping[str, int],
    guess: Guess,
) -> str:
    """The text of the job file.

    name: of the dataset; job: what the file will be called; folder: as the job file names it; counts: files by category;
    suffix_counts: files by the end of their names, in small letters.
    """
    several = len(guess.scales) > 1
    sources = [
        _source(folder, scale, guess, sum(suffix_counts[suffix] for suffix in scale.suffixes), several)
        for scale in guess.scales
    ]
    total, kinds = sum(counts.values()), len(counts)
    return HEAD.format(
        objects=f"{total} object{'s' * (total != 1)}",
        categories=f"{kinds} categor{'ies' if kinds != 1 else 'y'}",
        folder=_comment(folder),
        sheet=f" ({_comment(sheet)})" if sheet else "",
        job=_comment(job),
        name=name,
        scenes=SCENES,
        weights="\n".join(
            f"  {_quoted(category)}: 1 # {count} file{'s' * (count != 1)}" for category, count in sorted(counts.items())
        ),
        sources="\n".join(sources),
    )


def _source(folder: str, scale: Scale, guess: Guess, count: int, several: bool) -> str:
    ours = [(p, c) for p, c in guess.category_map.items() if not several or _suffix_of(p) in scale.suffixes]
    ups = [rule for rule in guess.ups if not several or _suffix_of(rule.pattern) in scale.suffixes]
    size = f"      scale: {scale.factor:g}" + (f"\n      diagonal_m: {scale.diagonal_m:g}" if scale.diagonal_m else "")
    return SOURCE.format(
        folder=_quoted(folder),
        weight=count,
        scale_why=_comment(scale.why),
        scale=size,
        up=_up(ups),
        category_map="\n".join(f"        {_quoted(pattern)}: {_quoted(category)}" for pattern, category in ours),
    )


def _up(rules: Sequence[UpRule]) -> str:
    axis = plain_axis(rules)
    if axis is not None:
        reasons = "\n".join(f"      # {_comment(rule.pattern)}: {_comment(rule.why)}." for rule in rules)
        return f"{reasons}\n      up: {axis}"
    lines = [f"        # {_comment(rule.why)}\n        {_quoted(rule.pattern)}: {rule.axis}" for rule in rules]
    return "\n".join(["      up: # by file pattern; the first match wins", *lines])


def _suffix_of(pattern: str) -> str:
    """The end of the names that a pattern finds: its own, in small letters."""
    return pattern[pattern.rfind(".") :].lower()


def _quoted(text: str) -> str:
    """Text as YAML has it between double quotes; plain where nothing in it could be misread, as `no` and `0_1` are."""
    plain = re.fullmatch(r"[\w/.][\w/.-]*", text, re.ASCII) and parse_yaml(text) == text
    return text if plain else json.dumps(text, ensure_ascii=False)


def _comment(text: str) -> str:
    return "".join(c if c.isprintable() else "?" for c in text)
