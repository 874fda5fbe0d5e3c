"""The commands that show a dataset to people, and their options."""

from typing import Final

from services.cli.arguments import read_host, read_path, read_place, read_port
from services.cli.command import OUT, Command, number, option

REPORT_COMMANDS: Final[dict[str, Command]] = {
    "report": Command(
        "a dataset as one HTML page: pictures, point clouds, figures, effects and their cost, failures",
        "data/tabletop --out tabletop.html",
        (
            OUT,
            option(
                "--out",
                type=read_path,
                metavar="FILE.html",
                dest="file",
                help="the page to write (default: OUT-report.html, beside the dataset)",
            ),
            number("--scenes", "scenes with pictures, equally many of each category (default: 24)", 24),
            option(
                "--beside",
                type=read_place,
                metavar="OUT",
                help="another dataset to show at the side of this one: captures beside scenes, say",
            ),
        ),
        "services.cli.report_commands:report",
    ),
    "serve": Command(
        "the same page live while a job runs: progress, rate, latest pictures, failures; read-only",
        "data/tabletop --port 8722",
        (
            OUT,
            option("--port", type=read_port, metavar="N", default=8722, help="default: 8722; 0: any that is free"),
            option(
                "--host",
                type=read_host,
                metavar="ADDR",
                default="127.0.0.1",
                help="listen there (default: 127.0.0.1, this machine alone); where others can reach it, a token is needed",
            ),
            option(
                "--token",
                metavar="T|auto",
                help="answer only who has it: at least 16 characters, or `auto` for a random one, printed in the address",
            ),
            number("--scenes", "scenes with pictures, equally many of each category (default: 24)", 24),
        ),
        "services.cli.report_commands:serve",
    ),
}
