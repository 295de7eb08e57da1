"""``simrun train policy-data`` and ``simrun train policy``: imitation learning of the policy
``learned``.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from rich.console import Console

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.cli.training_options import (
    AsJson,
    Debug,
    Progress,
    Seed,
    Steps,
    scene_files,
)
from alpasim_plugin.lab.training.demonstrations import (
    DemonstrationRecipe,
    Demonstrations,
    read_demonstrations,
    write_demonstrations,
)
from alpasim_plugin.lab.training.model_card import ModelCard, curves
from alpasim_plugin.lab.training.policy import PolicyRecipe, PolicyTask, measure
from alpasim_plugin.lab.training.scenes import SPLITS, TEST_SPLITS
from alpasim_plugin.lab.training.trainer import LOG_FILE, Schedule, Trainer
from policies.learned_net import LearnedNet, save_net
from scenarios.load import load_scenario

WEIGHTS_FILE, CARD_FILE = "learned.safetensors", "learned.json"
WHAT = (
    "Network of the policy learned: a path and speeds from camera frames, speed and route command"
)
POLICY_DATA_EPILOG = "Example: `simrun train policy-data data/scenes --out data/demonstrations`"
POLICY_EPILOG = "Example: `simrun train policy data/demonstrations --out runs/policy --steps 4000`"


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


def policy_data(
    scenes: Annotated[
        Path,
        typer.Argument(help="Folder that 'simrun train scenes' wrote: SPLIT/FAMILY_NUMBER.yaml."),
    ],
    out: Annotated[
        Path, typer.Option("--out", help="Folder to write to; complete scenes are kept.")
    ],
    split: Annotated[
        str, typer.Option("--split", help="'train', or 'val' to measure on; never a test split.")
    ] = "train",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the perturbed rollouts.")] = 0,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Render perturbed rollouts off the logged paths, with the path and speeds of a privileged
    expert as labels.
    """
    del debug
    if split not in SPLITS or split in TEST_SPLITS:
        raise InputError(
            f"--split {split}: not a training split",
            "give train or val",
        )
    paths = scene_files(scenes, split)
    if not paths:
        raise InputError(
            f"{scenes / split}: no scenarios",
            "write some with 'simrun train scenes'",
        )
    console = Console(stderr=True)
    rows: list[dict[str, Any]] = []
    for i, path in enumerate(paths, start=1):
        folder = out / split / path.stem
        made = write_demonstrations(load_scenario(path), folder, DemonstrationRecipe(), seed)
        rows.append(
            {
                "scene": path.stem,
                "folder": str(folder),
                "made": made,
                "samples": len(Demonstrations(folder)),
            }
        )
        console.print(
            f"[{i}/{len(paths)}] {path.stem}{'' if made else ' (exists)'}",
            highlight=False,
            markup=False,
            soft_wrap=True,
        )
    if as_json:
        totals = {
            "scenes": len(rows),
            "made": sum(row["made"] for row in rows),
            "samples": sum(row["samples"] for row in rows),
        }
        print(json.dumps({"split": split, **totals, "rows": rows}))


def policy(
    data: Annotated[Path, typer.Argument(help="Folder that 'simrun train policy-data' wrote.")],
    out: Annotated[
        Path, typer.Option("--out", help="Folder of the run; the same command resumes it.")
    ],
    steps: Steps = 4000,
    seed: Seed = 0,
    threads: Annotated[int, typer.Option("--threads", min=1, help="Torch threads.")] = 1,
    as_json: AsJson = False,
    debug: Debug = False,
) -> None:
    """Train the network of the policy 'learned'; writes OUT/learned.safetensors (averaged, float16)
    and its card, OUT/learned.json.
    """
    del debug
    torch.set_num_threads(threads)
    net = LearnedNet(seed).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    task = PolicyTask(net, read_demonstrations(data, "train"), PolicyRecipe(seed=seed))
    schedule = Schedule(
        steps, peak_lr=1.5e-3, warmup=min(200, steps // 10 + 1), weight_decay=0.02, ema=0.998
    )
    trainer = Trainer(net, out, schedule, task.batch, task.loss, task.facts)
    progress = Progress(steps, every=50)
    trainer.run(progress.update)
    net.load_state_dict(trainer.averaged())
    net.eval()
    held_out = (
        measure(PolicyTask(net, read_demonstrations(data, "val"), PolicyRecipe()))
        if (data / "val").is_dir()
        else None
    )
    path = out / WEIGHTS_FILE
    save_net(net, path, {"made_by": "simrun train policy", "steps": str(steps), "seed": str(seed)})
    rows, hours = curves(out / LOG_FILE)
    training = {"schedule": asdict(schedule), "recipe": asdict(task.recipe)}
    parameters = sum(p.numel() for p in net.parameters())
    card = PolicyCard(
        WHAT, demonstration_facts(task), training, rows, hours, steps, seed, parameters, held_out
    ).write(path)
    progress.wrote(path, as_json, card.replace(out / CARD_FILE))  # the name of the shipped card


def demonstration_facts(task: PolicyTask) -> dict[str, Any]:
    """Return the training data of a policy: frames, samples, scenes by family, and the renderer."""
    return {
        "frames": sum(len(one.arrays["frames"]) for one in task.demonstrations),
        "samples": int(task.ends[-1]),
        "scenes": dict(Counter(one.folder.name.rsplit("_", 1)[0] for one in task.demonstrations)),
        "renderer": task.demonstrations[0].info["recipe"]["renderer"],
    }
