"""`verso init` and its options."""

from typing import Final

from services.cli.arguments import read_path
from services.cli.command import Command, option

INIT: Final = Command(
    "write a job file for a folder of your own meshes, with pictures of what was read",
    "~/my_meshes --out my_meshes.yaml",
    (
        option("folder", type=read_path, metavar="FOLDER"),
        option("--out", type=read_path, metavar="JOB.yaml", help="default: the folder's name, here; never overwritten"),
        option("--sheet", type=read_path, metavar="FILE", help="the pictures, .jpg or .png (default: beside the job)"),
        option(
            "--category-from",
            metavar="folder|file|NAME",
            help="name categories after the first folder, or after the file without its number, or call all NAME "
            "(default: folder, and file where there is none)",
        ),
    ),
    "services.init.command:main",
)
