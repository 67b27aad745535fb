"""Train the small flower detector on renderings, measure it on others, and write it as ONNX.

    python training/train_detector.py -o cluster_slam/detect/models/flowers.onnx

Needs the extra ``train``. Everything is seeded; one thread; about 20 minutes of CPU.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from export import write_onnx
from network import STRIDE, FlowerNet
from pictures import HIDDEN, SEEN, Example, make_examples
from torch import Tensor

SIZE = 256  # of a crop the network sees
CUT = 352  # of a crop that is kept: it is turned, scaled and cut anew each time
BATCH = 16
SEED = 1


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("-o", "--out", type=Path, required=True)
    options.add_argument("--worlds", type=int, default=120)
    options.add_argument("--steps", type=int, default=2600)
    options.add_argument("--limit-s", type=float, default=800.0, help="CPU seconds of training; fewer steps then")
    chosen = options.parse_args()
    torch.manual_seed(SEED)
    torch.set_num_threads(1)
    examples = make_examples(10_000, chosen.worlds, CUT, 2)
    print(f"{len(examples)} crops after {time.process_time():.0f} s of CPU", flush=True)
    net = train(examples, chosen.steps, chosen.limit_s)
    write_onnx(net, chosen.out)
    print(f"written after {time.process_time():.0f} s of CPU: {chosen.out}", flush=True)


def train(
    examples: list[Example],
    n_steps: int,
    limit_s: float,
    *,
    net: FlowerNet | None = None,
    rate: float = 4e-3,
    zoom: tuple[float, float] = (SIZE / CUT, 1.9),
) -> FlowerNet:
    """A network after so many steps, or so many seconds of CPU; the learning rate falls along a cosine of either.

    ``net`` is trained on where one is given; ``zoom`` is the range by which crops are scaled.
    """
    net = (net or FlowerNet()).to(memory_format=torch.channels_last)  # three times as fast on a CPU
    optimiser = torch.optim.AdamW(net.parameters(), lr=rate, weight_decay=1e-4)
    rng = np.random.default_rng(SEED)
    begin = time.process_time()
    average: dict[str, Tensor] = {}
    for step in range(n_steps):
        part = max(step / n_steps, (time.process_time() - begin) / limit_s)
        if part >= 1.0:
            break
        for group in optimiser.param_groups:
            group["lr"] = rate * min(1.0, (step + 1) / 100) * (0.02 + 0.98 * 0.5 * (1 + np.cos(np.pi * part)))
        images, targets = batch(examples, rng, zoom)
        loss, parts = losses(net(images), targets)
        optimiser.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(net.parameters(), 5.0)
        optimiser.step()
        average = averaged(average, net, 0.995 if step > 200 else 0.9)
        if step % 50 == 0:
            print(f"{step} {time.process_time() - begin:.0f} s {[round(float(p), 3) for p in parts]}", flush=True)
    net.load_state_dict(average)
    return net.eval()


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


def batch(examples: list[Example], rng: np.random.Generator, zoom: tuple[float, float]) -> tuple[Tensor, Tensor]:
    """Images (n, 3, s, s) and targets (n, 7, s / 4, s / 4): heat, use, weight of the box, offset, log size."""
    pairs = [altered(examples[int(rng.integers(len(examples)))], rng, zoom) for _ in range(BATCH)]
    images = np.stack([image for image, _ in pairs])
    wide = torch.from_numpy(images).contiguous(memory_format=torch.channels_last)
    return wide, torch.from_numpy(np.stack([target(boxes) for _, boxes in pairs]))


def altered(example: Example, rng: np.random.Generator, zoom: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """A crop turned by quarters, mirrored, scaled, in other colours: (3, s, s) red green blue 0..1, and its boxes."""
    import cv2

    image, boxes = example.image, example.boxes.copy()
    scale = float(np.exp(rng.uniform(*np.log(zoom)))) if rng.random() < 0.6 else 1.0
    side = min(int(SIZE / scale), CUT)
    scale = SIZE / side
    low = rng.integers(0, CUT - side + 1, 2)
    image = image[low[1] : low[1] + side, low[0] : low[0] + side]
    boxes[:, :2] -= low
    if side != SIZE:
        image = cv2.resize(image, (SIZE, SIZE), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        boxes[:, :2] = (boxes[:, :2] + 0.5) * scale - 0.5
        boxes[:, 2:4] *= scale
    if rng.random() < 0.5:
        image = image[:, ::-1]
        boxes[:, 0] = SIZE - 1 - boxes[:, 0]
    if rng.random() < 0.5:
        image = image[::-1]
        boxes[:, 1] = SIZE - 1 - boxes[:, 1]
    if rng.random() < 0.5:
        image = image.transpose(1, 0, 2)
        boxes[:, :4] = boxes[:, [1, 0, 3, 2]]
    return recoloured(image, rng), boxes


def recoloured(image: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Another white balance, contrast, saturation, gamma; (3, s, s) red green blue, 0..1."""
    x = image[:, :, ::-1].astype(np.float32) / 255.0
    grey = x.mean(2, keepdims=True)
    x = grey + (x - grey) * np.float32(rng.uniform(0.4, 1.6))
    x = x * rng.uniform(0.85, 1.15, 3).astype(np.float32)
    x = np.clip(x, 0.0, 1.0) ** np.float32(np.exp(rng.normal(0.0, 0.25)))
    x = x * np.float32(rng.uniform(0.7, 1.25)) + np.float32(rng.normal(0.0, 0.04))
    if rng.random() < 0.3:
        x = x + rng.normal(0.0, rng.uniform(0.005, 0.04), x.shape).astype(np.float32)
    return np.ascontiguousarray(np.clip(x, 0.0, 1.0).transpose(2, 0, 1), np.float32)


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
    """Focal loss of the heat (Zhou, Wang, Kraehenbuehl, "Objects as Points", 2019, eq. 1), L1 of the boxes."""
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
    return focal + 1.5 * offset + 0.5 * size, (focal.detach(), offset.detach(), size.detach())


if __name__ == "__main__":
    main()
