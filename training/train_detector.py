"""Train the small flower detector on renderings, and write it as ONNX.

    python training/train_detector.py -o cluster_slam/detect/models/flowers.onnx

Needs the extra ``train``. Everything is seeded; one thread; less than 20 minutes of CPU.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import torch
from augment import altered, plain
from export import write_onnx
from muon import Muon, dense_weights
from network import STRIDE, FlowerNet, decoded
from pictures import HIDDEN, SEEN, Example, make_examples, render_near, render_usual, render_world
from torch import Tensor

SIZE = 128  # of a crop the network sees: small, so that most of it is about flowers
FIRST_WORLD = 10_000
CUT = 208  # of a crop that is kept: it is turned, scaled and cut anew each time
BATCH = 16
RISE = 60  # steps in which rates rise; then they fall along a cosine
SMALL_PX = 16.0  # shorter side of a flower that is small


WORLDS = ((render_world, 70, 4), (render_near, 30, 6), (render_usual, 50, 6))  # plants, crops of each picture
N_STEPS = 7500
RATE, MUON_RATE = 3e-3, 0.02  # of AdamW; of the layers that mix channels


@dataclass(frozen=True, slots=True)
class Kind:
    """A kind of crop that is learned from."""

    share: float  # of all crops
    zoom: tuple[float, float]  # by which they are scaled
    wants_small: bool  # they are drawn more often, the more small flowers they show
    other: float | None  # share of them before another backdrop; None: with their own light and backdrop


KINDS = (
    Kind(0.55, (0.615, 1.3), True, None),
    Kind(0.20, (0.615, 1.3), True, 0.4),
    Kind(0.25, (0.615, 2.4), False, 0.6),
)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("-o", "--out", type=Path, required=True)
    options.add_argument("--share", type=float, default=1.0, help="of the plants and of the steps, for a trial")
    chosen = options.parse_args()
    torch.manual_seed(1)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    examples = all_examples(chosen.share)
    print(f"{len(examples)} crops after {time.process_time():.0f} s of CPU", flush=True)
    net = FlowerNet().to(memory_format=torch.channels_last)  # three times as fast on a CPU
    train(net, examples, max(1, round(N_STEPS * chosen.share)))
    write_onnx(net.eval(), chosen.out)
    print(f"written after {time.process_time():.0f} s of CPU: {chosen.out}", flush=True)


def all_examples(share: float = 1.0) -> list[Example]:
    """Crops of all plants: random ones, those at usual distances, those of usual sessions."""
    found: list[Example] = []
    first = FIRST_WORLD
    for render, n_worlds, per_picture in WORLDS:
        n = max(1, round(n_worlds * share))
        found += make_examples(render, range(first, first + n), CUT, per_picture)
        first += n_worlds
    return found


def train(net: FlowerNet, examples: list[Example], n_steps: int, seed: int = 1) -> None:
    """Steps over examples; at the end the network has the mean of its last weights."""
    net.train()
    muon = Muon(dense_weights(net))
    turned = {id(p) for p in muon.weights}
    rest = [p for p in net.parameters() if id(p) not in turned]
    optimiser = torch.optim.AdamW(rest, lr=RATE, weight_decay=1e-4)
    rng = np.random.default_rng(seed)
    shares = [_shares(examples) if kind.wants_small else np.full(len(examples), 1 / len(examples)) for kind in KINDS]
    begin = time.process_time()
    average: dict[str, Tensor] = {}
    for step in range(n_steps):
        falling = min(1.0, (step + 1) / RISE) * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * step / n_steps)))
        for group in optimiser.param_groups:
            group["lr"] = RATE * falling
        images, targets = batch(examples, shares, rng)
        loss, parts = losses(net(images), targets)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(rest, 5.0)
        optimiser.step()
        muon.step(MUON_RATE * falling)
        average = averaged(average, net, 0.995 if step > 2 * RISE else 0.9)
        if step % 50 == 0:
            print(f"{step} {time.process_time() - begin:.0f} s {[round(float(p), 3) for p in parts]}", flush=True)
    net.load_state_dict(average)


def _shares(examples: list[Example]) -> np.ndarray:
    """How often each crop (n,) is drawn: more, the more small flowers it shows."""
    small = [((e.boxes[:, 4] > SEEN) & (e.boxes[:, 2:4].min(1) < SMALL_PX)).sum() for e in examples]
    weights = 0.5 + np.minimum(np.array(small, float), 6.0)
    return weights / weights.sum()


def averaged(average: dict[str, Tensor], net: FlowerNet, keep: float) -> dict[str, Tensor]:
    """A running mean of the weights: what it gives is smoother than any step."""
    now = net.state_dict()
    if not average:
        return {name: value.clone() for name, value in now.items()}
    for name, value in now.items():
        if value.dtype.is_floating_point:
            average[name].mul_(keep).add_(value, alpha=1 - keep)
        else:
            average[name].copy_(value)
    return average


def batch(examples: list[Example], shares: list[np.ndarray], rng: np.random.Generator) -> tuple[Tensor, Tensor]:
    """Images (n, 3, s, s) and targets (n, 7, s / 4, s / 4): heat, use, weight of the box, offset, log size."""
    pairs = []
    for k in rng.choice(len(KINDS), BATCH, p=[kind.share for kind in KINDS]):
        kind, example = KINDS[k], examples[rng.choice(len(examples), p=shares[k])]
        if kind.other is None:
            pairs.append(plain(example, SIZE, kind.zoom, rng))
        else:
            pairs.append(altered(example, SIZE, kind.zoom, rng, other=kind.other))
    images = np.stack([image for image, _ in pairs])
    wide = torch.from_numpy(images).contiguous(memory_format=torch.channels_last)
    return wide, torch.from_numpy(np.stack([target(boxes) for _, boxes in pairs]))


def target(boxes: np.ndarray) -> np.ndarray:
    """What the network should say of one crop."""
    n = SIZE // STRIDE
    y, x = np.mgrid[:n, :n].astype(np.float32) + 0.5
    out = np.zeros((7, n, n), np.float32)
    out[1] = 1.0
    for u, v, w, h, seen in boxes[np.argsort(boxes[:, 4])]:  # the best seen last
        cx, cy, cw, ch = (u + 0.5) / STRIDE, (v + 0.5) / STRIDE, w / STRIDE, h / STRIDE
        if max(cw, ch) < 0.9:
            continue
        far = ((x - cx) / max(0.12 * cw, 0.55)) ** 2 + ((y - cy) / max(0.12 * ch, 0.55)) ** 2
        near = np.exp(-0.5 * far)
        if seen < HIDDEN:
            continue
        if seen < SEEN or max(cw, ch) < 1.5:
            out[1][far < 4.0] = 0.0
            continue
        out[1][near > 0.3] = 1.0
        better = near > out[0]
        out[0] = np.maximum(out[0], near)
        for k, value in enumerate((near, cx - x, cy - y, np.log(cw), np.log(ch))):
            out[2 + k][better & (near > 0.05)] = value[better & (near > 0.05)] if np.ndim(value) else value
        i, j = int(cy), int(cx)
        if 0 <= i < n and 0 <= j < n:
            out[0, i, j] = 1.0
    return out


def losses(raw: Tensor, wanted: Tensor) -> tuple[Tensor, tuple[Tensor, ...]]:
    """Focal loss of the heat (Zhou, Wang, Kraehenbuehl, "Objects as Points", 2019, eq. 1); boxes, how good they are."""
    heat, use, weight = wanted[:, 0], wanted[:, 1], wanted[:, 2]
    p = torch.sigmoid(raw[:, 0]).clamp(1e-5, 1 - 1e-5)
    is_middle = (heat >= 1.0).float() * use
    hit = -((1 - p) ** 2) * torch.log(p) * is_middle
    miss = -((1 - heat) ** 4) * p**2 * torch.log(1 - p) * (1 - is_middle) * use
    count = is_middle.sum().clamp(min=1.0)
    focal = (hit + miss).sum() / count
    total = weight.sum().clamp(min=1.0)
    away = torch.nn.functional.smooth_l1_loss(raw[:, 1:3], wanted[:, 3:5], reduction="none", beta=0.1)
    offset = (away * weight[:, None]).sum() / total
    size = ((raw[:, 3:5] - wanted[:, 5:7]).abs() * weight[:, None]).sum() / total
    shared = overlap(decoded(raw), decoded(torch.cat([wanted[:, :1], wanted[:, 3:7]], 1)))
    apart = ((1 - shared) * weight).sum() / total
    told = torch.nn.functional.binary_cross_entropy_with_logits(raw[:, 5], shared.detach(), reduction="none")
    good = (told * weight).sum() / total
    loss = focal + offset + 0.5 * size + apart + 0.5 * good
    return loss, (focal.detach(), offset.detach(), size.detach(), apart.detach(), good.detach())


def overlap(a: Tensor, b: Tensor) -> Tensor:
    """Intersection over union (n, h, w) of boxes (n, 4, h, w), cx cy w h, cell by cell."""
    low = torch.maximum(a[:, :2] - a[:, 2:] / 2, b[:, :2] - b[:, 2:] / 2)
    high = torch.minimum(a[:, :2] + a[:, 2:] / 2, b[:, :2] + b[:, 2:] / 2)
    shared = (high - low).clamp(min=0.0).prod(1)
    return shared / (a[:, 2:].prod(1) + b[:, 2:].prod(1) - shared + 1e-6)


if __name__ == "__main__":
    main()
