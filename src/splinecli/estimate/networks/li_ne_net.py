"""LI-Net and NE-Net, their layers, and the heads that estimate the errors of normals."""

import math
from typing import TypeVar

import torch
from torch import Tensor, nn
from torch.nn.functional import linear, pixel_shuffle, pixel_unshuffle

from splinecli.estimate.networks.config import NetworkConfig
from splinecli.maths.pixel_grid import slices

PATCH = 4  # side length in cells of the patches that an encoder combines into one position
Layer = TypeVar("Layer", nn.Conv2d, nn.Linear)


def zeroed(layer: Layer) -> Layer:
    """Set the weights and offsets of a layer to zero and return it, so that its correction is zero
    at first.
    """
    for parameter in layer.parameters():
        nn.init.zeros_(parameter)
    return layer


class ResidualBlock(nn.Module):
    """x + conv3x3(relu(conv3x3(relu(x)))) on (P, C, h, w), zero outside the mask, if given.

    It has no normalisation and starts as the identity.
    """

    def __init__(self, width: int) -> None:
        super().__init__()
        self.first = nn.Conv2d(width, width, 3, padding=1)
        self.second = zeroed(nn.Conv2d(width, width, 3, padding=1))

    def forward(self, x: Tensor, mask: Tensor | None = None) -> Tensor:
        hidden: Tensor = self.first(torch.relu(x))
        # In place, because a tile's maps of 32 channels determine the memory required.
        change: Tensor = self.second((hidden if mask is None else hidden.mul_(mask)).relu_())
        if mask is not None:
            change.mul_(mask)
        return change.add_(x) if change.dtype == x.dtype else x + change


_SIDE = 4  # patches along a side of the maps for which winograd_conv is written
AT_ONCE = 256  # pixels whose features stay in a processor's cache


# The transforms F(4, 3) of values, weights and products (Lavin and Gray, Fast algorithms for
# convolutional neural networks, CVPR 2016, equation 13). The first and the last of six values are
# padding: their columns are left out.
_OF_VALUES = torch.tensor(
    ((0, -5, 0, 1), (-4, -4, 1, 1), (4, -4, -1, 1), (-2, -1, 2, 1), (2, -1, -2, 1), (4, 0, -5, 0)),
    dtype=torch.float32,
)
_OF_WEIGHTS = (
    torch.tensor(((6, 0, 0), (-4, -4, -4), (-4, 4, -4), (1, 2, 4), (1, -2, 4), (0, 0, 24))) / 24
)
_OF_PRODUCTS = torch.tensor(
    ((1, 1, 1, 1, 1, 0), (0, 1, -1, 2, -2, 0), (0, 1, 1, 4, 4, 0), (0, 1, -1, 8, -8, 1)),
    dtype=torch.float32,
)


def _transformed(values: Tensor, transform: Tensor) -> Tensor:
    """Return the transform (m, n) of values (n * n, ...) in both directions: (m * m, ...)."""
    m, n = transform.shape
    rows = (transform @ values.reshape(n, -1)).view(m, n, -1)
    return torch.bmm(transform.expand(m, m, n), rows).view(m * m, *values.shape[1:])


def winograd_weights(weight: Tensor) -> Tensor:
    """Return the transformed weights (36, C, D) of a convolution (D, C, 3, 3)."""
    return _transformed(weight.permute(2, 3, 1, 0).flatten(0, 1), _OF_WEIGHTS)


def winograd_conv(x: Tensor, transformed: Tensor, bias: Tensor | None) -> Tensor:
    """Convolve maps (16, P, C) of 4 x 4 positions with `winograd_weights`, padded with zeros:
    (16, P, D).

    It takes 36 products for the 144 of a convolution.
    """
    products = torch.bmm(_transformed(x, _OF_VALUES), transformed)
    if bias is not None:
        products[7] += bias  # the transform adds this product to all positions, with a factor of 1
    return _transformed(products, _OF_PRODUCTS)


def is_float32(values: Tensor) -> bool:
    """Return whether the layers compute in float32 on the CPU: autocast is off, and so are the
    values.
    """
    autocast = torch.is_autocast_enabled(values.device.type)
    return values.device.type == "cpu" and values.dtype == torch.float32 and not autocast


class MapEncoder(nn.Module):
    """Encodes maps (P, C, w, w) as features (P, width, w / 4, w / 4).

    Each patch of 4 x 4 cells becomes one position, which is fast on a CPU. Each position gets a
    learned embedding, because cells are light directions, so unlike a photograph, a map is not
    translation invariant.
    """

    def __init__(self, channels: int, width: int, blocks: int, map_size: int) -> None:
        super().__init__()
        side = map_size // PATCH
        self.patches = nn.Conv2d(channels * PATCH**2, width, 1)
        self.position = nn.Parameter(torch.zeros(1, width, side, side))
        self.blocks = nn.Sequential(*(ResidualBlock(width) for _ in range(blocks)))

    def forward(self, maps: Tensor) -> Tensor:
        if maps.shape[-1] == _SIDE * PATCH and not torch.is_grad_enabled() and is_float32(maps):
            return self._few_products(maps)
        patches = pixel_unshuffle(maps, PATCH).contiguous(memory_format=torch.channels_last)
        entered: Tensor = self.patches(patches)
        # In training, the sums over the blocks stay in float32.
        kind = self.position.dtype if torch.is_grad_enabled() else entered.dtype
        features: Tensor = self.blocks(entered + self.position.to(kind))
        return features

    def _few_products(self, maps: Tensor) -> Tensor:
        """Return the same features of maps of 4 x 4 patches by Winograd's algorithm, in half
        of the time.
        """
        convolutions = [layer for layer in self.blocks.modules() if isinstance(layer, nn.Conv2d)]
        layers = [(winograd_weights(layer.weight), layer.bias) for layer in convolutions]
        position = self.position.flatten(2).permute(2, 0, 1)
        found = maps.new_empty(len(maps), _SIDE**2, self.position.shape[1])
        for part in slices(len(maps), AT_ONCE):
            # (P, C, rows, y, columns, x) to (rows, columns, P, C, y, x)
            split = maps[part].view(-1, maps.shape[1], _SIDE, PATCH, _SIDE, PATCH)
            patches = split.permute(2, 4, 0, 1, 3, 5).reshape(
                _SIDE**2, -1, self.patches.in_channels
            )
            x = linear(patches, self.patches.weight.flatten(1), self.patches.bias) + position
            # The two convolutions of each residual block
            for first, second in zip(layers[::2], layers[1::2], strict=True):
                x = winograd_conv(winograd_conv(x.relu(), *first).relu_(), *second).add_(x)
            found[part] = x.transpose(0, 1)
        return found.transpose(1, 2).view(-1, self.position.shape[1], _SIDE, _SIDE)


HIDDEN = 64


class ErrorHead(nn.Module):
    """Estimates a log-logistic distribution of the error (P, 2) from NE-Net's hidden features and
    its normals.

    The first number is the logarithm of the median error in radians, with MORE_DEG added. The
    second is the logarithm of the distribution's shape: a larger shape means a narrower
    distribution. The other layers are fixed while the head is trained, so it does not change the
    normals.
    """

    def __init__(self, features: int, normals: int) -> None:
        super().__init__()
        self.layers = nn.Sequential(
            nn.Linear(features + 3 * normals, HIDDEN), nn.ReLU(), nn.Linear(HIDDEN, 2)
        )

    def forward(self, features: Tensor, normals: Tensor) -> Tensor:
        """Estimate from features (P, C) and normals (P, K, 3): the fitted normals, and the estimate
        before scaling.
        """
        error: Tensor = self.layers(
            torch.cat((features, normals.flatten(1).to(features.dtype)), dim=1)
        )
        return error.float()


# Added to all errors. Otherwise the logarithm would emphasise differences between tiny errors.
MORE_DEG = 0.1


def probability_within(error: Tensor, limit_deg: float) -> Tensor:
    """Return the probability (P,) that the error is at most limit_deg."""
    median, shape = error.unbind(-1)
    return torch.sigmoid(shape.exp() * (math.log(math.radians(limit_deg + MORE_DEG)) - median))


def median_error_deg(error: Tensor) -> Tensor:
    """Return the medians (P,) of distributions (P, 2) in degrees."""
    return error[:, 0].exp().rad2deg() - MORE_DEG


PIXEL_FEATURES, CAPTURE_FEATURES = 2, 20  # numbers of features from confidence.py
_MOST = 4.0  # largest deviation of a feature from its mean, in standard deviations
_INPUTS = 2 + PIXEL_FEATURES + CAPTURE_FEATURES


class CaptureHead(nn.Module):
    """Adjusts log-logistic distributions of errors (P, 2), whose two numbers are described in
    ErrorHead.

    Wrong lights and values add an error of their own, whatever error the network predicts. The new
    median is therefore the scaled old one, plus one predicted from the features, plus a share of
    the rotation due to gamma-encoded values. The head is small on purpose: it was trained on only
    hundreds of captures.
    """

    mean: Tensor
    spread: Tensor

    def __init__(self, hidden: int = 48) -> None:
        super().__init__()
        self.register_buffer("mean", torch.zeros(_INPUTS))
        self.register_buffer("spread", torch.ones(_INPUTS))
        self.hidden = nn.Linear(_INPUTS, hidden)
        self.last = nn.Linear(hidden, 3)
        self.linear = nn.Linear(_INPUTS, 3)
        self.bend = nn.Parameter(torch.tensor(math.log(0.6)))
        for layer in (self.last, self.linear):
            nn.init.zeros_(layer.weight)
            nn.init.zeros_(layer.bias)
        with torch.no_grad():
            # The initial logarithm of the median error in radians
            self.linear.bias[1] = -3.5

    def forward(self, errors: Tensor, pixels: Tensor, capture: Tensor) -> Tensor:
        """Return the adjusted distributions (P, 2) of the errors (P, 2), from features of the
        pixels (P, 2).

        The features of the capture (20,) or (P, 20) are in the order of CaptureFeatures. NaN means
        unknown.
        """
        own = torch.cat((errors, pixels), dim=1)
        count = own.shape[1]
        own, shared = (
            ((values - mean) / spread).nan_to_num(0.0).clamp(-_MOST, _MOST)
            for values, mean, spread in zip(
                (own, capture),
                self.mean.tensor_split((count,)),
                self.spread.tensor_split((count,)),
                strict=True,
            )
        )

        def apply(layer: nn.Linear) -> Tensor:
            # The features of the capture are usually those of all pixels, so they are one product.
            of_pixels, of_capture = layer.weight.tensor_split((count,), dim=1)
            return linear(own, of_pixels) + linear(shared, of_capture, layer.bias)

        found = apply(self.linear) + self.last(apply(self.hidden).tanh())
        median = torch.logaddexp(errors[:, 0] + found[:, 0], found[:, 1])
        # Gamma-encoded values rotate the normals by about this angle, however good the fit is
        # otherwise.
        # 11 is the index of CaptureFeatures.bend_turn
        bent = capture[..., 11] + math.log(math.pi / 180) + self.bend
        median = torch.logaddexp(median, bent.expand(len(errors)))
        return torch.stack((median, errors[:, 1] + found[:, 2]), dim=1)


class PaperLINet(nn.Module):
    """The authors' LI-Net (Zheng et al., ICCV 2019): (P, 1, w, w) to the same shape, in 0..1; 8.40
    M parameters.

    Its layers are a 7x7 conv to 64 channels, two 4x4 convs of stride 2 to 128 and 256, six residual
    blocks, two transposed convs back, a 7x7 conv and a sigmoid. No conv has a bias. An instance
    norm with a scale and an offset per channel follows every conv but the last. It normalises by
    the statistics of each map, even after training: the authors track running statistics but never
    use them.
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
    """An encoder-decoder on 4 x 4 patches, from (P, 4, w, w) to a correction (P, 1, w, w) that is
    zero at first.
    """

    def __init__(self, config: NetworkConfig) -> None:
        super().__init__()
        self.encoder = MapEncoder(4, config.width, config.li_blocks, config.map_size)
        self.decoder = zeroed(nn.Conv2d(config.width, PATCH**2, 1))

    def forward(self, maps: Tensor) -> Tensor:
        return pixel_shuffle(self.decoder(torch.relu(self.encoder(maps))), PATCH)


DROPOUT = 0.2  # share of the channels dropped in training at the paper size


class PaperNENet(nn.Module):
    """The authors' CNN-PS (Ikehata, ECCV 2018) on two maps: (P, channels, w, w) to (P, 3), not of
    unit length.

    It has 2.65 M parameters for two channels of 32 x 32, nearly all of them in the 20480 x 128
    layer. As in the authors' code, no ReLU comes before the last 1x1 conv or between the two linear
    layers, and the pooling windows overlap: 4 x 4 at a stride of 2. Dropout removes whole channels,
    in training only. The authors leave it enabled at test time, which adds noise to their normals.
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
    """Two 3x3 convs of 16 channels, each concatenated to its input: (P, C, ...) to (P, C + 32,
    ...).
    """

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
    """Maps (P, 4 or 5, w, w) and starting normals (P, K + 1, 3) to normals (P, 3), not of unit
    length.

    The result is a weighted sum of the starting normals plus a correction. Initially the first
    normal has weight 1, and all else is zero. With K = 0 this weight is fixed. Features (P,
    set_width) from the set branch are added to the hidden layer. The second result is the output of
    the error head (P, 2), None without one.
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
                self.weigh.bias.zero_()[0] = 1
        self.join: nn.Linear | None = None
        if config.set_width:
            self.join = nn.Linear(config.set_width, head_width, bias=False)
        self.error_head = ErrorHead(head_width, fits + 2) if config.error_head else None

    def forward(
        self, maps: Tensor, normals: Tensor, set_features: Tensor | None = None
    ) -> tuple[Tensor, Tensor | None]:
        features = torch.relu(self.squeeze(torch.relu(self.encoder(maps))))
        # Patches first, channels last, as in memory, so flattening does not copy.
        hidden = self.hidden(features.permute(0, 2, 3, 1).flatten(1))
        if self.join is not None and set_features is not None:
            hidden = hidden + self.join(set_features)
        if self.compare is None or self.weigh is None:
            start = normals[:, 0]
        else:
            hidden = hidden + self.compare(normals[:, 1:].flatten(1))
            # Always in float32, because the sum needs the full precision of the normals.
            weight = self.weigh(torch.relu(hidden)).float()
            start = (weight[..., None] * normals).sum(dim=1)
        hidden = torch.relu(hidden)
        out: Tensor = start + self.out(hidden)
        if self.error_head is None:
            return out, None
        return out, self.error_head(
            hidden, torch.cat((normals, out[:, None].to(normals.dtype)), dim=1)
        )
