"""The PyTorch Dataset and the training script, where torch is installed: in a process of their own, as a user runs them.

Torch's compiler brings its own LLVM, and may crash in a process that Mesa has drawn in.
"""

import importlib.util
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from guesses import Prediction, project_and_fill, write
from mirror_depth import pairs_of_split

from services.cli.main import main
from services.dataset.dataset import open_dataset
from tests.datasets import make_dataset
from tests.deploy.examples.conftest import EXAMPLES, FULL_SIZE

ROOT = Path(__file__).resolve().parents[3]

pytestmark = pytest.mark.skipif(
    importlib.util.find_spec("torch") is None, reason="torch is not installed: pip install torch==2.14.1"
)

CHECKS = """
import sys
from functools import partial
import torch
from baselines import sense_input
from mirror_depth import make_example, pairs_of_split
from train_mirror_depth import MirrorDepthPairs, Net, complete, load, loss_of
from services.dataset.dataset import open_dataset

place = sys.argv[1]
train, test = MirrorDepthPairs(place, "train"), MirrorDepthPairs(place, "test")
assert not set(train.ids) & set(test.ids) and len(train) + len(test) == 6 and len(train) and len(test)
assert train.ids == [pair.pose_id for pair in pairs_of_split(open_dataset(place), "train")]
(batch,) = torch.utils.data.DataLoader(train, batch_size=len(train), num_workers=1)
assert batch["features"].shape[0] == len(train) == batch["mask"].shape[0]
assert torch.equal(batch["depth"][0], train[0]["depth"])

torch.manual_seed(0)
data, net = load(place), Net(8)
twice = load(place, partial(sense_input, job=open_dataset(place).job))["features"]
assert torch.equal(twice[: len(train)], data["features"]) and len(twice) == 2 * len(train)
assert not torch.equal(twice[len(train) :], data["features"])
optimiser = torch.optim.Adam(net.parameters(), 1e-2)
losses = []
for _ in range(40):
    optimiser.zero_grad()
    loss = loss_of(net, data)
    loss.backward()
    optimiser.step()
    losses.append(loss.item())
assert losses[-1] < 0.5 * losses[0], losses
example = make_example(next(open_dataset(place).pairs()))
answer = complete(net, example)
assert answer.shape == example.depth.shape and (answer == example.background).any()
"""


VOLUMES = """
import sys
import torch
from train_occupancy import OccupancyNet, load, loss_of

place = sys.argv[1]
data = load(place)
assert {len(values) for values in data.values()} == {len(load(place, "train")["inside"])}
assert len(data["inside"]) + len(load(place, "test")["inside"]) == 6


def fit(data):
    torch.manual_seed(0)
    net = OccupancyNet()
    optimiser = torch.optim.Adam(net.parameters(), 3e-3)
    losses = []
    for _ in range(30):
        optimiser.zero_grad()
        loss = loss_of(net, data)
        loss.backward()
        optimiser.step()
        losses.append(loss.item())
    return losses


inside = data["inside"].flatten()
wrong = inside[torch.randperm(len(inside), generator=torch.Generator().manual_seed(0))].reshape(data["inside"].shape)
losses, shuffled = fit(data), fit({**data, "inside": wrong})
assert losses[-1] < 0.85 * losses[0] and losses[-1] < 0.7 * shuffled[-1], (losses, shuffled)
assert fit(data) == losses
"""


def python(*arguments: str) -> str:
    """What a Python with the examples' folder and the project on its path prints."""
    path = os.pathsep.join([str(ROOT), str(EXAMPLES), *filter(None, [os.environ.get("PYTHONPATH")])])
    environ = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run([sys.executable, *arguments], env=environ, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.mark.minute
@pytest.mark.parametrize(
    ("checks", "module", "network"),
    [(CHECKS, "train_mirror_depth", "Net"), (VOLUMES, "train_occupancy", "OccupancyNet")],
)
def test_a_network_learns_and_the_script_keeps_it_and_what_it_predicts_or_scores(
    checks, module, network, few, tmp_path, capsys
):
    python("-c", checks, few.name)
    script = (str(EXAMPLES / f"{module}.py"), few.name, "--epochs", "1", "--out", str(tmp_path / "kept"))
    *_, last = python(*script).splitlines()
    if module == "train_occupancy":
        assert list(json.loads(last)) == ["network", "half turn", "shadow"]
    else:
        program, *words = last.partition(": ")[2].split()
        assert program == "./verso" and main(words) == 0 and "coverage 100 %" in capsys.readouterr().out
    load = f"import sys, torch, {module} as t; t.{network}().load_state_dict(torch.load(sys.argv[1])['weights'])"
    python("-c", load, str(tmp_path / "kept/network.pt"))


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_a_network_that_saw_other_instances_beats_the_projection(tmp_path, record_figure, capsys):
    size = {key: FULL_SIZE[key] for key in ("cameras", "images")}
    categories = ["mug", "box", "can", "jar", "bottle", "bowl"]
    store, _ = make_dataset(tmp_path / "data", scenes=300, categories=categories, **size)
    python(str(EXAMPLES / "train_mirror_depth.py"), store.name, "--epochs", "8", "--out", str(tmp_path))
    for pair in pairs_of_split(open_dataset(store.name), "test"):
        write(tmp_path / "filled", pair, Prediction(project_and_fill(pair).depth_m))
    errors_m = []
    for name in ("predictions", "filled"):
        assert main(["score", store.name, str(tmp_path / name), "--split", "test", "--json"]) == 0
        metrics = json.loads(capsys.readouterr().out.splitlines()[-1])["metrics"]
        errors_m.append(
            [metrics[metric]["value"] for metric in ("depth_mae_scene_m", "depth_mae_m", "depth_mae_hidden_m")]
        )
    for metric, network, baseline in zip(("scene", "object", "hidden"), *errors_m, strict=True):
        record_figure(f"mirror_depth[{metric}]", "passed", 1e3 * network, 1e3 * baseline)
        assert network < 0.7 * baseline
