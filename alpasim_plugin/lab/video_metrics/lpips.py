"""LPIPS v0.1 with an AlexNet or VGG-16 backbone; the user provides the weights, which are not
bundled or downloaded.

Zhang et al., "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", CVPR 2018,
Eq. 1. Images in [-1, 1] are shifted and scaled per channel; activations after five rectifiers are
scaled to unit length over the channels; their squared differences are weighted by calibrated
non-negative heads, averaged over the image and summed. No resizing.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.files import file_sha256
from alpasim_plugin.fixers.network.checkpoints import StateDict, load_weights, weight
from alpasim_plugin.lab.video_metrics.perceptual_net import check_images

Kind = Literal["alex", "vgg"]
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)
LENGTH_EPS = 1e-10  # added to the length of a feature
SMALLEST_PX = 32  # four poolings by two


@dataclass(frozen=True)
class Convolution:
    """A convolution of a trunk, before its rectifier: index among the layers of the published
    network, and its shape.
    """

    index: int
    inputs: int
    outputs: int
    kernel: int = 3
    stride: int = 1
    padding: int = 1
    pooled_first: bool = False  # a max pooling comes before it
    tapped: bool = False  # the rectified output is a feature


@dataclass(frozen=True)
class Trunk:
    """A published network's convolutional part.

    Args:
        convolutions: In order.
        pool: Side of the max poolings; their stride is 2.
        file: Name of the published weights; its last part begins the digest.
        heads_file: Name of the calibrated heads here.
        heads_sha256: Their digest.
    """

    convolutions: tuple[Convolution, ...]
    pool: int
    file: str
    heads_file: str
    heads_sha256: str

    @property
    def digest_start(self) -> str:
        """The first eight digits of the trunk file's SHA-256, which its name ends with."""
        return Path(self.file).stem.rsplit("-", 1)[1]


def _vgg() -> tuple[Convolution, ...]:
    rows = []
    index = 0
    inputs = 3
    for stage, (outputs, count) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))):
        for i in range(count):
            rows.append(
                Convolution(
                    index, inputs, outputs, pooled_first=stage > 0 and i == 0, tapped=i == count - 1
                )
            )
            index = index + 2
            inputs = outputs
        index += 1
    return tuple(rows)


TRUNKS: dict[Kind, Trunk] = {
    "alex": Trunk(
        (
            Convolution(0, 3, 64, 11, 4, 2, tapped=True),
            Convolution(3, 64, 192, 5, 1, 2, pooled_first=True, tapped=True),
            Convolution(6, 192, 384, pooled_first=True, tapped=True),
            Convolution(8, 384, 256, tapped=True),
            Convolution(10, 256, 256, tapped=True),
        ),
        3,
        "alexnet-owt-7be5be79.pth",
        "lpips-v0.1-alex.pth",
        "df73285e35b22355a2df87cdb6b70b343713b667eddbda73e1977e0c860835c0",
    ),
    "vgg": Trunk(
        _vgg(),
        2,
        "vgg16-397923af.pth",
        "lpips-v0.1-vgg.pth",
        "a78928a0af1e5f0fcb1f3b9e8f8c3a2a5a3de244d830ad5c1feddc79b8432868",
    ),
}


class LPIPS(nn.Module):
    """The distance; randomly initialised, for tests, until weights are loaded (`load_lpips`).

    Args:
        kind: ``alex`` (evaluation) or ``vgg`` (training losses).
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, kind: Kind) -> None:
        super().__init__()
        self.kind = kind
        self.plan = TRUNKS[kind]
        layers = {
            str(c.index): nn.Conv2d(c.inputs, c.outputs, c.kernel, c.stride, c.padding)
            for c in self.plan.convolutions
        }
        self.features = nn.ModuleDict(layers)
        self.heads = nn.ParameterList(
            [nn.Parameter(torch.rand(c.outputs)) for c in self.plan.convolutions if c.tapped]
        )
        self.register_buffer("shift", torch.tensor(SHIFT).view(1, 3, 1, 1))
        self.register_buffer("scale", torch.tensor(SCALE).view(1, 3, 1, 1))

    def distance(self, a: Tensor, b: Tensor) -> Tensor:
        """Return the distances ``(B,)`` of images ``(B, 3, H, W)`` in [-1, 1]; differentiable.

        Raises:
            InputError: Shapes differ, are not ``(B, 3, H, W)``, or a side is below 32 pixels.
        """
        check_images(a, b, SMALLEST_PX)
        total = a.new_zeros(len(a))
        for x, y, head in zip(self.activations(a), self.activations(b), self.heads, strict=True):
            difference = (_unit(x) - _unit(y)) ** 2  # (B, C, h, w)
            total = total + torch.einsum("bchw,c->b", difference, head) / (x.shape[2] * x.shape[3])
        return total

    forward = distance

    def activations(self, image: Tensor) -> list[Tensor]:
        """Return the five tapped activations of ``(B, 3, H, W)`` in [-1, 1]."""
        x = (image - self.shift) / self.scale
        out = []
        for c in self.plan.convolutions:
            if c.pooled_first:
                x = F.max_pool2d(x, self.plan.pool, 2)
            x = F.relu(self.features[str(c.index)](x))
            if c.tapped:
                out.append(x)
        return out


def load_lpips(kind: Kind, folder: str | Path) -> LPIPS:
    """Load LPIPS v0.1 from a folder of weights, frozen.

    The folder holds the backbone of PyTorch's model zoo and the heads of the ``lpips`` package,
    under the file names in `TRUNKS`. Digests are checked before anything is read.

    Raises:
        InputError: A missing or modified file, or one without the expected tensors.
    """
    if kind not in get_args(Kind):
        raise InputError(
            f"kind {kind!r}: no such trunk", f"choose one of {', '.join(get_args(Kind))}"
        )
    net = LPIPS(kind)
    plan = net.plan
    folder = Path(folder)
    missing = missing_files(kind, folder)
    if missing:
        raise InputError(
            f"lpips_{kind} from {folder}: not there: {', '.join(missing)}",
            "put the files there (docs/lab/video-metrics.md says where they come from), or use perceptual-syn",
        )
    state = load_trunk(plan, folder)
    heads = load_weights(folder / plan.heads_file, sha256=plan.heads_sha256)
    for i, c in enumerate(c for c in plan.convolutions if c.tapped):
        key = f"lin{i}.model.1.weight"
        shape = (1, c.outputs, 1, 1)
        state[f"heads.{i}"] = checked_tensor(heads, key, shape, str(folder)).flatten()
    net.load_state_dict(state, strict=False)
    return net.requires_grad_(False).eval()


def missing_files(kind: Kind, folder: str | Path) -> list[str]:
    """Return which of the two files of a kind are not in a folder."""
    return [
        name
        for name in (TRUNKS[kind].file, TRUNKS[kind].heads_file)
        if not (Path(folder) / name).is_file()
    ]


def load_trunk(plan: Trunk, folder: Path) -> StateDict:
    """Return a trunk's published weights under their published keys, ``features.INDEX.weight`` and
    ``.bias``; the digest is checked before anything is read.

    Raises:
        InputError: A missing or modified file, or a tensor that is missing or has another shape.
    """
    path = folder / plan.file
    digest = file_sha256(path)
    if not digest.startswith(plan.digest_start):
        raise InputError(
            f"{path}: sha256 {digest}, which does not begin with {plan.digest_start}",
            "copy the file again",
        )
    trunk = load_weights(path)
    state: StateDict = {}
    for c in plan.convolutions:
        shapes = {"weight": (c.outputs, c.inputs, c.kernel, c.kernel), "bias": (c.outputs,)}
        for part, shape in shapes.items():
            key = f"features.{c.index}.{part}"
            state[key] = checked_tensor(trunk, key, shape, str(folder))
    return state


def checked_tensor(tensors: StateDict, key: str, shape: tuple[int, ...], source: str) -> Tensor:
    """Return one tensor of published weights, in float32.

    Raises:
        InputError: It is missing, has another shape, or holds values that are not finite.
    """
    value = tensors.get(key)
    if value is None or tuple(value.shape) != shape:
        problem = "it is missing" if value is None else f"its shape is {tuple(value.shape)}"
        raise InputError(
            f"{key} in {source}: {problem}", f"give the published weights, where it is {shape}"
        )
    return weight(key, value, source)


def _unit(x: Tensor) -> Tensor:
    return x / (x.square().sum(1, keepdim=True).sqrt() + LENGTH_EPS)
