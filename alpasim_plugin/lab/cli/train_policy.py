"""``simrun train policy``: imitation learning of the policy ``learned``."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from rich.console import Console

from alpasim_plugin.core.devices import require_device
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.cli.training_options import (
    AsJson,
    Debug,
    Device,
    Progress,
    Seed,
    Steps,
    scene_files,
)
from alpasim_plugin.lab.training.demonstrations import (
    DemonstrationRecipe,
    common_views,
    read_demonstrations,
    write_demonstrations,
)
from alpasim_plugin.lab.training.model_card import ModelCard, curves
from alpasim_plugin.lab.training.policy import (
    PolicyRecipe,
    PolicyTask,
    measure,
    start_from_front,
    train,
)
from alpasim_plugin.lab.training.trainer import LOG_FILE
from policies.learned import WEIGHTS
from policies.learned_net import LearnedNet, load_net, save_net
from scenarios.load import load_scenario

WEIGHTS_FILE = "learned.safetensors"
CARD_FILE = "learned.json"
DEMONSTRATIONS = "demonstrations"
WHAT = (
    "Network of the policy learned: a path and speeds from camera frames, speed and route command"
)
EPILOG = """Examples:

- `simrun train policy data/scenes --out runs/policy --steps 3600`
- `simrun train policy data/scenes/three --out runs/three --steps 12000`
"""


@dataclass(frozen=True)
class PolicyCard(ModelCard):
    """The card of a policy's weights.

    Args:
        steps, seed: Updates, and seed of weights and draws.
        parameters: Number of trained parameters.
        held_out: Mean errors on the demonstrations of the split ``val``; None without it.
    """

    steps: int
    seed: int
    parameters: int
    held_out: Mapping[str, float] | None


def policy(
    scenes: Annotated[
        Path, typer.Argument(help="Folder that 'simrun train scenes' wrote, splits train and val.")
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder of the run; the same command resumes it.")
    ],
    steps: Steps = 4000,
    seed: Seed = 0,
    device: Device = "cpu",
    threads: Annotated[int, typer.Option("--threads", min=1, help="Torch threads.")] = 1,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Train the network of the policy 'learned'; writes OUT/learned.safetensors (averaged, float16)
    and its card, OUT/learned.json.

    The network has the views that all scenes' cameras show: the front one, or also the left and the
    right one; then it starts from the weights of 'learned' and has three stages, in OUT/front,
    OUT/sides and OUT.

    Before the first update, perturbed rollouts off the logged paths are rendered into
    OUT/demonstrations, with the path and speeds of a privileged expert as labels.
    """
    del debug
    torch.set_num_threads(threads)
    data = out / DEMONSTRATIONS
    write_splits(scenes, data, seed)
    demonstrations = read_demonstrations(data, "train")
    net = LearnedNet(seed, common_views(demonstrations))
    if len(net.views) > 1:
        start_from_front(net, load_net(WEIGHTS))
    net = net.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    net = net.to(require_device(device))
    progress = Progress(steps, interval=50)
    stages = train(net, demonstrations, out, steps, PolicyRecipe(seed=seed), progress.update)
    net.cpu()
    net.eval()
    held_out = (
        measure(PolicyTask(net, read_demonstrations(data, "val"), PolicyRecipe()))
        if (data / "val").is_dir()
        else None
    )
    path = out / WEIGHTS_FILE
    save_net(net, path, {"made_by": "simrun train policy", "steps": str(steps), "seed": str(seed)})
    logs = [curves(trainer.folder / LOG_FILE) for _, trainer in stages]
    schedules = [
        {"schedule": asdict(trainer.schedule), "recipe": asdict(task.recipe)}
        for task, trainer in stages
    ]
    training = schedules[-1] | {"before": schedules[:-1]}
    task, _ = stages[-1]
    rows, _ = logs[-1]
    hours = sum(spent for _, spent in logs)
    parameters = sum(p.numel() for p in net.parameters())
    card = PolicyCard(
        WHAT, demonstration_facts(task), training, rows, hours, steps, seed, parameters, held_out
    ).write(path)
    progress.wrote(path, as_json, card.replace(out / CARD_FILE))  # the name of the shipped card


def write_splits(scenes: Path, data: Path, seed: int) -> None:
    """Write the demonstrations of the splits ``train`` and ``val``; complete scenes are kept.

    Raises:
        InputError: No scenario to train on.
    """
    files = {split: scene_files(scenes, split) for split in ("train", "val")}
    if not files["train"]:
        raise InputError(
            f"{scenes / 'train'}: no scenarios", "Write some with 'simrun train scenes'."
        )
    console = Console(stderr=True)
    for split, paths in files.items():
        for i, path in enumerate(paths, start=1):
            folder = data / split / path.stem
            is_new = write_demonstrations(load_scenario(path), folder, DemonstrationRecipe(), seed)
            note = "" if is_new else " (exists)"
            console.print(f"[{i}/{len(paths)}] {split}/{path.stem}{note}", highlight=False)


def demonstration_facts(task: PolicyTask) -> dict[str, Any]:
    """Return the training data of a policy: frames, samples, scenes by family, and the renderer."""
    return {
        "frames": sum(
            len(frames) for demonstration in task.demonstrations for frames in demonstration.frames
        ),
        "samples": int(task.ends[-1]),
        "scenes": dict(
            Counter(
                demonstration.folder.name.rsplit("_", 1)[0] for demonstration in task.demonstrations
            )
        ),
        "renderer": task.demonstrations[0].info["recipe"]["renderer"],
    }
