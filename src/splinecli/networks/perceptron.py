"""A small perceptron that learns the normals and the errors of another estimator on the pixels of one capture."""

from collections.abc import Callable

import torch
from torch import Tensor, nn

from splinecli.fits.least_squares import weighted_least_squares
from splinecli.maths.observation_map import map_scale
from splinecli.system.machine import one_thread_each

BATCH = 256
_LEARNING_RATE = 3e-3
_WEIGHT_DECAY = 1e-4
_ROUNDED = 0.02  # radians; the loss is the angle, but quadratic below this one
_WEIGHT_OF_ERRORS = 0.05


class Perceptron(nn.Module):
    """Corrects the least-squares normal of a pixel from its observations, in the capture's order of lights.

    The light directions are (F, 3), unit; or (P, F, 3) of some pixels, where near lamps give each its own. The hidden
    layers are `width` wide. The generator draws the weights.
    """

    solve: Tensor | None
    mean: Tensor
    spread: Tensor

    def __init__(self, light_directions: Tensor, width: int, generator: torch.Generator) -> None:
        super().__init__()
        near = light_directions.ndim == 3
        n_inputs = light_directions.shape[-2] + (6 if near else 3)
        self.register_buffer("solve", None if near else torch.linalg.pinv(light_directions.double()).T.float())
        self.register_buffer("mean", torch.zeros(n_inputs))
        self.register_buffer("spread", torch.ones(n_inputs))
        with torch.random.fork_rng(devices=[]):  # the layers draw weights that are replaced below
            hidden = [nn.Linear(wide, width) for wide in (n_inputs, width, width)]
            self.last = nn.Linear(width, 5)
        for layer in (*hidden, self.last):
            nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu", generator=generator)
            nn.init.zeros_(layer.bias)
        nn.init.zeros_(self.last.weight)  # learning begins at least squares
        self.hidden = nn.Sequential(*(part for layer in hidden for part in (layer, nn.ReLU())))

    def inputs(self, observations: Tensor, light_directions: Tensor) -> Tensor:
        """Return observations (P, F) scaled to a largest of 1, and least-squares normals: (P, F + 3).

        Between them stands the mean direction (P, 3) of lights (P, F, 3), because it says where a pixel is.
        """
        scaled = observations / map_scale(observations)
        if self.solve is not None:
            return torch.cat((scaled, nn.functional.normalize(scaled @ self.solve, dim=1)), dim=1)
        fitted, _ = weighted_least_squares(scaled, light_directions, torch.ones_like(scaled))
        return torch.cat((scaled, light_directions.mean(dim=1), nn.functional.normalize(fitted, dim=1)), dim=1)

    def forward(self, inputs: Tensor, *, bfloat16: bool = False) -> tuple[Tensor, Tensor]:
        """Return unit normals (P, 3) and the distributions of their errors (P, 2); see networks/error_head.py.

        Args:
            inputs: (P, C), see `inputs`.
            bfloat16: whether the hidden layers compute in it. The rest is in float32.
        """
        scaled = (inputs - self.mean) / self.spread
        with torch.autocast(inputs.device.type, dtype=torch.bfloat16, enabled=bfloat16):
            hidden = self.hidden(scaled)
        found = self.last(hidden.to(inputs.dtype))
        return nn.functional.normalize(inputs[:, -3:] + found[:, :3], dim=1), found[:, 3:]

    @one_thread_each()
    def learn(
        self,
        inputs: Tensor,
        normals: Tensor,
        errors: Tensor,
        *,
        steps: int,
        generator: torch.Generator,
        progress: Callable[[], object] | None = None,
    ) -> None:
        """Learn the normals (P, 3) and errors (P, 2) of pixels with inputs (P, C). Calls `progress` after each step."""
        with torch.no_grad():
            self.last.bias[3:] = errors.mean(dim=0)
        self.mean.copy_(inputs.mean(dim=0))
        self.spread.copy_(inputs.std(dim=0) + 1e-3)
        optimiser = torch.optim.AdamW(
            self.parameters(), lr=_LEARNING_RATE, weight_decay=_WEIGHT_DECAY, betas=(0.9, 0.99), fused=True
        )
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, _LEARNING_RATE, total_steps=steps + 1, pct_start=0.1)
        order = torch.empty(0, dtype=torch.long)
        for _ in range(steps):
            if len(order) < BATCH:
                order = torch.randperm(len(inputs), generator=generator)
            rows, order = order[:BATCH].to(inputs.device), order[BATCH:]
            found, found_errors = self(inputs[rows])
            # The angle, not its square: the estimator's own outliers must not draw the normals of other pixels.
            angle = (((found - normals[rows]) ** 2).sum(dim=1) + _ROUNDED**2).sqrt()
            loss = angle.mean() + _WEIGHT_OF_ERRORS * (found_errors - errors[rows]).square().mean()
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
            schedule.step()
            if progress is not None:
                progress()
