"""Keys that cannot act are told with the key that switches them off, and none is told that acts."""

from services.job.job_file import NEEDS, describe_idle, validate_job

OFF = {
    "render.tier": ("flat", {"render": {"rgb": False}}, "render.rgb is false"),
    "render.samples": (4, {"render": {"tier": "flat"}}, "render.tier is not raster"),
    "render.path_samples": (64, {}, "render.tier is not pathtraced"),
    "render.path_bounces": (2, {}, "render.tier is not pathtraced"),
    "cameras.mirror.T_z_m": (0.8, {"cameras": {"mirror": {"enabled": False}}}, "cameras.mirror.enabled is false"),
    "cameras.mirror.pivot_depth": ("median", {"cameras": {"mirror": {"enabled": False}}}, "cameras.mirror.enabled"),
    "cameras.mirror.percentile": (9.0, {"cameras": {"mirror": {"pivot_depth": "median"}}}, "pivot_depth is not"),
    "cameras.depth.offset_m": ([0.0, 0.0, 0.0], {"cameras": {"depth": {"enabled": False}}}, "cameras.depth.enabled"),
    "images.projection.splat": (3, {"images": {"projection": {"enabled": False}}}, "projection.enabled is false"),
    "images.projection.hidden_point_removal": (
        True,
        {"images": {"projection": {"enabled": False}}},
        "projection.enabled",
    ),
    "start.arrange": ("pile", {}, "objects_per_scene is 1"),
    "start.pile_offset_m": ([-0.1, 0.1], {"objects_per_scene": 3}, "start.arrange is spread"),
    "physics.concavity": (0.1, {"physics": {"collision": "hull"}}, "makes no convex parts"),
}
ON = {
    "render": {"tier": "pathtraced", "path_samples": 4, "path_bounces": 2},
    "cameras": {"mirror": {"T_z_m": 0.8, "percentile": 9.0}, "depth": {"offset_m": [0.0, 0.0, 0.0]}},
    "images": {"projection": {"splat": 3, "hidden_point_removal": True}},
    "objects_per_scene": 3,
    "start": {"arrange": "pile", "pile_offset_m": [-0.1, 0.1]},
    "physics": {"concavity": 0.1},
}


def job_of(key="", value=None, changes=None):
    """A job with changes, and a key set to a value."""
    tree = {"verso": 1, "name": "t", **(changes or {})}
    *branches, name = key.split(".") if key else [""]
    place = tree
    for branch in branches:
        place[branch] = dict(place.get(branch, {}))
        place = place[branch]
    if key:
        place[name] = value
    if tree.get("cameras", {}).get("mirror", {}).get("enabled") is False:
        tree.setdefault("images", {}).setdefault("projection", {"enabled": False})
    return validate_job(tree, "t")


def test_each_key_that_cannot_act_is_told_with_its_reason():
    assert OFF.keys() == NEEDS.keys()
    for key, (value, changes, why) in OFF.items():
        (line,) = describe_idle(job_of(key, value, changes))
        assert line.startswith(f"{key} is ") and why in line, (key, line)


def test_nothing_is_told_of_keys_that_act_or_are_at_their_defaults():
    assert describe_idle(job_of()) == describe_idle(job_of(changes=ON)) == []
    assert describe_idle(job_of("render.samples", 4)) == []
    assert describe_idle(job_of(changes={"render": {"rgb": False}})) == []
