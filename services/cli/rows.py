"""The commands and their options, as one table. Handlers are named and not imported, so that `--help` loads nothing heavy."""

from pathlib import Path
from typing import Final

from services.cli import arguments as read
from services.cli.arguments import Command, choice, command, flag, number, option, path
from services.export.table import FORMATS

KEPT: Final = "what is committed is kept, the same command goes on from there"

JSON = flag("--json", "print one JSON object as the last line of standard output")
JOB = option("job", "JOB.yaml", kind=read.read_job)
OUT = option("out", "OUT", kind=read.read_place)
FOLLOWED = option("out", "OUT", "may be made later", read.read_place)
OUT_DIR = option("--out", "DIR", "output folder (default: data/<job name>)", read.read_place)
NEW_DIR = path("--out", "DIR", "folder of the capture, new or empty", required=True)
FOLDER = path("folder", "DIR", "folder of the capture")
BOARD = path("--board", "board.json", "the board's sizes and dictionary (default: 7 x 5 of 60 mm)")
MESHES = path("folder", "FOLDER")
PREDICTIONS = path(
    "predictions", "PREDICTIONS", "depth/ID.png|npy, rgb/ID.png, shape/ID.glb, ..., poses.csv", nargs="?"
)
READ_AS = (
    choice("--split", ("all", "train", "val", "test", "unseen"), "scenes whose objects all are of it", default="all"),
    choice("--level", ("all", "1", "2", "3", "4"), "scenes of a level of docs/benchmark.md", default="all"),
    choice("--frame", ("object", "camera", "input", "world"), "of shapes; `input`: of poses too", default="object"),
    choice(
        "--volume", ("auto", "occupancy", "logits", "sdf", "sdf-positive-inside"), "what values are", default="auto"
    ),
)
"""Of predictions: which, and how they are read."""
SCORES = path("--compare", "DIR", "which of two scores is better, A B", nargs=2)
THERE: Final = (OUT, FOLDER, MESHES, PREDICTIONS, SCORES)
"""Arguments that name folders which have to be there."""
MORE_SCENES = number("--scenes", "how many scenes; more than before extends the dataset")
PICTURES = number("--scenes", "scenes with pictures, equally many of each category (default: 24)", 24)
RETRY = flag("--retry-failed", "try scenes again that failed for environmental reasons")
SET_HELP = "change a key of the job, for example physics.step_hz=480 (docs/job.md)"
SET = option("--set", "KEY=VALUE", SET_HELP, action="append", default=[], dest="changes")

CAPTURE_COMMANDS: Final[dict[str, Command]] = {
    "board": command(
        "print a marker board at true scale, with a ruler to check it, or describe one you have",
        "board.pdf --tiles a4",
        path(
            "file",
            "FILE.pdf",
            "or FILE.png, for a printer's shop; FILE.json: the description alone, of a board you have",
        ),
        choice("--tiles", ("a4",), "several sheets to glue together instead of one large one"),
        BOARD,
        path(
            "--from", "FILE", "board of another program: Kalibr, apriltag_ros, ArUco's marker map, OpenCV", dest="other"
        ),
        path("--solve", "DIR", "photographs, with camera.json, of tags that nobody measured: needs --marker"),
        choice("--kind", ("grid", "charuco", "charuco_old", "aprilgrid"), "what is made of the next four options"),
        option("--size", "8x6", "markers, of a charuco squares, across and up", read.read_size),
        option("--marker", "M", "side of a marker, metres", read.read_length),
        option(
            "--pitch", "M", "from a marker to the next, of a charuco the side of a square, metres", read.read_length
        ),
        option("--dictionary", "NAME", "of OpenCV (default: DICT_4X4_50; of an aprilgrid DICT_APRILTAG_36h11)"),
        number("--dpi", "resolution of a PNG, dots an inch (default: 300)", 300),
        handler="capture:board",
    ),
    "simulate": command(
        "make a virtual capture with known truth",
        "--out data/mug --views 40 --category mug --set captures.simulate.depth_noise.times=1",
        NEW_DIR,
        number("--views", "viewpoints (default: captures.simulate.views, 40)"),
        option("--seed", "N", "seed of all that is random (default: 0)", read.read_index, default=0),
        option("--category", "NAME", "what is captured (default: mug)", default="mug"),
        SET,
        handler="capture:simulate",
    ),
    "import": command(
        "make a capture from a recording of an RGB-D camera, without its SDK",
        "recording.mkv --out data/mug-1 --frames 40 --board board.json --name mug-1 --category mug",
        path(
            "recording",
            "RECORDING",
            "a file or folder: .mkv, .bag, .db3, .mcap, .r3d, TUM, BOP, Open3D, Polycam, ARKitScenes",
        ),
        NEW_DIR,
        number("--frames", "frames that are kept, chosen by sharpness and movement (default: 40)", 40),
        path("--camera", "camera.json", "the colour camera (docs/captures.md), in place of what the recording says"),
        BOARD,
        option("--name", "NAME", "of the object (default: the name of DIR)"),
        option("--category", "NAME", "folder that the capture has in a dataset (default: object)", default="object"),
        handler="capture:import_recording",
    ),
    "process": command(
        "estimate the camera poses of a capture, and merge its views into a cloud and a mesh",
        "data/mug --estimate joint",
        FOLDER,
        choice(
            "--estimate",
            ("markers", "article", "joint"),
            "what the cloud is made with (default: captures.estimation.estimate, joint); all three are reported",
        ),
        flag("--calibrate", "take the camera from the markers where camera.json does not fit them"),
        SET,
        handler="capture:process",
    ),
    "synthesize": command(
        "make RGB, depth and mask of a processed capture from other poses",
        "data/mug --pose data/mug/board_00000.txt --out data/mug/views",
        *(FOLDER, path("--out", "DIR", "where the views go (default: DIR/views)")),
        handler="capture:synthesize",
        one_of=(
            path("--pose", "FILE", "T_board_cam, 4 lines of 4 numbers"),
            flag("--mirror", "the mirror view of every captured view"),
        ),
    ),
    "evaluate": command(
        "score a processed capture against its truth or a given mesh",
        "data/mug --json",
        *(FOLDER, path("--mesh", "FILE", "the object's mesh, metres, any axis up")),
        handler="capture:evaluate",
    ),
}

REPORT_COMMANDS: Final[dict[str, Command]] = {
    "report": command(
        "a dataset as one HTML page to look at",
        "data/tabletop --out tabletop.html",
        OUT,
        path("--out", "FILE.html", "the page to write (default: OUT-report.html, beside the dataset)", dest="file"),
        PICTURES,
    ),
    "serve": command(
        "the same page live while a job runs; read-only",
        "data/tabletop --port 8722",
        FOLLOWED,
        option("--port", "N", "default: 8722; 0: any that is free", read.read_port, default=8722),
        option(
            "--host",
            "ADDR",
            "listen there (default: 127.0.0.1, this machine alone); where others can reach it, a token is needed",
            read.read_host,
            default="127.0.0.1",
        ),
        option(
            "--token",
            "T|auto",
            "answer only who has it: at least 16 characters, or `auto` for a random one, printed in the address",
        ),
        PICTURES,
    ),
}

STUDY_COMMANDS: Final[dict[str, Command]] = {
    "bench": command(
        "time by stage, beside a straightforward script and a lower bound",
        "deploy/jobs/tabletop.yaml --scenes 64 --workers 2",
        path("job", "JOB.yaml", "default: a job of built-in shapes", nargs="?"),
        number("--scenes", "how many scenes each side makes", 80),
        path("--folder", "DIR", "on the disk to measure (default: data)", default=Path("data")),
        number("--workers", "also compare N workers with one, beside N plain processes"),
        number("--scaling-scenes", "how many scenes that comparison makes", 512),
        SET,
        handler="bench.command:main",
        starts_ray=lambda options: options.workers is not None,
        kept="no figures are kept",
    ),
    "tradeoff": command(
        "what accuracy costs in time, measured on the job's own scenes",
        "deploy/jobs/tabletop.yaml --out data/tradeoff --target penetration_mm=0.1,depth_mm=0.5",
        JOB,
        path("--out", "DIR", "goes on there where it stopped", required=True),
        option(
            "--target",
            "ERROR=MOST,...",
            "write DIR/job.yaml: the job with the cheapest setting that keeps these errors",
        ),
        option("--knobs", "NAME,...", "default: all that are known"),
        option("--budget", "TIME", "such as 90s, 15m or 2h (default: 15m)", read.read_duration, default=900.0),
        number("--workers", "default: the cores this container may use"),
        SET,
        handler="study.command:main",
    ),
}

DASHBOARD: Final = "http://127.0.0.1:8265"
"""Where Ray's job API answers by default."""

QUEUE_HELP = "the queue: a folder that all hosts see, or a bucket (default: $VERSO_QUEUE)"
QUEUE = option("--queue", "URL", QUEUE_HELP, read.read_place)
ADDRESS_HELP = f"Ray's job API (default: {DASHBOARD}); a token is taken from RAY_AUTH_MODE and RAY_AUTH_TOKEN"
ADDRESS = option("--address", "HTTP", ADDRESS_HELP, read.read_http)

OWN_RAY: Final = "own"
"""The address that means a private Ray, which ends with the supervisor."""

SUPERVISED_HELP = (
    f"{ADDRESS_HELP}; `{OWN_RAY}`, or where nothing answers there: a private Ray, which ends with this command"
)
SUPERVISED = option(
    "--address", "HTTP", SUPERVISED_HELP, lambda text: text if text == OWN_RAY else read.read_http(text)
)
ID = option("id", "ID", kind=read.read_job_id)

QUEUE_COMMANDS: Final[dict[str, Command]] = {
    "submit": command(
        "put a job into the queue, and print its id",
        "deploy/jobs/tabletop.yaml --queue /shared/queue --out /shared/tabletop --priority 5",
        JOB,
        QUEUE,
        OUT_DIR,
        option("--priority", "N", "-1000 to 1000; higher ones first (default: 0)", read.read_priority, default=0),
        MORE_SCENES,
        SET,
        RETRY,
        handler="cli.queue_commands:submit",
    ),
    "jobs": command(
        "the jobs of the queue, and how far they are",
        "--queue /shared/queue --json",
        QUEUE,
        handler="cli.queue_commands:jobs",
    ),
    "logs": command(
        "what a job wrote, also after the cluster is gone",
        "j0a1b2c3d --queue /shared/queue --follow",
        *(ID, QUEUE, ADDRESS, flag("--follow", "go on until the job has ended")),
        handler="cli.queue_commands:logs",
    ),
    "cancel": command(
        "end a job of the queue; what it committed is kept",
        "j0a1b2c3d --queue /shared/queue",
        *(ID, QUEUE),
        handler="cli.queue_commands:cancel",
    ),
    "supervise": command(
        "start the queue's jobs on a cluster or here, and again where they died",
        "--queue /shared/queue --at-once 2",
        QUEUE,
        SUPERVISED,
        flag("--until-empty", "end when every job has; exit code 1 where one failed"),
        number("--at-once", "jobs that run at once, and share the cluster evenly (default: 2)", 2),
        path(
            "--driver",
            "PROGRAM",
            "the program `verso` on the cluster's head (default: this one where HTTP is on this machine, else verso)",
        ),
        handler="cli.queue_commands:supervise",
        starts_ray=lambda options: options.address in (None, OWN_RAY),
        kept="what is committed is kept, the next `verso supervise` starts the jobs again",
        quiet=True,
    ),
    "drive": command(
        "one attempt at a job of the queue, as `supervise` has it started on the cluster's head",
        "j0a1b2c3d 1 --queue /shared/queue",
        *(ID, option("attempt", "ATTEMPT", kind=read.read_count), QUEUE),
        handler="cli.queue_commands:drive",
        starts_ray=lambda options: True,
        kept="what is committed is kept, the queue's supervisor starts the job again",
        quiet=True,
    ),
}

COMMANDS: Final[dict[str, Command]] = {
    "init": command(
        "make a library of a folder of your own meshes: clean metric shapes, a table, pictures, and the job that uses it",
        "~/my_meshes --out my_library",
        MESHES,
        path(
            "--out",
            "LIBRARY",
            "default: the folder's name with _library, here; one that is there is brought up to date",
        ),
        option(
            "--category-from",
            "folder|parent|file|NAME",
            "name categories after the first folder that not all share, the folder that a file lies in, or the file without "
            "its number, or call all NAME (default: the folder that holds one object or several of a kind)",
        ),
        option(
            "--unit",
            "[PATTERN=]METRES",
            "of all files, or of those whose path fits, such as 0.001 for millimetres; the last counts (default: a guess)",
            read.read_unit,
            action="append",
            default=[],
        ),
        choice("--up", ("x", "y", "z"), "the axis that points up in all files (default: a guess)"),
        option("--licence", "TEXT", "of the shapes (default: the nearest licence file)"),
        choice("--scene", ("tabletop", "studio"), "of the job: objects on a table, or each alone", default="tabletop"),
        option(
            "--limit", "NAME=VALUE", "another cap on files, such as max_faces=10000000", action="append", default=[]
        ),
        handler="init.command:main",
    ),
    "run": command(
        "make a dataset, or go on where it stopped",
        "deploy/jobs/tabletop.yaml --out data/tumbled --scenes 128 --set start.pose=tumbled",
        JOB,
        OUT_DIR,
        MORE_SCENES,
        option("--first-scene", "N", "id of the first scene", read.read_index),
        number("--workers", "default: the cores this container may use, or the cluster's"),
        number("--shard-size", "scenes in a Ray task, rounded up to whole ranges"),
        option(
            "--address",
            "HOST:PORT",
            "a Ray cluster that runs already (default: a private Ray here)",
            read.read_address,
        ),
        SET,
        option(
            "--metrics",
            "HOST:PORT",
            "serve what the run counts to Prometheus there (default: not at all)",
            read.read_listener,
        ),
        flag("--dry-run", "check everything and say what would be done"),
        RETRY,
        starts_ray=lambda options: not options.dry_run,
        kept=KEPT,
        quiet=True,
    ),
    "pack": command(
        "print a job file as one word that no shell changes, which a cluster takes in place of the file",
        "deploy/jobs/tabletop.yaml",
        path("job", "JOB.yaml"),
    ),
    "status": command("scenes done, failed and missing; rate; what is running", "data/tabletop", OUT),
    "verify": command(
        "read every file back and derive the labels again",
        "data/tabletop --independent 16",
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
    "query": command(
        "SQL over the manifests, also while the job runs",
        'data/tabletop "select category, count(*) from scenes group by category"',
        *(OUT, option("sql", "SQL"), choice("--format", ("table", "csv", "parquet", "json"), default="table")),
    ),
    "columns": command(
        "every column of the tables, with type, unit, frame and meaning",
        "views",
        option("table", "TABLE", "scenes, views, objects, ... (default: all)", nargs="?"),
    ),
    "replay": command(
        "make one scene again and compare it with what is stored",
        "data/tabletop 17",
        OUT,
        option("scene", "SCENE", kind=read.read_index),
    ),
    **REPORT_COMMANDS,
    "score": command(
        "score predictions of a dataset's other side: depth, RGB, shapes, volumes, poses",
        "data/tabletop predictions",
        OUT,
        PREDICTIONS,
        path("--out", "DIR", "where the score goes (default: PREDICTIONS/score)", dest="score"),
        choice("--align", ("none", "scale", "similarity"), "of depth and shapes with the truth", default="none"),
        *READ_AS,
        flag("--flip", "FLIP of RGB as well (0.7 s an image; needs verso extra study)"),
        SCORES,
        handler="score.command:main",
        kept="what is scored is kept",
    ),
    "score check": command(
        "say whether predictions are whole and can be read, without scoring them",
        "data/tabletop predictions",
        OUT,
        path("predictions", "PREDICTIONS"),
        *READ_AS,
        handler="score.command:check",
    ),
    "score merge": command(
        "make a leaderboard of scores: a table, and who is surely better than whom",
        "data/tabletop predictions/a predictions/b --out data/leaderboard",
        OUT,
        path("runs", "RUN", "folders of predictions that are scored, or of their scores", nargs="+"),
        path("--out", "DIR", "folder of leaderboard.parquet, .md and .tex", dest="target", required=True),
        handler="score.leaderboard:main",
    ),
    "export": command(
        "write the dataset in a layout that other people's loaders read",
        "data/tabletop data/recon --format mirror-recon --category mug",
        OUT,
        option("dir", "DIR", "a new or an empty folder, or one to go on in", read.read_place),
        choice("--format", tuple(FORMATS), "docs/export.md describes each", required=True),
        option("--category", "NAME", "only scenes of it; may be repeated", action="append", default=[]),
        option("--scenes", "FIRST-LAST", "only scenes with these ids; one id is one scene", read.read_span),
        option("--where", "SQL", "only scenes for which this holds, such as 'support_margin_mm > 30'"),
        choice(
            "--split",
            ("category", "instance"),
            "the shares of train, val and test hold in each category (default), or as the column `assets.split` has them",
            default="category",
        ),
        option("--held-out", "CATEGORY", "put all its objects into test; may be repeated", action="append", default=[]),
        number("--shard-mb", "size of a file of webdataset and huggingface, 10^6 bytes (default: 256)", 256),
        number("--points", "also draw N points on each shape, of webdataset and huggingface"),
        handler="export.export:main",
    ),
    "capture": command(
        "real photographs of an object on a marker board",
        "process data/mug",
        commands=CAPTURE_COMMANDS,
    ),
    **QUEUE_COMMANDS,
    "test": command(
        "style, types, layer rules and tests of a checkout; says what was skipped, and why",
        "tests/hard_cases --figures f.json",
        option("paths", "PATH", "only the tests in this file, folder or FILE::TEST", nargs="*"),
        flag("--ci", "also what takes a minute, and what needs root or Docker"),
        flag("--all", "also that, and what takes minutes"),
        path("--figures", "FILE", "write what the tests measured there, as JSON"),
        option("-k", "EXPR", "only tests whose name matches, as in pytest"),
        handler="cli.commands:checkout",
    ),
    **STUDY_COMMANDS,
    "doctor": command("what this machine has, and what is missing", "", handler="cli.doctor:main"),
    "completion": command(
        'print what completes commands and options in a shell: eval "$(verso completion bash)"',
        "bash",
        choice("shell", ("bash", "zsh", "tcsh")),
        handler="cli.reference:main",
    ),
    "extra": command(
        "install what only some commands need: Mitsuba, or the plots of studies",
        "pathtraced",
        choice("name", ("pathtraced", "study")),
    ),
    "lock": command(
        "make the lock files of a checkout anew, with the newest versions that pyproject.toml allows",
        "",
        handler="cli.commands:checkout",
    ),
    "wheels": command(
        "build a checkout's wheels: verso-data, all of it, and verso-read, which reads datasets",
        "dist",
        path("dir", "DIR", "where they go"),
    ),
}
"""In the order of `verso --help`."""
