"""NE-Net, the normal estimation network: sparse and dense observation map -> normal."""

import torch
from torch import Tensor, nn

from splinecli.networks.config import NetworkConfig
from splinecli.networks.error_head import ErrorHead
from splinecli.networks.layers import PATCH, MapEncoder, zeroed

DROPOUT = 0.2  # share of the channels that the paper size drops in training


class PaperNENet(nn.Module):
    """The authors' CNN-PS (Ikehata, ECCV 2018) on two maps: (P, channels, w, w) to (P, 3), not of unit length.

    It has 2.65 M parameters for two channels of 32 x 32, nearly all of them in the 20480 x 128 layer. As in the
    authors' code, no ReLU comes before the last 1x1 conv or between the two linear layers, and the pooling
    windows overlap: 4 x 4 at a stride of 2. Dropout removes whole channels, in training only. The authors leave it on
    when they test, which adds noise to their normals.
    """

    def __init__(self, channels: int, map_size: int) -> None:
        super().__init__()
        self.stem = nn.Conv2d(channels, 16, 3, padding=1)
        self.dense1 = _DenseBlock(16)
        self.transition1 = nn.Conv2d(48, 48, 1)
        self.dropout = nn.Dropout2d(DROPOUT)
        self.pool = nn.AvgPool2d(4, stride=2, padding=1)
        self.dense2 = _DenseBlock(48)
        self.transition2 = nn.Conv2d(80, 80, 1)
        self.hidden = nn.Linear(80 * (map_size // 2) ** 2, 128)
        self.out = nn.Linear(128, 3)

    def forward(self, maps: Tensor) -> Tensor:
        x = self.dense1(self.stem(maps))
        x = self.pool(self.dropout(self.transition1(torch.relu(x))))
        x = self.transition2(self.dense2(x))
        out: Tensor = self.out(self.hidden(x.flatten(1)))
        return out


class _DenseBlock(nn.Module):
    """Two 3x3 convs of 16 channels, each concatenated to its input: (P, C, ...) to (P, C + 32, ...)."""

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, 16, 3, padding=1)
        self.second = nn.Conv2d(width + 16, 16, 3, padding=1)
        self.dropout = nn.Dropout2d(DROPOUT)

    def forward(self, x: Tensor) -> Tensor:
        for conv in (self.first, self.second):
            x = torch.cat((x, self.dropout(conv(torch.relu(x)))), dim=1)
        return x


class CompactNENet(nn.Module):
    """Maps (P, 4 or 5, w, w) and starting normals (P, K + 1, 3) to normals (P, 3), not of unit length.

    The result is a weighted sum of the starting normals plus a correction. At first the first normal has weight 1, and
    all else is zero. With K = 0 this weight is fixed. Features (P, set_width) of the set branch join the hidden layer.
    The second result is that of the error head (P, 2), None without one.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        width, head_width = config.width, config.head_width
        fits = len(config.fits) + bool(config.set_width)
        self.encoder = MapEncoder(4 + config.interpolates, width, config.ne_blocks, config.map_size)
        self.squeeze = nn.Conv2d(width, width // 2, 1)
        side = config.map_size // PATCH
        self.hidden = nn.Linear(width // 2 * side * side, head_width)
        self.out = zeroed(nn.Linear(head_width, 3))
        self.compare: nn.Linear | None = None
        self.weigh: nn.Linear | None = None
        if fits:
            self.compare = nn.Linear(3 * fits, head_width, bias=False)
            self.weigh = nn.Linear(head_width, fits + 1)
            nn.init.zeros_(self.weigh.weight)
            with torch.no_grad():
                self.weigh.bias.copy_(torch.arange(fits + 1) == 0)
        self.join = nn.Linear(config.set_width, head_width, bias=False) if config.set_width else None
        self.error_head = ErrorHead(head_width, fits + 2) if config.error_head else None

    def forward(
        self, maps: Tensor, normals: Tensor, set_features: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None]:
        features = torch.relu(self.squeeze(torch.relu(self.encoder(maps))))
        # Patches first, channels last: this is the order in memory, so flattening does not copy.
        hidden = self.hidden(features.permute(0, 2, 3, 1).flatten(1))
        if self.join is not None and set_features is not None:
            hidden = hidden + self.join(set_features)
        if self.compare is None or self.weigh is None:
            start = normals[:, 0]
        else:
            hidden = hidden + self.compare(normals[:, 1:].flatten(1))
            # In float32 whatever the layers compute in, because the sum needs the digits of the normals.
            weight = self.weigh(torch.relu(hidden)).float()
            start = (weight[..., None] * normals).sum(dim=1)
        hidden = torch.relu(hidden)
        out: Tensor = start + self.out(hidden)
        if self.error_head is None:
            return out, None
        return out, self.error_head(hidden, torch.cat((normals, out[:, None].to(normals.dtype)), dim=1))
