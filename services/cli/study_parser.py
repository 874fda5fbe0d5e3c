"""The commands that measure: how long scenes take, and what accuracy costs."""

from pathlib import Path

from services.cli.arguments import read_counts, read_path
from services.cli.command import JOB, SET, Command, number, option

STUDY_COMMANDS: dict[str, Command] = {
    "bench": Command(
        "time by stage on one core, beside the script that people write today and the least that is possible",
        "deploy/jobs/tabletop.yaml --scenes 64 --memory 2000 --workers 2",
        (
            option("job", type=read_path, metavar="JOB.yaml", nargs="?", help="default: a job of built-in shapes"),
            number("--scenes", "how many scenes each side makes", 80),
            option(
                "--folder",
                type=read_path,
                metavar="DIR",
                default=Path("data"),
                help="on the disk to measure (default: data)",
            ),
            number("--memory", "also watch one worker's memory over N scenes"),
            number("--workers", "also compare N workers with one, beside N plain processes"),
            number("--scaling-scenes", "how many scenes that comparison makes", 512),
            SET,
            option(
                "--nodes",
                type=read_counts,
                metavar="N,N,...",
                help="measure the coordinator instead, on so many simulated nodes whose scenes only take their time",
            ),
            number(
                "--effects",
                "time settling instead: N scenes by their plan of effects, and with every effect of physics forced",
            ),
        ),
        "services.bench.command:main",
        starts_ray=lambda options: options.workers is not None or options.nodes is not None,
        kept="no figures are kept",
    ),
    "tradeoff": Command(
        "what accuracy costs in time, measured on the job's own scenes",
        "deploy/jobs/tabletop.yaml --out data/tradeoff --target penetration_mm=0.1,depth_mm=0.5",
        (
            JOB,
            option("--out", type=read_path, required=True, metavar="DIR", help="goes on there where it stopped"),
            option(
                "--target",
                metavar="ERROR=MOST,...",
                help="write DIR/job.yaml: the job with the cheapest setting that keeps these errors",
            ),
            option("--knobs", metavar="NAME,...", help="default: all that are known"),
            number("--scenes", "scenes with images (default: 48)", 48),
            number("--physics-scenes", "scenes that only come to rest (default: 500)", 500),
            number("--laps", "rounds of timing (default: 3)", 3),
            number("--workers", "default: the cores this container may use"),
            SET,
        ),
        "services.study.command:main",
    ),
}
"""In the order of `verso --help`."""
