"""The detector's network: depthwise-separable, boxes at a quarter of the picture's size."""

from __future__ import annotations

import torch
from torch import Tensor, nn

STRIDE = 4
WIDTHS = (16, 48, 80, 128)  # at strides 2, 4, 8, 16; multiples of 16 cost onnxruntime least


def _conv(a: int, b: int, kernel: int, stride: int = 1, groups: int = 1, padding: int | None = None) -> nn.Sequential:
    border = kernel // 2 if padding is None else padding
    return nn.Sequential(
        nn.Conv2d(a, b, kernel, stride, border, groups=groups, bias=False),
        nn.BatchNorm2d(b),
        nn.ReLU(inplace=True),
    )


class Block(nn.Module):
    """Depthwise, then pointwise; with a shortcut where the shape stays."""

    def __init__(self, a: int, b: int, kernel: int = 3, stride: int = 1) -> None:
        super().__init__()
        self.deep = _conv(a, a, kernel, stride, groups=a)
        self.wide = _conv(a, b, 1)
        self.is_same = a == b and stride == 1

    def forward(self, x: Tensor) -> Tensor:
        y = self.wide(self.deep(x))
        return x + y if self.is_same else y


class FlowerNet(nn.Module):
    """Per cell: a flower's middle (logit), its offset in cells, log width and height in cells, how good the box is."""

    def __init__(self) -> None:
        super().__init__()
        a, b, c, d = WIDTHS
        self.at2 = _conv(3, a, 3, 2)
        self.at4 = nn.Sequential(_conv(a, b, 2, 2, padding=0), Block(b, b))
        self.at8 = nn.Sequential(Block(b, c, 3, 2), Block(c, c), Block(c, c), Block(c, c))
        self.at16 = nn.Sequential(Block(c, d, 3, 2), Block(d, d, 5), Block(d, d, 5), Block(d, d, 5))
        self.up16 = _conv(d, c, 1)
        self.mix8 = Block(c, c)
        self.up8 = _conv(c, b, 1)
        self.mix4 = nn.Sequential(Block(b, b, 5), Block(b, b))
        self.head = nn.Conv2d(b, 6, 1)
        with torch.no_grad():
            self.head.bias.copy_(torch.tensor([-4.0, 0.0, 0.0, 1.2, 1.2, 0.0]))

    def forward(self, x: Tensor) -> Tensor:
        """(n, 3, h, w) in 0..1 to (n, 6, h / 4, w / 4)."""
        x4 = self.at4(self.at2(x))
        x8 = self.at8(x4)
        x16 = self.at16(x8)
        x8 = self.mix8(x8 + nn.functional.interpolate(self.up16(x16), scale_factor=2.0, mode="nearest"))
        x4 = self.mix4(x4 + nn.functional.interpolate(self.up8(x8), scale_factor=2.0, mode="nearest"))
        return self.head(x4)


def decoded(raw: Tensor) -> Tensor:
    """Boxes (n, 4, h, w), cx cy w h in cells from the picture's corner, of what the network says."""
    x = torch.arange(raw.shape[3], dtype=raw.dtype).view(1, 1, 1, -1) + 0.5
    y = torch.arange(raw.shape[2], dtype=raw.dtype).view(1, 1, -1, 1) + 0.5
    size = torch.exp(torch.clamp(raw[:, 3:5], -2.0, 5.0))
    return torch.cat([raw[:, 1:2] + x, raw[:, 2:3] + y, size], 1)


class Exported(nn.Module):
    """The network with the outputs of a YOLOv8 export: (1, 5, cells) of cx, cy, w, h in pixels and the score.

    Cells about one flower's middle give about the same box; suppression of boxes leaves the best. To keep only cells
    that are the best of their neighbours would lose flowers that stand close together.
    """

    def __init__(self, net: FlowerNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, images: Tensor) -> Tensor:
        raw = self.net(images)
        boxes = decoded(raw) * STRIDE
        boxes = torch.cat([boxes[:, :2] - 0.5, boxes[:, 2:]], 1)  # pixel centres at whole numbers
        score = torch.sqrt(torch.sigmoid(raw[:, :1]) * torch.sigmoid(raw[:, 5:]))
        return torch.cat([boxes, score], 1).flatten(2)
