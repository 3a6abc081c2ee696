"""The refinement net: symmetries, the mask and its reach; the context of pixels is their own
capture.
"""

import pytest
import torch
from torch.nn.functional import normalize
from torch.testing import assert_close

from distributions import seeded
from scenes import parametrize
from splinecli.estimate.fits.least_squares import alternating_signs
from splinecli.estimate.networks.refine_net import (
    COARSEST,
    FEATURE_CHANNELS,
    RefineNet,
    channels,
    split_features,
    with_refined,
)
from splinecli.estimate.refinement.features import (
    MapTurn,
    refine_features,
    turn_features,
    turn_maps,
)
from tiny_networks import TINY, random_network

HEIGHT, WIDTH = 6, 9


def random_net(**settings):
    """A net whose every layer does something."""
    generator = seeded(0)
    net = RefineNet(**settings)
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.copy_(0.1 * torch.randn(parameter.shape, generator=generator))
    return net.eval()


def random_maps(height, width, seed=0):
    generator = seeded(seed)
    mask = (torch.rand(1, 1, height, width, generator=generator) < 0.9).float()
    features = torch.randn(1, FEATURE_CHANNELS, height, width, generator=generator) * mask
    return features, mask


def features_of(observations, lights, normals, error):
    """Features (CHANNELS, H, W) of observations (F, H, W), normals (3, H, W) and error (2, H,
    W).
    """
    rows = [maps.flatten(1).T.contiguous() for maps in (observations, normals, error)]
    features = refine_features(rows[0], lights, rows[1], rows[2], 0.7, alternating_signs(lights))
    return features.T.view(-1, *observations.shape[1:])


@parametrize("mirror", [False, True])
@parametrize("quarters", range(4))
def test_features_turn_with_the_image(quarters, mirror):
    generator = seeded(1)
    lights = normalize(
        torch.randn(8, 3, generator=generator) + torch.tensor((0.0, 0.0, 2.0)), dim=1
    )
    normals = (
        torch.randn(3, HEIGHT, WIDTH, generator=generator)
        + torch.tensor((0.0, 0.0, 2.0))[:, None, None]
    )
    normals = normalize(normals, dim=0)
    error = torch.randn(2, HEIGHT, WIDTH, generator=generator)
    shading = torch.einsum("fc,chw->fhw", lights, normals).clamp(min=0)
    observations = shading**1.5 + 0.05 * torch.rand(8, HEIGHT, WIDTH, generator=generator)

    def turned(vectors):
        """Vectors (3, ...), turned."""
        x, y, z = (-vectors[0] if mirror else vectors[0]), vectors[1], vectors[2]
        for _ in range(quarters):
            x, y = -y, x
        return torch.stack((x, y, z))

    def moved(maps):
        return (maps.flip(-1) if mirror else maps).rot90(quarters, (-2, -1))

    expected = features_of(
        moved(observations), turned(lights.T).T, turned(moved(normals)), moved(error)
    )
    turn = MapTurn(quarters, mirror)
    features = features_of(observations, lights, normals, error)
    found = turn_features(features, turn)
    found_normals = turn_maps(normals, turn, vectors=((0, 1),))
    assert_close(found, expected, atol=2e-4, rtol=1e-4)
    assert_close(found_normals, turned(moved(normals)))
    assert_close(turn_features(found, turn.back), features)
    assert_close(turn_maps(found_normals, turn.back, vectors=((0, 1),)), normals)


@parametrize("twice", [False, True])
def test_a_new_net_changes_nothing(twice):
    features, mask = random_maps(12, 15)
    features[:, :3] = normalize(features[:, :3], dim=1)
    normals, error = RefineNet(twice=twice)(features, mask)
    before, error_before = split_features(features)
    assert_close(normals, before * mask)
    assert_close(error, error_before * mask)


def test_a_second_net_reads_the_results_of_the_first():
    features, mask = random_maps(12, 16)
    both = random_net(twice=True)
    assert both.again is not None
    first = RefineNet()
    first.load_state_dict(
        {name: value for name, value in both.state_dict().items() if "again" not in name}
    )
    normals, error = first(features, mask)
    changed = with_refined(features, normals, error)
    assert_close(split_features(changed), (normals, error))
    for fit in ("robust", "plain"):  # the fits themselves stay
        assert_close(
            changed[:, channels(fit)] + normals,
            features[:, channels(fit)] + features[:, channels("normal")],
        )
    found = both(features, mask, (slice(0, 8), slice(8, 16)))
    for part, whole in zip(found, both.again(changed * mask, mask), strict=True):
        assert_close(part, whole[..., :8, 8:], atol=1e-4, rtol=1e-4)
    assert (found[0] - normals[..., :8, 8:]).abs().max() > 1e-3


@parametrize("twice", [False, True])
def test_outside_of_the_mask_is_outside_of_the_image(twice):
    features, mask = random_maps(20, 24)
    wide = torch.nn.functional.pad(features, (COARSEST, 9, 2 * COARSEST, 3))
    wide_mask = torch.nn.functional.pad(mask, (COARSEST, 9, 2 * COARSEST, 3))
    net = random_net(twice=twice).double()
    box = (..., slice(2 * COARSEST, 2 * COARSEST + 20), slice(COARSEST, COARSEST + 24))
    found = net(features.double(), mask.double()), net(wide.double(), wide_mask.double())
    for alone, within in zip(*found, strict=True):
        assert_close(within[box], alone, atol=1e-5, rtol=1e-5)


SEES = TINY | {"map_size": 16, "set_width": 16, "set_layers": 2, "error_head": True}


def pixels(count, seed=0):
    """Random observations under seven lights."""
    lights = normalize(torch.rand(7, 3, generator=seeded(seed)) + 0.2, dim=1)
    return torch.rand(count, 7, generator=seeded(seed + 1)), lights


@pytest.fixture(scope="module")
def network():
    return random_network(**SEES, sees_capture=True)


def test_a_sample_of_all_pixels_is_the_capture_itself(network):
    observations, lights = pixels(20)
    context = network.encode_context(observations, lights)
    whole = network(observations, lights)
    parts = [network(part, lights, context=context) for part in observations.split(7)]
    assert_close(torch.cat([part.normals for part in parts]), whole.normals, atol=3e-5, rtol=0)
    assert_close(torch.cat([part.error for part in parts]), whole.error, atol=1e-4, rtol=0)
    # It does say something, and the order of the sample does not matter.
    other = network(observations, lights, context=network.encode_context(*pixels(20, 5)))
    assert (other.normals - whole.normals).abs().max() > 1e-3
    shuffled = network.encode_context(observations.flip(0), lights)
    again = network(observations, lights, context=shuffled)
    assert_close(again.normals, whole.normals, atol=3e-5, rtol=0)


def test_captures_of_a_batch_do_not_see_each_other(network):
    captures = [pixels(9, seed) for seed in (0, 10, 20)]
    # Pixel p belongs to capture p % 3.
    observations = torch.stack([seen for seen, _ in captures], dim=1).flatten(0, 1)
    lights = torch.stack([lights.expand(9, 7, 3) for _, lights in captures], dim=1).flatten(0, 1)
    maps = network.build_maps(observations, lights)
    together = network.estimate(maps, network.interpolate(maps), captures=3)
    for number, (seen, own) in enumerate(captures):
        maps = network.build_maps(seen, own)
        alone = network.estimate(maps, network.interpolate(maps))
        # Processors with AMX round sums of other sizes of batches differently; another capture
        # would change 0.01.
        assert_close(together.normals[number::3], alone.normals, atol=3e-4, rtol=0)


def test_the_exposure_of_a_capture_does_not_matter_but_the_brightness_of_a_pixel_does(network):
    observations, lights = pixels(16)
    whole = network(observations, lights).normals
    assert_close(network(37 * observations, lights).normals, whole, atol=1e-5, rtol=0)
    darker = observations * torch.linspace(0.1, 1, 16)[:, None]
    assert (network(darker, lights).normals - whole).abs().max() > 1e-3
