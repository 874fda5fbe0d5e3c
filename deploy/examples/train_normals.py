"""Trains a small network to predict the normals of the input view from RGB and depth, and scores it on held-out instances.

PYTHONPATH=. .venv/bin/python deploy/examples/train_normals.py data/targets [--epochs N] [--out DIR]

It corrects the normals of planes that are fitted to depth, which it is compared with (normals.py).
"""

import json

import numpy as np
import torch
from normals import CHANNELS, Example, Image, errors_deg, make_example, score
from splits import Split, pairs_of_split
from torch import Tensor, nn
from torch.nn import functional
from train_mirror_depth import Net, keep, read_options, stack, tell_size, train

from services.dataset.dataset import open_dataset

BATCH = 4
"""Many steps in few epochs: a patch has thousands of pixels to learn from."""


class NormalsNet(Net):
    """features [B, CHANNELS, H, W] -> unit normals [B, 3, H, W]; the last three features are the planes' normals."""

    def __init__(self, width: int = 16) -> None:
        super().__init__(width, CHANNELS, 3)
        nn.init.zeros_(self.last.weight)
        nn.init.zeros_(self.last.bias)

    def forward(self, features: Tensor) -> Tensor:
        """The planes' normals with a correction, none before training, of length 1."""
        return functional.normalize(features[:, -3:] + super().forward(features), dim=1)


def loss_of(net: NormalsNet, batch: dict[str, Tensor]) -> Tensor:
    """Mean distance of predicted and true unit normals over the object's pixels: twice the sine of half the angle."""
    return (net(batch["features"]) - batch["truth"]).square().sum(dim=1).add(1e-6).sqrt()[batch["mask"]].mean()


def load(place: str, split: Split = "train") -> dict[str, Tensor]:
    """All pairs of a split in memory: features, truth [N, 3, H, W], mask [N, H, W]."""
    examples = filter(None, map(make_example, pairs_of_split(open_dataset(place), split)))
    return stack([as_tensors(one) for one in examples])


def as_tensors(one: Example) -> dict[str, Tensor]:
    """What is trained on."""
    truth = torch.from_numpy(one.truth).permute(2, 0, 1)
    return {"features": torch.from_numpy(one.features), "truth": truth, "mask": torch.from_numpy(one.mask)}


@torch.no_grad()
def predict(net: NormalsNet, example: Example) -> Image:
    """[H, W, 3] unit normals."""
    net.eval()
    normals: Image = net(torch.from_numpy(example.features)[None])[0].permute(1, 2, 0).numpy()
    return normals


def evaluate(net: NormalsNet, place: str) -> dict[str, dict[str, float]]:
    """Scores over the object's pixels of the test split, each pixel counting once, of the network and of the baselines."""
    found: dict[str, list[np.ndarray]] = {}
    for pair in pairs_of_split(open_dataset(place), "test"):
        if (example := make_example(pair)) is not None:
            for name, normals in {"network": predict(net, example), **example.baselines}.items():
                found.setdefault(name, []).append(errors_deg(normals, example))
    return {name: score(np.concatenate(errors)) for name, errors in found.items()}


def main() -> None:
    """Train, score, print, and keep the network."""
    options = read_options(__doc__, epochs=6)
    data, net = load(options.place), NormalsNet()
    tell_size(net, data)
    train(net, data, options.epochs, loss_of, BATCH)
    scores = evaluate(net, options.place)
    keep(net, scores, options)
    print(f"{'':12}{''.join(f'{name:>14}' for name in scores['network'])}")
    for name, one in scores.items():
        print(f"{name:12}{''.join(f'{value:14.3f}' for value in one.values())}")
    print(json.dumps(scores))


if __name__ == "__main__":
    main()
