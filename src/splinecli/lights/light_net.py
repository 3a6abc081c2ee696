"""The light network, which estimates the light direction and relative intensity of each image in a
capture.
"""

from functools import cache
from importlib import resources
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn.functional import interpolate, normalize, pad, softplus

from splinecli.system.weight_files import SHIPPED, load_module

LIGHT_NET, LIGHT_FORMAT = "light-net.safetensors", "splinecli-light-net-1"

SIDE = 48  # height and width of the input images
INPUTS = 4


class LightGuess(NamedTuple):
    """Estimated lights of the F images in each of B captures."""

    directions: Tensor  # (B, F, 3), unit; the modes of von Mises-Fisher distributions
    sharpness: Tensor  # (B, F), the logarithms of the concentrations of these distributions
    # (B, F), the logarithms of the intensities; their mean over each capture is zero
    log_intensities: Tensor
    bump: Tensor  # (B,), the logit that the object is a bump rather than a hollow


class LightNet(nn.Module):
    """An encoder shared by all images, which exchanges information between the images at three
    depths.

    At each depth, the features of an image are concatenated with the maximum and the mean over all
    images. LCNet (Chen et al., "Self-calibrating deep photometric stereo networks", CVPR 2019) does
    this once.
    """

    def __init__(self) -> None:
        super().__init__()
        fine, local, middle, coarse, joined, hidden = 32, 64, 128, 192, 96, 256
        self.enter = nn.Conv2d(INPUTS, fine, 4, stride=2, padding=1)
        self.local = nn.ModuleList(
            (
                nn.Conv2d(fine, local, 3, stride=2, padding=1),
                *(nn.Conv2d(local, local, 3, padding=1) for _ in range(3)),
            )
        )
        self.join1 = nn.Conv2d(3 * local, joined, 1)
        self.middle = nn.ModuleList(
            (
                nn.Conv2d(joined, middle, 3, stride=2, padding=1),
                *(nn.Conv2d(middle, middle, 3, padding=1) for _ in range(3)),
            )
        )
        self.join2 = nn.Conv2d(3 * middle, coarse, 1)
        self.coarse = nn.Conv2d(coarse, coarse, 3, stride=2, padding=1)
        self.flat = nn.Linear(coarse * (SIDE // 16) ** 2, hidden)
        self.join3 = nn.Linear(3 * hidden, hidden)
        self.out = nn.Linear(hidden, 6)

    def forward(self, images: Tensor) -> LightGuess:
        """Estimate the lights of images (B, F, INPUTS, SIDE, SIDE); see network_inputs."""
        captures, lights = images.shape[:2]
        x = torch.relu(
            self.enter(images.flatten(0, 1).contiguous(memory_format=torch.channels_last))
        )
        x = torch.relu(self.local[0](x))
        for layer in self.local[1:]:
            x = torch.relu(x + layer(x))
        x = torch.relu(self.join1(_with_all(x, lights)))
        x = torch.relu(self.middle[0](x))
        for layer in self.middle[1:]:
            x = torch.relu(x + layer(x))
        x = torch.relu(self.join2(_with_all(x, lights)))
        x = torch.relu(self.flat(torch.relu(self.coarse(x)).flatten(1)))
        x = torch.relu(x + self.join3(_with_all(x, lights)))
        found = self.out(x).float().view(captures, lights, 6)  # bfloat16 in training
        height = softplus(found[..., 2:3] + 1)
        # The limits correspond to errors of 90 degrees and 1 degree.
        sharpness = (3 + found[..., 3]).clamp(-2.0, 8.5)
        intensities = found[..., 4] - found[..., 4].mean(dim=1, keepdim=True)
        directions = normalize(torch.cat((found[..., :2], height), dim=-1), dim=-1)
        return LightGuess(directions, sharpness, intensities, found[..., 5].mean(dim=1))


def _with_all(x: Tensor, lights: int) -> Tensor:
    """Concatenate features (B * F, C, ...) with their maximum and mean over the images of each
    capture.
    """
    each = x.view(-1, lights, *x.shape[1:])
    largest, mean = each.amax(dim=1, keepdim=True), each.mean(dim=1, keepdim=True)
    return torch.cat((each, largest.expand_as(each), mean.expand_as(each)), dim=2).flatten(0, 1)


def network_inputs(images: Tensor, mask: Tensor) -> Tensor:
    """Return the input channels (F, INPUTS, H, W) for linear, non-negative images (F, H, W) of any
    scale.

    The channels are the image; the ratio between the image and the mean of all images, which hardly
    depends on the material; this mean; and the mask (H, W), 1 on the object and 0 elsewhere. The
    image and the mean are square roots, relative to the object's mean brightness.
    """
    images = images * mask
    mean = images.mean(dim=0)
    typical = (mean.sum() / mask.sum().clamp(min=1)).clamp(min=1e-6)
    root = (images / typical).clamp(0, 16).sqrt() - 0.8 * mask
    ratio = ((images / (mean + 0.02 * typical)).clamp(0, 4) - 1) * mask
    mean_root = (mean / typical).sqrt().clamp(max=3).expand_as(images)
    return torch.stack((root, ratio, mean_root, mask.expand_as(images)), dim=1)


def square_images(images: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Crop images (F, H, W) to the bounding box of a mask (H, W), pad them to squares and resize
    them.

    Returns images (F, SIDE, SIDE), averaged over the mask's pixels, and the mask (SIDE, SIDE) as
    zeros and ones.
    """
    rows, columns = (mask.any(dim=1 - axis).nonzero()[:, 0] for axis in (0, 1))
    box = slice(int(rows[0]), int(rows[-1]) + 1), slice(int(columns[0]), int(columns[-1]) + 1)
    inside = mask[box].float()
    height, width = inside.shape
    side = max(height, width)
    top, left = (side - height) // 2, (side - width) // 2
    weighed = torch.cat((images[:, *box] * inside, inside[None]))
    weighed = pad(weighed, (left, side - width - left, top, side - height - top))
    mode = "area" if side > SIDE else "bilinear"
    small = interpolate(weighed[None], (SIDE, SIDE), mode=mode)[0]
    share = small[-1]
    return small[:-1] / share.clamp(min=0.25), (share > 0.5).float()


@cache
def light_net() -> LightNet:
    """Return the light network (float32, evaluation mode). Raises ModelError."""
    with resources.as_file(SHIPPED / LIGHT_NET) as path:
        return load_module(LightNet(), path, LIGHT_FORMAT).float().eval()
