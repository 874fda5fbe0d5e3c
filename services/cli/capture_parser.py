"""The commands of `verso capture` and their options, as one table."""

from typing import Final

from services.cli.arguments import read_index, read_path
from services.cli.command import Command, number, option

FOLDER: Final = option("folder", type=read_path, metavar="DIR", help="folder of the capture")
BOARD: Final = option(
    "--board", type=read_path, metavar="board.json", help="the board's sizes and dictionary (default: 7 x 5 of 60 mm)"
)
CATEGORY_HELP: Final = "folder that the capture has in a dataset"
SET: Final = option(
    "--set",
    action="append",
    default=[],
    metavar="KEY=VALUE",
    dest="changes",
    help="change a key of a job file, for example captures.fusion.voxel_m=0.001 (docs/job.md)",
)

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
"""In the order of `verso capture --help`."""
