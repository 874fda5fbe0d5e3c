"""`verso bench`: measures, compares several workers with one, and prints the figures as text and JSON.

Two processes that share nothing but the machine seldom do twice the work of one: cores share caches, memory and clock,
and are often two threads of one core. No scheduler can gain more than plain processes do.
"""

import argparse
import json
import os
import pickle
import shlex
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

from schemas.dataset.commit import Span
from schemas.dataset.shard import ShardOrder
from schemas.errors import InputError, RunError
from schemas.job.job import Job
from schemas.job.physics import ONE_OBJECT
from services.bench.figures import Lap, by_clock, by_processor, slope_ratio, spread_of, summarise_side
from services.bench.measure import WARM_UP, Measured, Part, bench_folder, measure, run_part
from services.bench.script import LOOKS
from services.job.job_file import change_key, load_job, validate_job
from services.run.progress import Tally
from services.run.range_planner import deal_shards, plan_ranges
from services.run.worker_entry import Pattern, terms_of_driver
from workers.assets.catalogue import Catalogue
from workers.capture.results import open_sources
from workers.pool import Ended, Pool
from workers.store.file_system import file_system_of
from workers.store.local import LocalStore

if TYPE_CHECKING:
    from services.run.ray_cluster import Slots


def main(options: argparse.Namespace) -> int:
    """Measure what the options ask for and print it. Raises VersoError if a side cannot run."""
    if options.job is None:
        tree: dict[str, Any] = {"name": "bench"}
        for change in options.changes:
            change_key(tree, change)
        job, job_folder = validate_job(tree, "the default job"), Path()
    else:
        job, job_folder = load_job(options.job, options.changes), options.job.parent
    refuse_unmatched(job)
    with bench_folder(options.folder) as folder:
        figures = {
            "ok": True,
            "command": shlex.join(["verso", *sys.argv[1:]]),
            "job": job.name,
            "file_system": file_system_of(folder),
            **summarise(measure(job, job_folder, folder, options.scenes)),
            "scaling": None,
        }
        if options.workers is not None:
            figures["scaling"] = measure_scaling(job, job_folder, folder, options.workers, options.scaling_scenes)
        # Printed before the folder is deleted, which takes a while on a busy disk.
        print("\n".join(describe(figures)), flush=True)
        if options.json:
            print(json.dumps(figures), flush=True)
    return 0


def refuse_unmatched(job: Job) -> None:
    """Raises InputError for a job whose scenes the script does not make, or that is stored in tars."""
    alone, cameras = job.scene == "studio", job.cameras
    sensors = (cameras.sensor.has_ranges, *(entry.sensor or entry.fov_deg or entry.preset for entry in cameras.more))
    fits = {
        "output.layout: files": job.output.layout == "files",
        "objects_per_scene: 1": job.objects_per_scene == ONE_OBJECT,
        "cameras.depth.enabled: true": alone or cameras.depth.enabled,
        "cameras.mirror.enabled: true": alone or cameras.mirror.enabled,
        "images.projection.enabled: true": alone or job.images.projection.enabled,
        "cameras.mirror.enabled: false": not alone or not cameras.mirror.enabled,
        "cameras.more: []": alone or not cameras.more,
        "one sensor for all cameras": not any(sensors),
        "targets.views: []": alone or not job.targets.views,
        "targets.views: [normals]": not alone or set(job.targets.views) <= {"normals"},
        "render.rgb: true": job.render.rgb,
        "scenes_from: null": job.scenes_from is None,
    }
    if missing := [setting for setting, holds in fits.items() if not holds]:
        raise InputError(f"the benchmark compares whole pairs of one object in files: set {', '.join(missing)}")


# ---------------------------------------------------------------------------------------------- several workers


def measure_scaling(
    job: Job, job_folder: Path, folder: Path, workers: int, scenes: int, rounds: int = 3
) -> dict[str, Any]:
    """One worker, all workers, one process, all processes, and again; always the same scenes, into new folders.

    Ranges and shards are those of a run of that many scenes. Everything is warm before: Ray's start, imports, the OpenGL
    context and its shaders are in no figure. `ray`: workers through the coordinator; `bare`: plain processes, each on a core
    of its own. ray_share: the share of the slots' time without a shard, the uneven end of the last shards included;
    ray_share_one: the same with one worker, which has no such end. share_of_bare: Ray's speed-up over that of plain processes.
    """
    from services.run.ray_cluster import PREFETCH, Slots, private_ray  # loads Ray

    job = job.model_copy(update={"scenes": scenes})
    counts = (1, workers)
    ray: dict[int, list[tuple[Lap, float]]] = {count: [] for count in counts}
    bare: dict[int, list[Lap]] = {count: [] for count in counts}
    catalogue = open_sources(job, job_folder)
    with private_ray(workers), Pool(run_part, processes=workers, quiet=False) as pool:
        runs = _Runs(job, job_folder, folder, catalogue, pool)
        runs.plain("warm", workers, WARM_UP)
        runs.through_ray("warm", Slots(workers, PREFETCH * workers), 4 * workers * job.range_size)
        for number in range(rounds):
            for count in counts:
                # The other slot could start a waiting shard, so one worker gets one shard at a time.
                in_flight = PREFETCH * count if count == workers else count
                ray[count].append(runs.through_ray(f"{number}-{count}", Slots(count, in_flight), scenes))
            for count in counts:
                bare[count].append(runs.plain(f"{number}-{count}", count, max(1, scenes // workers)))
    gain = gain_of(*([lap for lap, _ in ray[count]] for count in counts))
    reference = gain_of(bare[1], bare[workers])
    return {
        "workers": workers,
        "range": job.range_size,
        "ray": gain,
        "bare": reference,
        "ray_share": spread_of([idle for _, idle in ray[workers]]),
        "ray_share_one": spread_of([idle for _, idle in ray[1]]),
        "share_of_bare": gain["speedup"]["median"] / reference["speedup"]["median"],
    }


def gain_of(single: Sequence[Lap], several: Sequence[Lap]) -> dict[str, Any]:
    """The gain of several at once over a single one, from laps in pairs; a lap lasts from the first start to the last end.

    speedup: ratio of the paces; inflation: ratio of the processor time a scene, the cost of sharing caches, memory and clock,
    without waiting.
    """
    return {
        "scenes": several[0].scenes,
        "one_scenes_per_s": median(1.0 / by_clock(lap) for lap in single),
        "all_scenes_per_s": median(1.0 / by_clock(lap) for lap in several),
        "speedup": slope_ratio(single, several),
        "inflation": slope_ratio(several, single, by_processor),
    }


@dataclass(frozen=True)
class _Runs:
    """Runs on a running Ray and in warm plain processes, each into a new folder."""

    job: Job
    job_folder: Path
    folder: Path
    catalogue: Catalogue
    pool: Pool[Part]

    def through_ray(self, name: str, slots: "Slots", count: int) -> tuple[Lap, float]:
        """A lap of that many scenes, and the share of the slots' time without a shard: handed out, or its uneven end."""
        from services.run.coordinator import Coordinator, Limits  # loads Ray

        store = LocalStore(self.folder / name)
        store.prepare()
        size, first = self.job.range_size, self.job.first_scene
        spans = (Span(start=start, stop=stop) for start, stop in plan_ranges(first, first + count, size, []))
        shards = deal_shards(spans, count, size, lambda: slots.running)
        pattern = Pattern(ShardOrder.of(str(store.root), self.job, "bench"), self.catalogue, terms_of_driver())
        tally, begun = Tally(asked=count), time.perf_counter()
        Coordinator(store, pattern, Limits(slots, 1, count), tally).run(shards)
        wall_s = time.perf_counter() - begun
        return Lap(tally.made, wall_s, tally.shard_cpu_s, {}), 1.0 - tally.shard_wall_s / (slots.running * wall_s)

    def plain(self, name: str, count: int, scenes: int) -> Lap:
        """`count` processes, each on a core of its own, make the same first scenes at the same time, until the last one ends."""
        cores, first, laps = sorted(os.sched_getaffinity(0)), self.job.first_scene, []
        span = Span(start=first, stop=first + scenes)
        outs = [self.folder / f"bare{number}" / name for number in range(count)]
        parts = [Part(self.job, self.job_folder, out, span, cores[n % len(cores)]) for n, out in enumerate(outs)]
        for _, answer in self.pool.run(parts):
            if isinstance(answer, Ended):
                raise RunError(f"a plain process of the benchmark {answer.detail}; its last words stand above")
            laps.append(pickle.loads(answer))
        return Lap(sum(lap.scenes for lap in laps), max(lap.wall_s for lap in laps), sum(lap.cpu_s for lap in laps), {})


# ---------------------------------------------------------------------------------------------- the report


def summarise(measured: Measured) -> dict[str, Any]:
    """The figures of the rounds: plain numbers, milliseconds per scene, ratios of slopes.

    A ratio of a look of the script is how many times as many scenes we make in the same time.
    """
    ours, floor = measured.ours, measured.floor
    scenes = sum(lap.scenes for lap in ours)
    return {
        "machine": measured.machine,
        "core": measured.core,
        "scenes": scenes,
        "rounds": len(ours),
        "bytes_per_scene": measured.bytes / scenes,
        "ours": summarise_side(ours),
        "floor": summarise_side(floor),
        "times_floor": slope_ratio(ours, floor),
        "times_floor_cpu": slope_ratio(ours, floor, by_processor),
        "script": {
            look: summarise_side(laps)
            | {"ratio": slope_ratio(laps, ours), "ratio_cpu": slope_ratio(laps, ours, by_processor)}
            for look, laps in measured.script.items()
        },
    }


def describe(figures: Mapping[str, Any]) -> list[str]:
    """The figures as text, line by line."""
    machine, script = figures["machine"], figures["script"]
    lines = [
        f"machine    {machine['usable_cores']} of {machine['cores']} cores, {machine['cpu']}, load {machine['load_1min']:.1f}",
        f"           {machine['gl_renderer']}",
        f"           Python {machine['python']}, " + ", ".join(f"{k} {v}" for k, v in machine["versions"].items()),
        f"command    {figures['command']}",
        f"measured   {figures['scenes']} scenes in {figures['rounds']} rounds, each side in turn on core "
        f"{figures['core']}, a commit a round, {figures['bytes_per_scene'] / 1e3:.0f} kB a scene on {figures['file_system']}",
        "",
        *_table("ours", figures["ours"]),
        *_table("floor: bare passes, the same encoding, durable writes", figures["floor"]),
        f"  before its clock each scene's shapes go to the GPU: {figures['floor']['apart_ms']:.1f} ms a scene",
    ]
    for look, side in script.items():
        lines += _table(f"the script, look {look}: {LOOKS[look]}", side)
        lines.append(f"  before its clock it reads its files: {side['apart_ms']:.1f} ms a scene")
    lines += ["", f"{'as many scenes as':24} {'by the clock':24} by processor time"]
    lines += [f"  {'the script, ' + k:22} {_times(v['ratio']):24} {_times(v['ratio_cpu'])}" for k, v in script.items()]
    lines.append(
        f"{'times the lower bound':24} {_times(figures['times_floor']):24} {_times(figures['times_floor_cpu'])}"
    )
    return lines + (_describe_scaling(figures["scaling"]) if figures["scaling"] else [])


def _table(title: str, side: Mapping[str, Any]) -> list[str]:
    total, means = side["ms_per_scene"], side["stages_mean_ms"]
    stages = sorted(side["stages_ms"].items(), key=lambda stage: (stage[0] == "rest", -stage[1]))
    return [
        title,
        f"  {total:.1f} ms a scene, {1e3 / total:.2f} scenes/s ({side['cpu_ms_per_scene']:.1f} ms of processor)",
        *(f"    {name:22} {ms:8.2f} ms {ms / total:6.1%}, mean {means[name]:.2f} ms" for name, ms in stages),
    ]


def _times(spread: Mapping[str, float], form: str = ".2f", unit: str = " x") -> str:
    """The median, and in brackets the minimum and the maximum."""
    return f"{spread['median']:{form}}{unit} [{spread['least']:{form}} to {spread['most']:{form}}]"


def _describe_scaling(scaling: Mapping[str, Any]) -> list[str]:
    shares = (_times(scaling[name], ".1%", "") for name in ("ray_share_one", "ray_share"))
    return [
        "",
        f"{scaling['workers']} at once against one     {'as many scenes':24} {'processor for a scene':24} scenes/s",
        *(
            f"  {name:22} {_times(gain['speedup']):24} {_times(gain['inflation']):24} "
            f"{gain['one_scenes_per_s']:.2f} and {gain['all_scenes_per_s']:.2f}, {gain['scenes']} scenes"
            for name, gain in (("through Ray", scaling["ray"]), ("plain processes", scaling["bare"]))
        ),
        f"  Ray gives {scaling['share_of_bare']:.1%} of what plain processes gain",
        f"  Ray's share of time    {next(shares)} with one worker, {next(shares)} with {scaling['workers']}, "
        f"their uneven end included; ranges of {scaling['range']}",
    ]
