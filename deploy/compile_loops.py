"""Makes some scenes in memory while the image is built, so that their compiled loops lie beside the code.

A container that starts from the image reads them there (workers/geometry/jit.py), if its processor has x86-64-v3.
"""

from pathlib import Path

from services.job.read import load_job
from workers.assets.catalogue import open_catalogue
from workers.pipeline.context import open_worker
from workers.pipeline.run_shard import run_scene
from workers.pipeline.stopwatch import Stopwatch

JOBS = Path(__file__).parent / "jobs"

SCENES = {"tabletop.yaml": 24, "pile.yaml": 1}
"""Scenes of each job, all of them checked by casting rays: enough of them that few loops are left."""


def compile_loops() -> None:
    """Make the scenes and keep nothing but what was compiled for them."""
    for name, scenes in SCENES.items():
        job = load_job(JOBS / name, ["check.raycast_share=1"])
        context = open_worker(job, open_catalogue(job.assets, JOBS, tuple(job.categories)))
        outputs = [run_scene(context, job.first_scene + number, Stopwatch()) for number in range(scenes)]
        print(f"{name}: {sum(bool(output.files) for output in outputs)} of {scenes} scenes made")


if __name__ == "__main__":
    compile_loops()
