"""`verso capture simulate`: a virtual capture with known truth, in the folder that a real one has."""

import argparse
import json
import time
from pathlib import Path

from schemas.errors import OutputError
from schemas.job.views import Render
from services.capture.settings import capture_job


def simulate(options: argparse.Namespace) -> int:
    """Writes the folder options.out; reads `views`, `seed`, `category`, `changes` (--set) and `json`. Returns 0.

    Raises JobError for settings that cannot be, AssetSourceError where no source has the category, OutputError where the
    folder has files.
    """
    keys = {"seed": options.seed, "categories": [options.category], "captures.simulate.views": options.views}
    if options.views is not None:
        keys["captures.most_views"] = options.views  # of a dataset, which this folder is not
    job = capture_job(options.changes, keys)
    assert job.captures is not None
    path, begun = Path(options.out), time.perf_counter()
    if path.exists() and (not path.is_dir() or any(path.iterdir())):
        raise OutputError(f"{path} is there already: name a new or an empty folder")
    from workers.assets.catalogue import open_catalogue
    from workers.capture.simulate.effects import ASKED, plan_effects
    from workers.pipeline.captures.simulate import load_object, simulate_capture
    from workers.render.tiers import require_tier
    from workers.scene.plan import SceneChance

    settings, chance = job.captures.simulate, SceneChance(job.seed, job.first_scene)
    require_tier(Render(tier=settings.tier))
    catalogue = open_catalogue(job.assets, Path.cwd(), job.categories)
    asset = load_object(job, catalogue, chance)
    plan = plan_effects(settings)
    truth = simulate_capture(settings, job.captures.board, asset, chance, path)
    seconds, ran = time.perf_counter() - begun, [name for name in ASKED if plan.runs(name)]
    views = len(truth.T_board_cam)
    print(f"{path}: {views} views of {asset.instance_id} in {seconds:.1f} s; effects: {', '.join(ran) or 'none'}")
    print(f"{path / 'truth'}: poses and the true mesh, which only `verso capture evaluate` reads")
    if options.json:
        answer = {"ok": True, "out": str(path), "views": views, "category": asset.category}
        answer |= {"instance_id": asset.instance_id, "seed": job.seed, "effects": ran, "seconds": seconds}
        print(json.dumps(answer))
    return 0
