"""Studies of accuracy against time: rows that were made up, and the studies that are kept in docs/tradeoff."""

import json
from functools import cache
from pathlib import Path

from schemas.job.job import JobKind
from services.study.model import Figure, Proof, Row, Setting, Study

EVIDENCE = Path(__file__).resolve().parents[3] / "docs" / "tradeoff"


PROOF = Proof("step=60", 80, {"depth_mm": 0.1}, {"depth_mm": Figure(0.09, 0.08, 0.1, 0.08, 0.1, 80)}, {})
"""A recommendation that held, of an error that the setting did not measure itself."""


def row(
    name: str = "", ratio: float = 1.0, noise: float = 0.02, failed: float = 0.0, scenes: int = 48, **errors: float
) -> Row:
    """`row("step=240, tier=flat", 0.8, depth_mm=0.1)`; without a name the job itself. Intervals are 10 % to each side."""
    parts = tuple((part.split("=")[0], part.split("=")[1]) for part in name.split(", ")) if name else ()
    setting = Setting(parts, {f"made.{knob}": label for knob, label in parts})
    figures = {error: Figure(value, *(value * 0.9, value * 1.1) * 2, scenes) for error, value in errors.items()}
    noise = noise if parts else 0.0
    return Row(setting, 118.0 * ratio, ratio, ratio * (1 - noise), ratio * (1 + noise), 235.0, figures, failed)


def study(*rows: Row, job_scenes: int = 64, notes: tuple[str, ...] = ()) -> Study:
    machine = {"cpu": "A made-up processor", "cores": 2, "gl_renderer": "llvmpipe", "versions": {"numpy": "2.4.6"}}
    command = "verso tradeoff deploy/jobs/tabletop.yaml --out data/tradeoff"
    doubts, spent = ("whether step=30 (4 scenes)",), (900.0, 871.5)
    about = ("tabletop", command, machine, 48, rows, job_scenes, notes)
    return Study(*about, *spent, "Use step=60.", "step=60", doubts, (PROOF,))


def read_study(folder: Path) -> Study:
    """What `write_study` was given; a tuple among the values of changes or machine comes back as a list."""
    tree = json.loads((folder / "study.json").read_text(encoding="utf-8"))
    assert tree.pop("verso_study") == 2
    tuples = {name: tuple(tree[name]) for name in ("notes", "doubts")}
    proofs = tuple(map(_proof, tree["proofs"]))
    return Study(**(tree | tuples | {"rows": tuple(map(_row, tree["rows"])), "proofs": proofs}))


def _proof(tree: dict) -> Proof:
    figures = {side: {name: Figure(**one) for name, one in tree[side].items()} for side in ("measured", "promised")}
    return Proof(**(tree | figures))


def _row(tree: dict) -> Row:
    setting = Setting(tuple((knob, label) for knob, label in tree["setting"]["parts"]), tree["setting"]["changes"])
    errors = {name: Figure(**figure) for name, figure in tree["errors"].items()}
    return Row(**(tree | {"setting": setting, "errors": errors, "notes": tuple(tree["notes"])}))


@cache
def stored(kind: JobKind = "singles") -> Study:
    """The study of docs/tradeoff of this kind of job, as measured."""
    return read_study(EVIDENCE / kind)
