"""Trains a small network to tell where an object is solid from one view of it, and scores it on held-out instances.

PYTHONPATH=. .venv/bin/python deploy/examples/train_occupancy.py data/targets [--epochs N] [--out DIR]

It takes points of the input view and a place, and answers whether the place is inside the object (Mescheder et al. 2019).
occupancy.py tells its frame and unit, and what it is compared with.
"""

import json
from collections import defaultdict
from itertools import pairwise

import numpy as np
import torch
from mirror_depth import Split, pairs_of_split
from occupancy import FEATURES, Example, Flags, iou, make_example
from torch import Tensor, nn
from torch.nn import functional
from train_mirror_depth import keep, read_options, stack, tell_size, train

from services.dataset.dataset import open_dataset

SURE = 0.3
"""Probability from which a place counts as inside: the best of the validation split, since few places of thin shapes are."""
EPOCHS = 40
ASKED = 512
"""Places of each object in a training step."""


class OccupancyNet(nn.Module):
    """seen [B, N, 3], queries [B, M, FEATURES] -> logits [B, M]: two layers of PointNet, then one place at a time."""

    def __init__(self, width: int = 64) -> None:
        super().__init__()
        self.point, self.cloud = layers(3, width, width), layers(2 * width, width, width)
        self.answer = layers(FEATURES + width, width, width, width, 1)

    def forward(self, seen: Tensor, queries: Tensor) -> Tensor:
        """Logits of being inside."""
        each = self.point(seen)
        all_of_it = each.amax(dim=1, keepdim=True).expand_as(each)
        code = self.cloud(torch.cat([each, all_of_it], dim=2)).amax(dim=1, keepdim=True)
        answers: Tensor = self.answer(torch.cat([queries, code.expand(-1, queries.shape[1], -1)], dim=2))
        return answers[..., 0]


def layers(*sizes: int) -> nn.Sequential:
    """Linear layers of these sizes, with ReLU between them."""
    linear = [nn.Linear(a, b) for a, b in pairwise(sizes)]
    return nn.Sequential(linear[0], *(layer for following in linear[1:] for layer in (nn.ReLU(), following)))


def loss_of(net: OccupancyNet, batch: dict[str, Tensor]) -> Tensor:
    """Cross entropy at ASKED places, half of the objects mirrored left to right, which the rest of the scene allows."""
    some = torch.randint(batch["queries"].shape[1], (ASKED,))
    side = torch.ones(len(batch["seen"]), 1, 1)
    side[torch.rand(len(side)) < 0.5] = -1
    seen, queries = (
        torch.cat([points[..., :1], points[..., 1:2] * side, points[..., 2:]], 2)
        for points in (batch["seen"], batch["queries"][:, some])
    )
    return functional.binary_cross_entropy_with_logits(net(seen, queries), batch["inside"][:, some].float())


def load(place: str, split: Split = "train") -> dict[str, Tensor]:
    """All pairs of a split in memory: seen, queries and inside as `occupancy.Example` tells them."""
    examples = filter(None, map(make_example, pairs_of_split(open_dataset(place), split)))
    names = ("seen", "queries", "inside")
    return stack([{name: torch.from_numpy(getattr(example, name)) for name in names} for example in examples])


@torch.no_grad()
def answer(net: OccupancyNet, example: Example) -> Flags:
    """[M] whether the network takes the places of an example for inside."""
    net.eval()
    logits = net(torch.from_numpy(example.seen)[None], torch.from_numpy(example.queries)[None])[0]
    inside: Flags = logits.sigmoid().numpy() > SURE
    return inside


def evaluate(net: OccupancyNet, place: str) -> dict[str, dict[str, float]]:
    """Mean IoU over the test split, of all objects and of each category, of the network and of the baselines."""
    scores: dict[str, dict[str, list[float]]] = {name: defaultdict(list) for name in ("network", "half turn", "shadow")}
    for pair in pairs_of_split(open_dataset(place), "test"):
        if (example := make_example(pair)) is not None:
            answers = answer(net, example), example.turned, example.shadow
            for of, inside in zip(scores.values(), answers, strict=True):
                of["all"].append(iou(inside, example.inside))
                of[pair.category].append(of["all"][-1])
    return {name: {group: float(np.nanmean(of[group])) for group in sorted(of)} for name, of in scores.items()}


def main() -> None:
    """Train, score, print, and keep the network."""
    options = read_options(__doc__, EPOCHS)
    data, net = load(options.place), OccupancyNet()
    tell_size(net, data)
    train(net, data, options.epochs, loss_of)
    scores = evaluate(net, options.place)
    keep(net, options)
    print(f"{'IoU':12}{''.join(f'{group:>8}' for group in scores['network'])}")
    for name, means in scores.items():
        print(f"{name:12}{''.join(f'{value:8.3f}' for value in means.values())}")
    print(json.dumps(scores))


if __name__ == "__main__":
    main()
