"""`verso verify --independent N`: labels derived a second time, from the definitions of Staszak and Belter 2024.

`verso verify` derives them by the producer's own functions, which finds damage and never a wrong formula. This package
imports nothing else of the project: rows come as dictionaries, images as bytes.
"""

from collections.abc import Mapping
from typing import Any

from services.read.independent.cameras import check_camera, check_poses
from services.read.independent.labels import check_depth, check_labels, check_patches
from services.read.independent.pair import StoredPair, read_images
from services.read.independent.projection import check_projection


def list_underived(job: Mapping[str, Any]) -> list[str]:
    """Stored values that have no second derivation for this job, a sentence each."""
    told = ["visible_fraction, mirror_agreement and projected_hidden_share are not derived"]
    sensor, projection = job["sensor"], job["images"]["projection"]
    if projection["enabled"] and not has_plain_points(job):
        told.append("projected images are not derived: images.projection.splat or hidden_point_removal is on")
    elif projection["enabled"] and sensor["distortion"]:
        told.append("colours of projected images are not derived: sensor.distortion is on")
    if sensor["depth_noise"]:
        told.append("depth is not compared with the floor's plane: sensor.depth_noise is on")
    return told


def has_plain_points(job: Mapping[str, Any]) -> bool:
    """Whether every projected point fills one pixel and none is removed."""
    projection = job["images"]["projection"]
    return projection["splat"] == 1 and not projection["hidden_point_removal"]


def check_pair(pair: StoredPair) -> list[str]:
    """Stored values of one pair that differ from their definitions, a sentence each."""
    cameras, projection = pair.job["cameras"], pair.job["images"]["projection"]
    switches = {"aligned": cameras["depth"], "mirror": cameras["mirror"], "projected": projection}
    expected = {"input", *(role for role, branch in switches.items() if branch["enabled"])}
    if set(pair.views) != expected:
        return [f"scene {pair.scene['scene_id']}: has views {sorted(pair.views)}, and must have {sorted(expected)}"]
    faults = [fault for view in pair.views.values() for fault in read_images(pair, view)]
    if faults:
        return faults
    for role, view in pair.views.items():
        own = [*check_camera(pair, view), *check_patches(pair, view)]
        if role != "projected":
            own += [*check_depth(pair, view), *check_labels(pair, view)]
        elif has_plain_points(pair.job):
            own += check_projection(pair)
        faults += [f"pose {view['pose_id']} ({role}): {fault}" for fault in own]
    return faults + [f"pair {pair.views['input']['pose_id']}: {fault}" for fault in check_poses(pair)]
