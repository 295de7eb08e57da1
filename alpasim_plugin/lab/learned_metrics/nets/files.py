"""The frozen judges: files of weights, the record of their digests, and the only function that
loads one.

``weights/judges.json`` holds the SHA-256 of every shipped judge as it was frozen, before any fixer
was compared with it. A judge whose file has another digest is not loaded. Nothing that trains a
fixer or a policy may import this module (a test enforces it), and a loaded judge gives arrays, not
tensors, so that no gradient can pass.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from pathlib import Path
from typing import Literal, get_args

from torch import nn

from alpasim_plugin.core.atomic import write_json, write_safetensors
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.reading import read_json_object
from alpasim_plugin.core.reading.arrays import read_metadata
from alpasim_plugin.fixers.network.checkpoints import file_sha256, load_weights
from alpasim_plugin.lab.learned_metrics.nets.cuboid_net import CuboidNet
from alpasim_plugin.lab.learned_metrics.nets.lane_net import LaneNet
from alpasim_plugin.lab.learned_metrics.nets.style_net import StyleNet
from alpasim_plugin.lab.learned_metrics.nets.video_net import VideoNet

JudgeName = Literal["lane", "cuboid", "video", "style"]
NAMES: tuple[JudgeName, ...] = get_args(JudgeName)
SEEDS = (0, 1)
FORMAT = "simrun-judge-1"
RECORD = "judges.json"
DOING = "loading a judge"


def judges_folder() -> Path:
    """Return the folder of the shipped judges."""
    return Path(str(resources.files("alpasim_plugin.lab.learned_metrics.nets"))) / "weights"


def file_name(name: JudgeName, seed: int) -> str:
    """Return the name of a judge's file."""
    return f"judge-{name}-{seed}.safetensors"


def untrained(name: str) -> nn.Module:
    """Return a judge's network before training.

    Raises:
        InputError: No such judge.
    """
    nets: Mapping[str, type[nn.Module]] = {
        "lane": LaneNet,
        "cuboid": CuboidNet,
        "video": VideoNet,
        "style": StyleNet,
    }
    if name not in nets:
        raise InputError(
            f"name {name!r}: no such judge",
            f"choose one of {', '.join(nets)}",
        )
    return nets[name]()


def save_judge(path: Path, name: JudgeName, net: nn.Module, metadata: Mapping[str, str]) -> None:
    """Write a judge's weights, float16."""
    tensors = {key: value.half().contiguous() for key, value in net.state_dict().items()}
    write_safetensors(path, tensors, {**metadata, "format": FORMAT, "judge": name})


def read_judge(path: Path, name: JudgeName) -> nn.Module:
    """Load a judge from any file, frozen, in float32: for the card of one that is not frozen yet.

    Raises:
        InputError: No such file, or weights of another network.
    """
    do = f"give a file that 'simrun train judge {name}' wrote"
    if not path.is_file():
        raise InputError(f"{path}: no such file", do)
    facts = read_metadata(path)
    if (facts.get("format"), facts.get("judge")) != (FORMAT, name):
        raise InputError(
            f"{path}: format {facts.get('format')!r} of judge {facts.get('judge')!r}", do
        )
    net = untrained(name)
    try:
        net.load_state_dict({key: value.float() for key, value in load_weights(path).items()})
    except RuntimeError as error:
        raise InputError(f"{path}: {str(error).splitlines()[-1].strip()}", do) from error
    return net.requires_grad_(False).eval()


@lru_cache(maxsize=8)
def load_judge(name: JudgeName, seed: int = 0, folder: Path | None = None) -> nn.Module:
    """Load a frozen judge.

    Args:
        name: Which.
        seed: Of its training.
        folder: With its record; None: the shipped ones.

    Raises:
        InputError: It is not in the record, or its file is not the one that was frozen.
    """
    folder = folder or judges_folder()
    file, digest = file_name(name, seed), frozen_digests(folder).get(file_name(name, seed))
    if digest is None:
        raise InputError(
            f"{file} in {folder}: {RECORD} does not hold it",
            "freeze it first: 'simrun judge freeze'",
        )
    found = file_sha256(folder / file)
    if found != digest:
        raise InputError(
            f"{folder / file}: sha256 {found[:16]}, frozen was {digest[:16]}",
            "restore the frozen file",
        )
    return read_judge(folder / file, name)


def frozen_digests(folder: Path | None = None) -> dict[str, str]:
    """Return the SHA-256 of every frozen judge by the name of its file; empty where nothing is
    frozen.
    """
    path = (folder or judges_folder()) / RECORD
    if not path.is_file():
        return {}
    record = read_json_object(path, do_this="restore the record of the frozen judges")
    return {str(name): str(digest) for name, digest in record["sha256"].items()}


def check_digests(folder: Path | None = None) -> dict[str, str]:
    """Return `frozen_digests` after comparing every file with its own: what a table that used
    judges prints.

    Raises:
        InputError: A file is missing or has changed.
    """
    folder = folder or judges_folder()
    digests = frozen_digests(folder)
    for file, digest in digests.items():
        found = file_sha256(folder / file) if (folder / file).is_file() else "missing"
        if found != digest:
            raise InputError(
                f"{folder / file}: sha256 {found[:16]}, frozen was {digest[:16]}",
                "restore it",
            )
    return digests


def freeze(folder: Path) -> dict[str, str]:
    """Write the record of all judges in a folder; judges that are in it already must not have
    changed.

    Raises:
        InputError: A frozen judge has changed or is missing.
    """
    known = check_digests(folder)
    found = {path.name: file_sha256(path) for path in sorted(folder.glob("judge-*.safetensors"))}
    write_json(
        folder / RECORD,
        {"what": "SHA-256 of the judges as they were frozen", "sha256": {**known, **found}},
    )
    return found
