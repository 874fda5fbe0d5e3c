"""Trains a small network to predict the mirror view's depth from the input view, and has it predict held-out instances.

PYTHONPATH=. .venv/bin/python deploy/examples/train_mirror_depth.py data/training [--epochs N] [--out DIR]

The network sees the projection of the input view, the same turned by half a turn, and the planes of table top and floor
(mirror_depth.py), and says for each pixel whether the object is there and how deep. DIR/predictions is what `verso score` reads.
"""

import argparse
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from guesses import Prediction, Predictor, regions_of, write
from mirror_depth import CHANNELS, CROP, SCALE_M, Example, Split, make_example, nearest, pairs_of_split, planes
from torch import Tensor, nn
from torch.nn import functional
from torch.utils.data import DataLoader, TensorDataset
from torch.utils.data import Dataset as TorchDataset

from services.dataset.dataset import open_dataset
from services.dataset.pair import Pair

BATCH = 16
RATE = 2e-3
EPOCHS = 12

Loss = Callable[[Any, dict[str, Tensor]], Tensor]


class MirrorDepthPairs(TorchDataset):
    """Pairs of one split by instance; an item is a dict of tensors [..., H, W] as `mirror_depth.Example` tells them.

    The ids are looked up once; images are read and decoded when an item is asked for, so that worker processes of a
    DataLoader share nothing. sense: what lies between a stored pair and the network, such as noise.
    """

    def __init__(self, place: str, split: Split, sense: Callable[[Pair], Pair] = lambda pair: pair) -> None:
        self._pairs, self._sense = open_dataset(place), sense
        self.ids = [pair.pose_id for pair in pairs_of_split(self._pairs, split)]

    def __len__(self) -> int:
        return len(self.ids)

    def __getitem__(self, index: int) -> dict[str, Any]:
        example = make_example(self._sense(self._pairs.pair(self.ids[index])))
        if example is None:  # too near the rim: the next one stands in
            return self[(index + 1) % len(self)]
        known = (example.depth > 0)[None]
        return {
            "features": torch.from_numpy(example.features),
            "background": torch.from_numpy(example.background)[None],
            "depth": torch.from_numpy(example.depth)[None],
            "mask": torch.from_numpy(example.mask)[None],
            "known": torch.from_numpy(known),
            "middle_m": torch.tensor(example.middle_m).reshape(1, 1, 1),
        }


class Net(nn.Module):
    """A U-Net on 2 x 2 blocks of pixels: [B, channels, H, W] -> [B, outputs, H, W]; H and W are multiples of 16."""

    def __init__(self, width: int = 32, channels: int = CHANNELS, outputs: int = 2) -> None:
        super().__init__()
        sizes = (width, 2 * width, 3 * width)
        self.first = block(4 * channels, width)
        self.down = nn.ModuleList([block(a, b) for a, b in zip(sizes, (*sizes[1:], sizes[-1]), strict=True)])
        self.up = nn.ModuleList([block(2 * sizes[2], sizes[1]), block(2 * sizes[1], sizes[0]), block(2 * width, width)])
        self.last = nn.Conv2d(width, 4 * outputs, 1)

    def forward(self, features: Tensor) -> Tensor:
        """What the images say of each pixel."""
        x = self.first(functional.pixel_unshuffle(features, 2))
        kept = []
        for down in self.down:
            kept.append(x)
            x = down(functional.max_pool2d(x, 2))
        for up in self.up:
            x = functional.interpolate(x, scale_factor=2, mode="nearest")
            x = up(torch.cat([x, kept.pop()], dim=1))
        return functional.pixel_shuffle(self.last(x), 2)


def block(before: int, after: int) -> nn.Sequential:
    """Two convolutions."""
    layers: list[nn.Module] = []
    for count in (before, after):
        layers += [nn.Conv2d(count, after, 3, padding=1, bias=False), nn.BatchNorm2d(after), nn.ReLU()]
    return nn.Sequential(*layers)


def predict(net: Net, batch: dict[str, Tensor]) -> tuple[Tensor, Tensor]:
    """(logit of the object, its depth in metres), [B, 1, H, W] each; the network's counts from `middle_m`, in SCALE_M."""
    logit, relative = net(batch["features"]).split(1, dim=1)
    return logit, batch["middle_m"] + SCALE_M * relative


def loss_of(net: Net, batch: dict[str, Tensor]) -> Tensor:
    """Cross entropy of the mask, and L1 of the object's depth inside it, in SCALE_M."""
    logit, depth = predict(net, batch)
    mask = batch["mask"] & batch["known"]
    error = (depth - batch["depth"]).abs() / SCALE_M
    return functional.binary_cross_entropy_with_logits(logit, batch["mask"].float()) + error[mask].mean()


def load(place: str, *senses: Callable[[Pair], Pair]) -> dict[str, Tensor]:
    """All training pairs in memory, as stored and by each sense: some thousand are small."""
    splits = [MirrorDepthPairs(place, "train"), *(MirrorDepthPairs(place, "train", sense) for sense in senses)]
    return stack([pairs[number] for pairs in splits for number in range(len(pairs))])


def stack(items: list[dict[str, Tensor]]) -> dict[str, Tensor]:
    """Each tensor of all items, [N, ...]."""
    return {name: torch.stack([item[name] for item in items]) for name in items[0]}


def train(net: nn.Module, data: dict[str, Tensor], epochs: int, loss_of: Loss = loss_of, size: int = BATCH) -> None:
    """Adam with one cycle of the learning rate."""
    names, all_of_it = list(data), TensorDataset(*data.values())
    loader = DataLoader(all_of_it, size, shuffle=True, drop_last=len(all_of_it) > size)
    optimiser = torch.optim.AdamW(net.parameters(), RATE, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=epochs * len(loader))
    begun = time.monotonic()
    for epoch in range(epochs):
        net.train()
        losses = []
        for batch in loader:
            optimiser.zero_grad()
            loss = loss_of(net, dict(zip(names, batch, strict=True)))
            loss.backward()
            optimiser.step()
            schedule.step()
            losses.append(loss.item())
        print(f"epoch {epoch + 1}/{epochs}: loss {np.mean(losses):.3f}, {time.monotonic() - begun:.0f} s", flush=True)


@torch.no_grad()
def complete(net: Net, example: Example) -> np.ndarray:
    """[H, W] float32 metres: the predicted object in front of the planes."""
    net.eval()
    middle = torch.tensor(example.middle_m).reshape(1, 1, 1, 1)
    logit, depth = predict(net, {"features": torch.from_numpy(example.features)[None], "middle_m": middle})
    return np.where(logit[0, 0].numpy() > 0, depth[0, 0].numpy(), example.background).astype(np.float32)


def predictor(net: Net) -> Predictor:
    """Says the mirror view's depth: every object in its crop before the planes of table top and floor."""

    def predict_pair(pair: Pair) -> Prediction:
        depth_m = planes(pair)
        for region in regions_of(pair):
            if (example := make_example(pair, region)) is not None:
                window = tuple(slice(at, at + n) for at, n in zip(example.corner, CROP, strict=True))
                depth_m[window] = nearest(depth_m[window], complete(net, example))
        return Prediction(depth_m)

    return predict_pair


def read_options(about: str, epochs: int) -> argparse.Namespace:
    """The words of the command line: place, epochs, seed (which is set), out."""
    parser = argparse.ArgumentParser(description=about.splitlines()[0])
    parser.add_argument("place", metavar="DATASET", help="a folder, or a bucket")
    parser.add_argument("--epochs", type=int, default=epochs, help=f"default: {epochs}")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--out", type=Path, help="folder for network.pt and predictions")
    options = parser.parse_args()
    torch.manual_seed(options.seed)
    return options


def tell_size(net: nn.Module, data: dict[str, Tensor]) -> None:
    """Print how much is learnt from how much."""
    pairs, weights = len(next(iter(data.values()))), sum(p.numel() for p in net.parameters())
    print(f"{pairs} training pairs, {weights / 1e3:.0f} thousand weights", flush=True)


def keep(net: nn.Module, options: argparse.Namespace) -> None:
    """Write network.pt, if `--out` names a folder."""
    if options.out is not None:
        options.out.mkdir(parents=True, exist_ok=True)
        kept = {"weights": net.state_dict(), "epochs": options.epochs, "seed": options.seed}
        torch.save(kept, options.out / "network.pt")


def main() -> None:
    """Train, and keep the network and its predictions."""
    options = read_options(__doc__, EPOCHS)
    data, net = load(options.place), Net()
    tell_size(net, data)
    train(net, data, options.epochs)
    keep(net, options)
    if options.out is not None:
        folder, predict = options.out / "predictions", predictor(net)
        for pair in pairs_of_split(open_dataset(options.place), "test"):
            write(folder, pair, predict(pair))
        print(f"score it with: ./verso score {options.place} {folder} --split test")


if __name__ == "__main__":
    main()
