"""Train the detector on, at the sizes that flowers have before an arm: renderings 0.35 to 0.8 m away.

    python training/refine.py cluster_slam/detect/models/flowers.onnx

The second part of the training: the first sees flowers of all sizes, most of them large. Weights are read from the
file, normalisation folded in.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
import pictures
import torch
from export import write_onnx
from network import FlowerNet
from torch import nn
from train_detector import CUT, SIZE, train

FIRST_SEED = 20_000
SEED = 2


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("model", type=Path)
    options.add_argument("--worlds", type=int, default=24)
    options.add_argument("--steps", type=int, default=600)
    options.add_argument("--limit-s", type=float, default=125.0, help="CPU seconds of training; fewer steps then")
    chosen = options.parse_args()
    torch.manual_seed(SEED)
    torch.set_num_threads(1)
    net = read_network(chosen.model)
    examples = [e for seed in range(FIRST_SEED, FIRST_SEED + chosen.worlds) for e in examples_of(seed)]
    print(f"{len(examples)} crops after {time.process_time():.0f} s of CPU", flush=True)
    net = train(examples, chosen.steps, chosen.limit_s, net=net, rate=1.5e-3, zoom=(SIZE / CUT, 1.1))
    write_onnx(net, chosen.model)
    print(f"written after {time.process_time():.0f} s of CPU", flush=True)


def examples_of(seed: int) -> list[pictures.Example]:
    """Crops of one plant at an arm's distance, every second under the light of a usual session."""
    rng = np.random.default_rng([seed, 79])
    near = rng.uniform(0.35, 0.5)
    changes = {"distance_min_m": near, "distance_max_m": near + 0.3, "focal_px": rng.uniform(400.0, 460.0)}
    if seed % 2:
        changes["look"] = pictures.LookConfig()
    made = pictures.render_world(seed, changes)
    return [e for picture in made for e in pictures.crops(picture, CUT, 2, rng)]


def read_network(path: Path) -> FlowerNet:
    """The network of a file that ``export`` wrote: each convolution in the order of execution."""
    import onnx
    from onnx import numpy_helper

    model = onnx.load(str(path))
    values = {entry.name: numpy_helper.to_array(entry) for entry in model.graph.initializer}
    nodes = [node for node in model.graph.node if node.op_type == "Conv"]
    net = without_normalisation(FlowerNet())
    order: list[nn.Conv2d] = []
    hooks = [
        m.register_forward_pre_hook(lambda m, _: order.append(m)) for m in net.modules() if isinstance(m, nn.Conv2d)
    ]
    with torch.no_grad():
        net(torch.zeros(1, 3, 64, 64))
        for module, node in zip(order, nodes, strict=True):
            module.weight.copy_(torch.from_numpy(values[node.input[1]].copy()))
            module.bias.copy_(torch.from_numpy(values[node.input[2]].copy()))
    for hook in hooks:
        hook.remove()
    return net


def without_normalisation(net: FlowerNet) -> FlowerNet:
    """The same network, its convolutions with a bias in place of batch normalisation."""
    for part in list(net.modules()):
        if isinstance(part, nn.Sequential) and len(part) == 3 and isinstance(part[1], nn.BatchNorm2d):
            c = part[0]
            part[0] = nn.Conv2d(c.in_channels, c.out_channels, c.kernel_size, c.stride, c.padding, groups=c.groups)
            part[1] = nn.Identity()
    return net


if __name__ == "__main__":
    main()
