"""LI-Net, the lighting interpolation network: sparse observation map -> dense observation map."""

import torch
from torch import Tensor, nn

from splinecli.networks.config import NetworkConfig
from splinecli.networks.layers import PATCH, MapEncoder, zeroed


class PaperLINet(nn.Module):
    """The authors' LI-Net (Zheng et al., ICCV 2019): (P, 1, w, w) to the same shape, in 0..1; 8.40 M parameters.

    Its layers are a 7x7 conv to 64 channels, two 4x4 convs of stride 2 to 128 and 256, six residual blocks, two
    transposed convs back, a 7x7 conv and a sigmoid. No conv has a bias. An instance norm with a scale and an offset for
    each channel follows every conv but the last. It normalises by the statistics of each map, also after training:
    the authors track running statistics but never use them.
    """

    def __init__(self) -> None:
        super().__init__()

        def normed(conv: nn.Module, width: int) -> list[nn.Module]:
            return [conv, nn.InstanceNorm2d(width, affine=True), nn.ReLU(inplace=True)]

        self.layers = nn.Sequential(
            *normed(nn.Conv2d(1, 64, 7, padding=3, bias=False), 64),
            *normed(nn.Conv2d(64, 128, 4, stride=2, padding=1, bias=False), 128),
            *normed(nn.Conv2d(128, 256, 4, stride=2, padding=1, bias=False), 256),
            *(_PaperResidualBlock(256) for _ in range(6)),
            *normed(nn.ConvTranspose2d(256, 128, 4, stride=2, padding=1, bias=False), 128),
            *normed(nn.ConvTranspose2d(128, 64, 4, stride=2, padding=1, bias=False), 64),
            nn.Conv2d(64, 1, 7, padding=3, bias=False),
        )

    def forward(self, sparse: Tensor) -> Tensor:
        return torch.sigmoid(self.layers(sparse))


class _PaperResidualBlock(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Conv2d(width, width, 3, padding=1, bias=False),
            nn.InstanceNorm2d(width, affine=True),
            nn.ReLU(inplace=True),
            nn.Conv2d(width, width, 3, padding=1, bias=False),
            nn.InstanceNorm2d(width, affine=True),
        )

    def forward(self, x: Tensor) -> Tensor:
        out: Tensor = x + self.layers(x)
        return out


class CompactLINet(nn.Module):
    """An encoder-decoder on 4 x 4 patches, from (P, 4, w, w) to a correction (P, 1, w, w) that is zero at first."""

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.encoder = MapEncoder(4, config.width, config.li_blocks, config.map_size)
        self.decoder = zeroed(nn.Conv2d(config.width, PATCH**2, 1))

    def forward(self, maps: Tensor) -> Tensor:
        return nn.functional.pixel_shuffle(self.decoder(torch.relu(self.encoder(maps))), PATCH)
