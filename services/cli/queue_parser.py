"""The commands of the job queue and their options, as one table."""

from typing import Final

from services.cli.arguments import read_count, read_http, read_job_id, read_path, read_place, read_priority
from services.cli.command import JOB, SET, Command, number, option

DASHBOARD: Final = "http://127.0.0.1:8265"
"""Where Ray's job API answers by default."""

QUEUE: Final = option(
    "--queue",
    type=read_place,
    metavar="URL",
    help="the queue: a folder that all hosts see, or a bucket (default: $VERSO_QUEUE)",
)
ADDRESS: Final = option(
    "--address",
    type=read_http,
    metavar="HTTP",
    default=DASHBOARD,
    help=f"Ray's job API (default: {DASHBOARD}); a token is taken from RAY_AUTH_MODE and RAY_AUTH_TOKEN",
)
ID: Final = option("id", type=read_job_id, metavar="ID")

QUEUE_COMMANDS: Final[dict[str, Command]] = {
    "submit": Command(
        "put a job into the queue, and print its id",
        "deploy/jobs/tabletop.yaml --queue /shared/queue --out /shared/tabletop --priority 5",
        (
            JOB,
            QUEUE,
            option("--out", type=read_place, metavar="DIR", help="output folder (default: data/<job name>)"),
            option(
                "--priority",
                type=read_priority,
                metavar="N",
                default=0,
                help="-1000 to 1000; higher ones first (default: 0)",
            ),
            number("--scenes", "how many scenes; more than before extends the dataset"),
            SET,
            option(
                "--retry-failed", action="store_true", help="try scenes again that failed for environmental reasons"
            ),
        ),
        "services.cli.queue_commands:submit",
    ),
    "jobs": Command(
        "the jobs of the queue, and how far they are",
        "--queue /shared/queue --json",
        (QUEUE,),
        "services.cli.queue_commands:jobs",
    ),
    "logs": Command(
        "what a job wrote, also after the cluster is gone",
        "j0a1b2c3d --queue /shared/queue --follow",
        (ID, QUEUE, ADDRESS, option("--follow", action="store_true", help="go on until the job has ended")),
        "services.cli.queue_commands:logs",
    ),
    "cancel": Command(
        "end a job of the queue; what it committed is kept",
        "j0a1b2c3d --queue /shared/queue",
        (ID, QUEUE),
        "services.cli.queue_commands:cancel",
    ),
    "supervise": Command(
        "start the queue's jobs on a Ray cluster, and start them again where they died",
        "--queue /shared/queue --at-once 2",
        (
            QUEUE,
            ADDRESS,
            number("--at-once", "jobs that run at once, and share the cluster evenly (default: 2)", 2),
            option(
                "--driver",
                type=read_path,
                metavar="PROGRAM",
                help="the program `verso` on the cluster's head (default: this one where HTTP is on this machine, else verso)",
            ),
        ),
        "services.cli.queue_commands:supervise",
    ),
    "drive": Command(
        "one attempt at a job of the queue, as `supervise` has it started on the cluster's head",
        "j0a1b2c3d 1 --queue /shared/queue",
        (ID, option("attempt", type=read_count, metavar="ATTEMPT"), QUEUE),
        "services.cli.queue_commands:drive",
        starts_ray=lambda options: True,
        kept="what is committed is kept, the queue's supervisor starts the job again",
        quiet=True,
    ),
}
