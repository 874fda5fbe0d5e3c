"""The commands and their options, as one table. Handlers are named and not imported, so that `--help` loads nothing heavy."""

from pathlib import Path
from typing import Final

from services.cli.arguments import (
    Command,
    number,
    option,
    read_address,
    read_count,
    read_counts,
    read_host,
    read_http,
    read_index,
    read_job,
    read_job_id,
    read_listener,
    read_path,
    read_place,
    read_port,
    read_priority,
    read_span,
)
from services.export.table import FORMATS

"""Those of services/export/formats.py, which a test compares."""

KEPT: Final = "what is committed is kept, the same command goes on from there"

JSON = option("--json", action="store_true", help="print one JSON object as the last line of standard output")
JOB = option("job", type=read_job, metavar="JOB.yaml")
OUT = option("out", type=read_place, metavar="OUT")
SCENE = option("scene", type=read_index, metavar="SCENE")
SET = option(
    "--set",
    action="append",
    default=[],
    metavar="KEY=VALUE",
    dest="changes",
    help="change a key of the job, for example physics.step_hz=480 (docs/job.md)",
)

FOLDER: Final = option("folder", type=read_path, metavar="DIR", help="folder of the capture")
BOARD: Final = option(
    "--board", type=read_path, metavar="board.json", help="the board's sizes and dictionary (default: 7 x 5 of 60 mm)"
)
CATEGORY_HELP: Final = "folder that the capture has in a dataset"

CAPTURE_COMMANDS: Final[dict[str, Command]] = {
    "board": Command(
        "write the marker board for printing, at true scale and with a ruler to check the print",
        "board.pdf --tiles a4",
        (
            option("file", type=read_path, metavar="FILE.pdf", help="or FILE.png, for a printer's shop"),
            option("--tiles", choices=("a4",), help="several sheets to glue together instead of one large one"),
            BOARD,
            number("--dpi", "resolution of a PNG, dots an inch (default: 300)", 300),
        ),
        "services.capture:board",
    ),
    "simulate": Command(
        "make a virtual capture with known truth",
        "--out data/mug --views 40 --category mug --set captures.simulate.depth_noise.times=1",
        (
            option("--out", type=read_path, required=True, metavar="DIR", help="folder of the capture, new or empty"),
            number("--views", "viewpoints (default: captures.simulate.views, 40)"),
            option("--seed", type=read_index, metavar="N", default=0, help="seed of all that is random (default: 0)"),
            option("--category", default="mug", metavar="NAME", help="what is captured (default: mug)"),
            SET,
        ),
        "services.capture:simulate",
    ),
    "import": Command(
        "make a capture from an Azure Kinect recording, without its SDK",
        "recording.mkv --out data/mug --frames 40 --board board.json --name mug-1 --category mug",
        (
            option("recording", type=read_path, metavar="RECORDING.mkv"),
            option("--out", type=read_path, required=True, metavar="DIR", help="folder of the capture, new or empty"),
            number("--frames", "frames that are kept, chosen by sharpness and movement (default: 40)", 40),
            BOARD,
            option("--name", metavar="NAME", help="of the object (default: the name of DIR)"),
            option("--category", default="object", metavar="NAME", help=f"{CATEGORY_HELP} (default: object)"),
        ),
        "services.capture:import_recording",
    ),
    "process": Command(
        "estimate the camera poses of a capture, and merge its views into a cloud and a mesh",
        "data/mug --estimate joint",
        (
            FOLDER,
            option(
                "--estimate",
                choices=("markers", "article", "joint"),
                help="what the cloud is made with (default: captures.estimation.estimate, joint); all three are reported",
            ),
            SET,
        ),
        "services.capture:process",
    ),
    "synthesize": Command(
        "make RGB, depth and mask of a processed capture from other poses",
        "data/mug --pose pose.txt --out data/mug/views",
        (
            FOLDER,
            option("--out", type=read_path, metavar="DIR", help="where the views go (default: DIR/views)"),
        ),
        "services.capture:synthesize",
        one_of=(
            option("--pose", type=read_path, metavar="FILE", help="T_board_cam, 4 lines of 4 numbers"),
            option("--mirror", action="store_true", help="the mirror view of every captured view"),
        ),
    ),
    "evaluate": Command(
        "score a processed capture against its truth or a given mesh",
        "data/mug --json",
        (FOLDER, option("--mesh", type=read_path, metavar="FILE", help="the object's mesh, metres, in its own frame")),
        "services.capture:evaluate",
    ),
}


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
        "services.cli.commands:report",
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
        "services.cli.commands:serve",
    ),
}


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

COMMANDS: dict[str, Command] = {
    "init": Command(
        "write a job file for a folder of your own meshes, with pictures of what was read",
        "~/my_meshes --out my_meshes.yaml",
        (
            option("folder", type=read_path, metavar="FOLDER"),
            option(
                "--out", type=read_path, metavar="JOB.yaml", help="default: the folder's name, here; never overwritten"
            ),
            option(
                "--sheet", type=read_path, metavar="FILE", help="the pictures, .jpg or .png (default: beside the job)"
            ),
            option(
                "--category-from",
                metavar="folder|file|NAME",
                help="name categories after the first folder, or after the file without its number, or call all NAME "
                "(default: folder, and file where there is none)",
            ),
        ),
        "services.init.command:main",
    ),
    "run": Command(
        "make a dataset, or go on where it stopped",
        "deploy/jobs/tabletop.yaml --scenes 128 --set start.pose=tumbled",
        (
            JOB,
            option("--out", type=read_place, metavar="DIR", help="output folder (default: data/<job name>)"),
            number("--scenes", "how many scenes; more than before extends the dataset"),
            option("--first-scene", type=read_index, metavar="N", help="id of the first scene"),
            number("--workers", "default: the cores this container may use, or the cluster's"),
            number("--shard-size", "scenes in a Ray task, rounded up to whole ranges"),
            option(
                "--address",
                type=read_address,
                metavar="HOST:PORT",
                help="a Ray cluster that runs already (default: a private Ray here)",
            ),
            SET,
            option(
                "--metrics",
                type=read_listener,
                metavar="HOST:PORT",
                help="serve what the run counts to Prometheus there (default: not at all)",
            ),
            option("--dry-run", action="store_true", help="check everything and say what would be done"),
            option(
                "--retry-failed", action="store_true", help="try scenes again that failed for environmental reasons"
            ),
        ),
        starts_ray=lambda options: not options.dry_run,
        kept=KEPT,
        quiet=True,
    ),
    "pack": Command(
        "print a job file as one word that no shell changes, to give it to a cluster in place of the file",
        "deploy/jobs/tabletop.yaml",
        (option("job", type=read_path, metavar="JOB.yaml"),),
    ),
    "status": Command("scenes done, failed and missing; rate; what is running", "data/tabletop", (OUT,)),
    "verify": Command(
        "read every file back and derive the labels again",
        "data/tabletop --independent 16",
        (
            OUT,
            number(
                "--audit",
                "also make N scenes again with the effects that were left out, to prove that they did not matter",
            ),
            number(
                "--independent",
                "also derive the labels of N scenes from the article's definitions, by code that shares nothing with what "
                "made them",
            ),
        ),
    ),
    "query": Command(
        "SQL over the manifests, also while the job runs",
        'data/tabletop "select category, count(*) from scenes group by category"',
        (
            OUT,
            option("sql", metavar="SQL"),
            option("--format", choices=("table", "csv", "parquet", "json"), default="table"),
        ),
    ),
    "columns": Command(
        "every column of the tables, with type, unit, frame and meaning",
        "views",
        (option("table", metavar="TABLE", nargs="?", help="scenes, views, objects, ... (default: all)"),),
    ),
    "replay": Command(
        "make one scene again and compare it with what is stored, or put back what was lost",
        "data/tabletop 17",
        (
            OUT,
            option("scene", type=read_index, metavar="SCENE", nargs="*"),
            option(
                "--repair",
                action="store_true",
                help="put back what is missing or damaged (with SCENEs: in their ranges) where it comes out as it was",
            ),
        ),
    ),
    **REPORT_COMMANDS,
    "export": Command(
        "write the dataset in a layout that other people's loaders read",
        "data/tabletop data/recon --format mirror-recon --category mug",
        (
            OUT,
            option("dir", type=read_place, metavar="DIR", help="a new or an empty folder, or one to go on in"),
            option("--format", choices=tuple(FORMATS), required=True, help="docs/export.md describes each"),
            option(
                "--category", action="append", default=[], metavar="NAME", help="only scenes of it; may be repeated"
            ),
            option(
                "--scenes", type=read_span, metavar="FIRST-LAST", help="only scenes with these ids; one id is one scene"
            ),
            option("--where", metavar="SQL", help="only scenes for which this holds, such as 'support_margin_mm > 5'"),
            option(
                "--shard-mb",
                type=read_count,
                metavar="N",
                default=256,
                help="size of a file of webdataset and huggingface, 10^6 bytes (default: 256)",
            ),
        ),
        "services.export.export:main",
    ),
    "capture": Command(
        "real photographs of an object on a marker board: print a board, simulate, import, process, make views, score",
        "process data/mug",
        commands=CAPTURE_COMMANDS,
    ),
    **QUEUE_COMMANDS,
    "test": Command(
        "style, types, layer rules and tests of a checkout; says what was skipped, and why",
        "tests/hard_cases --figures f.json",
        (
            option("paths", nargs="*", metavar="PATH", help="only the tests in this file, folder or FILE::TEST"),
            option("--ci", action="store_true", help="also what takes a minute, and what needs root or Docker"),
            option("--all", action="store_true", help="also that, and what takes minutes"),
            option("--figures", type=read_path, metavar="FILE", help="write what the tests measured there, as JSON"),
            option("-k", metavar="EXPR", help="only tests whose name matches, as in pytest"),
        ),
    ),
    **STUDY_COMMANDS,
    "doctor": Command("what this machine has, and what is missing", "", (), "services.cli.doctor:main"),
    "completion": Command(
        'print what completes commands and options in a shell: eval "$(verso completion bash)"',
        "bash",
        (option("shell", choices=("bash", "zsh", "tcsh")),),
        "services.cli.reference:main",
    ),
    "extra": Command(
        "install what only some commands need: Mitsuba, MuJoCo as a referee, or the plots of studies",
        "pathtraced",
        (option("name", choices=("pathtraced", "audit", "study")),),
        "services.cli.commands:extra",
    ),
    "lock": Command(
        "make the lock files of a checkout anew, with the newest versions that pyproject.toml allows",
        "",
        (),
        "services.cli.commands:lock",
    ),
}
"""In the order of `verso --help`."""
