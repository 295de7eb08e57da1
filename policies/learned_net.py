"""The learned policy's network: views, two speeds and a command to a path and a speed profile, with
heteroscedastic sigma.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pydantic
import torch
from safetensors.torch import load_file
from torch import Tensor, nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import check_regular, parsing
from alpasim_plugin.core.files.arrays import read_metadata
from alpasim_plugin.core.files.atomic import write_safetensors
from alpasim_plugin.core.types import F64
from policies.learned_input import CHANNELS, COMMANDS, FRONT, View

# Distances along the path of the predicted headings
KNOTS_M = (
    2.0,
    4.0,
    7.0,
    11.0,
    16.0,
    22.0,
    30.0,
    42.0,
    60.0,
)
TIMES_S = (0.5, 1.0, 1.5, 2.0, 2.5, 3.0, 3.5, 4.0)  # times of the predicted speeds
STATES = 3  # speed and desired speed in `SPEED_UNIT_MPS`; 1 if there is an earlier frame, else 0
SPEED_UNIT_MPS = 15.0
GRID_M = 1.0

_KNOT_SCALE = [min(0.6, 0.05 + 0.02 * s) for s in KNOTS_M]  # radians per unit of output
_SPEED_SCALE = [1.5 * t for t in TIMES_S]  # metres per second
_PARTS = [len(KNOTS_M), len(TIMES_S), 2, 2]
_MIN_SIGMA = 0.02
PROXIMITY_M = 20.0
SIDE_FEATURES = 32  # features of a view to a side
VIEWS = "views"  # entry in the header of the weights
MOST_PIXELS = 512


@dataclass(frozen=True)
class Prediction:
    """Network outputs for a batch of B observations."""

    heading: Tensor  # (B, 9) radians to the left of the rig's x axis at `KNOTS_M`
    speed: Tensor  # (B, 8) change of speed until `TIMES_S`, metres per second
    # (B, 2) standard deviations: to the side 16 m ahead, metres; of the mean speed over the plan,
    # as a share
    sigma: Tensor
    # (B, 2) proximity of the leader, exp(-gap / 20 m), and its speed, metres per second; auxiliary
    leader: Tensor
    # (B, V - 1, 2) who comes, in each view to a side: proximity of the nearest that moves, and
    # whether it is let pass, before the sigmoid; auxiliary
    crossing: Tensor


def _convolutions() -> list[nn.Module]:
    """Return six convolutions over a view, to 24 channels of a sixteenth of its size, in a row."""
    return [
        nn.Conv2d(CHANNELS, 16, 5, 2, 2),
        nn.ReLU(),
        nn.Conv2d(16, 32, 3, 2, 1),
        nn.GroupNorm(4, 32),
        nn.ReLU(),
        nn.Conv2d(32, 48, 3, 2, 1),
        nn.GroupNorm(6, 48),
        nn.ReLU(),
        nn.Conv2d(48, 64, 3, 1, 1),
        nn.GroupNorm(8, 64),
        nn.ReLU(),
        nn.Conv2d(64, 96, 3, 2, 1),
        nn.GroupNorm(12, 96),
        nn.ReLU(),
        nn.Conv2d(96, 24, 1),
        nn.ReLU(),
        nn.Flatten(),
    ]


class LearnedNet(nn.Module):
    """Convolutions over each view, then two fully connected layers with speeds and command;
    attribute names are checkpoint keys.

    The first view is the front one. The others share convolutions of their own, and a view to the
    right is mirrored, so that who comes does so from the same side.
    """

    def __init__(self, seed: int = 0, views: Sequence[View] = (FRONT,)) -> None:
        super().__init__()
        self.views = tuple(views)
        self.see = nn.Sequential(*_convolutions())
        self.word = nn.Embedding(len(COMMANDS), 16)
        self.state = nn.Sequential(nn.Linear(STATES, 32), nn.ReLU())
        image_features = 24 * (self.views[0].height // 16) * (self.views[0].width // 16)
        for view in self.views[1:2]:
            beside = 24 * (view.height // 16) * (view.width // 16)
            self.side_encoder = nn.Sequential(
                *_convolutions(), nn.Linear(beside, SIDE_FEATURES), nn.ReLU()
            )
            self.crossing_head = nn.Linear(SIDE_FEATURES + 32, 2)
        features = image_features + SIDE_FEATURES * len(self.views[1:])
        self.plan = nn.Sequential(
            nn.Linear(features + 16 + 32, 160), nn.ReLU(), nn.Linear(160, 128), nn.ReLU()
        )
        self.out = nn.Linear(128, sum(_PARTS))
        # As torch does by default, from a generator of its own; the last layer is zero.
        random = torch.Generator().manual_seed(seed)
        for module in self.modules():
            if isinstance(module, nn.Conv2d | nn.Linear):
                bound = float(module.weight[0].numel()) ** -0.5
                for parameter in (module.weight, module.bias):
                    if parameter is not None:
                        nn.init.uniform_(parameter, -bound, bound, generator=random)
        nn.init.normal_(self.word.weight, generator=random)
        nn.init.zeros_(self.out.weight)
        nn.init.zeros_(self.out.bias)
        self.register_buffer("knot_scale", torch.tensor(_KNOT_SCALE), persistent=False)
        self.register_buffer("speed_scale", torch.tensor(_SPEED_SCALE), persistent=False)

    def forward(self, images: Sequence[Tensor], state: Tensor, command: Tensor) -> Prediction:
        """Predict from an image ``(B, 4, H, W)`` of each view, states ``(B, 3)`` and indices of
        commands ``(B,)``.
        """
        view_features = [self.see(images[0])]
        state_features = self.state(state)
        crossing = [state.new_zeros(len(state), 0)]
        for view, image in zip(self.views[1:], images[1:], strict=True):
            view_features.append(self.side_encoder(image if view.yaw_deg > 0 else image.flip(-1)))
            crossing.append(
                self.crossing_head(torch.cat([view_features[-1], state_features], dim=1))
            )
        features = torch.cat([*view_features, state_features, self.word(command)], dim=1)
        heading, speed, sigma, leader = self.out(self.plan(features)).split(_PARTS, dim=1)
        sigma = _MIN_SIGMA + 0.1 * torch.exp(sigma.clamp(-4.0, 3.0))
        leader = torch.stack([torch.sigmoid(leader[:, 0]), SPEED_UNIT_MPS * leader[:, 1]], dim=1)
        return Prediction(
            heading * self.knot_scale,
            speed * self.speed_scale,
            sigma,
            leader,
            torch.cat(crossing, dim=1).view(len(state), len(self.views) - 1, 2),
        )


def path_grid() -> F64:
    """Return the distances ``(G,)`` along the path of its points: every metre from 0 to the last
    knot.
    """
    return np.arange(0.0, KNOTS_M[-1] + 0.5 * GRID_M, GRID_M)


def knot_weights() -> F64:
    """Return the interpolation matrix ``(G, 9)`` from headings at the knots to headings on
    `path_grid`: linear, 0 at the car.
    """
    knots = np.array((0.0, *KNOTS_M))
    return np.column_stack([np.interp(path_grid(), knots, row) for row in np.eye(len(knots))[1:]])


def save_net(net: LearnedNet, path: Path, metadata: dict[str, str]) -> None:
    """Write the weights in float16, and the views that they read."""
    weights = {name: value.half() for name, value in net.state_dict().items()}
    views = json.dumps([asdict(view) for view in net.views])
    write_safetensors(path, weights, {**metadata, VIEWS: views})


def read_views(path: Path) -> tuple[View, ...]:
    """Return the views that weights read; the front one where they name none.

    Raises:
        InputError: No such file, or entries that are no views.
    """
    text = read_metadata(path, "give weights that 'simrun train policy' wrote").get(VIEWS)
    if text is None:
        return (FRONT,)
    with parsing(path, "train the policy again", f"the entry {VIEWS!r} holds no views"):
        views = pydantic.TypeAdapter(tuple[View, ...]).validate_json(text)
    sizes = [size for view in views for size in (view.width, view.height)]
    for view in views:
        if not (
            np.isfinite(view.yaw_deg)
            and 1 <= view.focal_px <= MOST_PIXELS
            and 0 <= view.horizon_row <= view.height
        ):
            raise InputError(f"{path}: {view} is no view", "train the policy again")
    if not views or not all(16 <= size <= MOST_PIXELS for size in sizes):
        raise InputError(
            f"{path}: views of {sizes} pixels, width and height in turn",
            f"train it with views of 16 to {MOST_PIXELS} pixels",
        )
    return views


def load_net(path: Path) -> LearnedNet:
    """Read weights that `save_net` wrote.

    Raises:
        InputError: No such file, or not weights of this network.
    """
    check_regular(path)
    net = LearnedNet(views=read_views(path))
    wanted = {name: tuple(value.shape) for name, value in net.state_dict().items()}
    with parsing(path, "copy or train it again", "not a complete safetensors file"):
        state = load_file(str(path))
    shapes = {name: tuple(value.shape) for name, value in state.items()}
    if shapes != wanted:
        odd = sorted(
            name for name in wanted.keys() | shapes.keys() if wanted.get(name) != shapes.get(name)
        )
        raise InputError(
            f"{path}: {len(odd)} tensors that are missing, foreign or of another shape, first {odd[0]}",
            "give weights that 'simrun train policy' of this version wrote",
        )
    net.load_state_dict({name: value.float() for name, value in state.items()})
    return net.eval().requires_grad_(False)
