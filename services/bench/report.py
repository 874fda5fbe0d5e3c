"""Pure: what a benchmark says, as one object and as text."""

from collections.abc import Sequence
from dataclasses import asdict
from statistics import mean, median
from typing import Any

from services.bench.measure import Measured
from services.bench.ratios import Lap, Spread, by_processor, slope_ratio, stage_table, with_loading


def summarise(measured: Measured) -> dict[str, Any]:
    """The figures of the rounds: plain numbers, milliseconds per scene, ratios of slopes."""
    ours, floor, script = ([getattr(one, side) for one in measured.rounds] for side in ("ours", "floor", "script"))
    scenes = sum(lap.scenes for lap in ours)
    return {
        "machine": measured.machine,
        "core": measured.core,
        "scenes": scenes,
        "rounds": len(ours),
        "bytes_per_scene": sum(one.bytes for one in measured.rounds) / scenes,
        "startup_s": {"ours": measured.startup_ours_s, "script": measured.startup_script_s},
        "ours": _side(ours),
        "script": _side(script) | {"load_ms": median(lap.apart_s / lap.scenes for lap in script) * 1e3},
        "floor": _side(floor) | {"encoders": measured.encoders},
        "ratio": asdict(slope_ratio(script, ours)),
        "ratio_cpu": asdict(slope_ratio(script, ours, by_processor)),
        "ratio_with_loading": asdict(slope_ratio(script, ours, with_loading)),
        "times_floor": asdict(slope_ratio(ours, floor)),
        "times_floor_cpu": asdict(slope_ratio(ours, floor, by_processor)),
    }


def _side(laps: Sequence[Lap]) -> dict[str, Any]:
    return {
        "ms_per_scene": median(lap.slope_s for lap in laps) * 1e3,
        "cpu_ms_per_scene": median(by_processor(lap) for lap in laps) * 1e3,
        "stages_ms": stage_table(laps),
        "stages_mean_ms": stage_table(laps, mean),
    }


def describe(figures: dict[str, Any]) -> list[str]:
    """The same for a reader, one line each."""
    machine = figures["machine"]
    start = figures["startup_s"]
    lines = [
        f"machine    {machine['usable_cores']} of {machine['cores']} cores, {machine['cpu']}, load {machine['load_1min']:.1f}",
        f"           {machine['gl_renderer']}",
        f"           Python {machine['python']}, " + ", ".join(f"{k} {v}" for k, v in machine["versions"].items()),
        f"command    {figures['command']}",
        f"measured   {figures['scenes']} scenes in {figures['rounds']} rounds, each side in turn on core "
        f"{figures['core']}, {figures['bytes_per_scene'] / 1e3:.0f} kB a scene on {figures['file_system']}",
        f"start-up   ours {start['ours']:.1f} s, script {start['script']:.1f} s, not counted below",
        "",
    ]
    for name, what in (("ours", "ours"), ("script", "straightforward script"), ("floor", "floor")):
        lines += _table(what, figures[name])
    lines += [
        f"  before its clock the script loads its meshes: {figures['script']['load_ms']:.1f} ms a scene",
        f"  the floor's encoders: {', '.join(f'{kind} {name}' for kind, name in figures['floor']['encoders'].items())}",
        "",
        f"against the script      {_spread(figures['ratio'])} as many scenes (of processor time "
        f"{_spread(figures['ratio_cpu'])}; its loading counted {_spread(figures['ratio_with_loading'])})",
        f"against the floor       {_spread(figures['times_floor'])} its time (of processor time "
        f"{_spread(figures['times_floor_cpu'])})",
    ]
    lines += _describe_memory(figures["memory"]) + _describe_scaling(figures["scaling"])
    return lines + [f"{name:23} {found}" for name, found in figures["other_systems"].items()]


def _table(what: str, side: dict[str, Any]) -> list[str]:
    total = side["ms_per_scene"]
    head = f"{what:28} {total:8.1f} ms a scene, {1e3 / total:.2f} scenes/s ({side['cpu_ms_per_scene']:.1f} ms of processor)"
    stages = sorted(side["stages_ms"].items(), key=lambda stage: (stage[0] == "rest", -stage[1]))
    means = side["stages_mean_ms"]
    return [head, *(f"  {name:26} {ms:8.2f} ms {ms / total:6.1%}, mean {means[name]:.2f} ms" for name, ms in stages)]


def _spread(spread: dict[str, float]) -> str:
    return f"{spread['median']:.2f} x [{spread['least']:.2f} to {spread['most']:.2f}]"


def _describe_memory(memory: dict[str, Any] | None) -> list[str]:
    if memory is None:
        return []
    return [
        f"memory                  {memory['settled_mb']:.0f} MB after {memory['settled_after']} scenes, "
        f"{memory['last_mb']:.0f} MB after {memory['scenes']} ({memory['grown']:+.1%}), at most "
        f"{memory['peak_mb']:.0f} MB; time for a scene "
        f"{memory['slowed']:+.1%}"
    ]


def _describe_scaling(scaling: dict[str, Any] | None) -> list[str]:
    if scaling is None:
        return []
    share = Spread(**scaling["ray_share"])
    return [
        f"{scaling['workers']} workers against one   {_spread(scaling['speedup'])} ({scaling['one_scenes_per_s']:.2f} and "
        f"{scaling['all_scenes_per_s']:.2f} scenes/s, {scaling['scenes']} scenes)",
        f"Ray's share             {share.median:.1%} [{share.least:.1%} to {share.most:.1%}] with shards of {scaling['shard']}",
    ]
