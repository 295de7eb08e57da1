"""``simrun train policy-data`` and ``simrun train policy``: teach the policy ``learned``."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Annotated, Any

import torch
import typer
from rich.console import Console

from alpasim_plugin.cli.training_options import Progress, Seed, Steps
from alpasim_plugin.errors import InputError
from alpasim_plugin.training.policy import PolicyRecipe, PolicyTask, measure
from alpasim_plugin.training.policy_data import LessonRecipe, make_lessons, read_lessons
from alpasim_plugin.training.scenes import SPLITS
from alpasim_plugin.training.trainer import Schedule, Trainer
from policies.learned_net import LearnedNet, save_net
from scenarios.load import load_scenario

WEIGHTS_FILE, CARD_FILE = "learned.safetensors", "learned.json"
POLICY_DATA_EPILOG = "Example: `simrun train policy-data data/scenes --out data/lessons`"
POLICY_EPILOG = "Example: `simrun train policy data/lessons --out runs/policy --steps 4000`"


def policy_data(
    scenes: Annotated[Path, typer.Argument(help="Folder that 'simrun train scenes' wrote: SPLIT/FAMILY_NUMBER.yaml.")],
    out: Annotated[Path, typer.Option("--out", help="Folder to write to; finished scenes are kept.")],
    split: Annotated[str, typer.Option("--split", help="'train', or 'val' to measure on; never 'test'.")] = "train",
    seed: Annotated[int, typer.Option("--seed", min=0, help="Seed of the practice drives.")] = 0,
) -> None:
    """Render practice drives off the logged paths and write down what a teacher who knows the scene does there."""
    if split not in SPLITS or split == "test":
        raise InputError("making lessons", f"--split {split}", "not a split to learn from", "give train or val")
    paths = sorted((scenes / split).glob("*.yaml"), key=lambda p: int(p.stem.rsplit("_", 1)[-1]))
    if not paths:
        raise InputError("making lessons", str(scenes / split), "no scenarios", "write some with 'simrun train scenes'")
    console = Console(stderr=True)
    for i, path in enumerate(paths, start=1):
        made = make_lessons(load_scenario(path), out / split / path.stem, LessonRecipe(), seed)
        console.print(f"{i}/{len(paths)} {path.stem}{'' if made else ' (was there)'}")


def policy(
    data: Annotated[Path, typer.Argument(help="Folder that 'simrun train policy-data' wrote.")],
    out: Annotated[Path, typer.Option("--out", help="Folder to write to; the same command continues there.")],
    steps: Steps = 4000,
    seed: Seed = 0,
    machine: Annotated[str, typer.Option("--machine", help="What the model card calls this machine.")] = "two CPU cores",
    threads: Annotated[int, typer.Option("--threads", min=1, help="Threads of the arithmetic.")] = 1,
) -> None:
    """Train the network of the policy 'learned'; writes OUT/learned.safetensors (averaged, float16) and its model card."""
    torch.set_num_threads(threads)
    net = LearnedNet(seed).to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    task = PolicyTask(net, read_lessons(data, "train"), PolicyRecipe(seed=seed))
    schedule = Schedule(steps, peak_lr=1.5e-3, warmup=min(200, steps // 10 + 1), weight_decay=0.02, ema=0.998)
    trainer = Trainer(net, out, schedule, task.batch, task.loss, task.facts)
    progress = Progress(steps, every=50)
    trainer.run(progress.update)
    net.load_state_dict(trainer.averaged())
    net.eval()
    held_out = measure(PolicyTask(net, read_lessons(data, "val"), PolicyRecipe())) if (data / "val").is_dir() else None
    save_net(net, out / WEIGHTS_FILE, {"made_by": "simrun train policy", "steps": str(steps), "seed": str(seed)})
    command = f"simrun train policy {data} --out {out} --steps {steps} --seed {seed}"
    card = model_card(task, out, {"command": command, "steps": steps, "seed": seed, "machine": machine, "held_out": held_out})
    (out / CARD_FILE).write_text(json.dumps(card, indent=1) + "\n", encoding="utf-8")
    progress.wrote(out / WEIGHTS_FILE)


def model_card(task: PolicyTask, run: Path, facts: dict[str, Any]) -> dict[str, Any]:
    """Return what there is to know of the weights in a run folder."""
    rows = [json.loads(line) for line in (run / "log.jsonl").read_text(encoding="utf-8").splitlines()]
    families: dict[str, int] = {}
    for lessons in task.lessons:
        family = lessons.folder.name.rsplit("_", 1)[0]
        families[family] = families.get(family, 0) + 1
    tenth = max(len(rows) // 20, 1)
    curve = [{"step": part[-1]["step"], "loss": round(sum(r["loss"] for r in part) / len(part), 4)} for part in _parts(rows, tenth)]
    return {
        "name": "learned",
        "sha256": hashlib.sha256((run / WEIGHTS_FILE).read_bytes()).hexdigest(),
        "parameters": sum(p.numel() for p in task.net.parameters()),
        "data": {"frames": sum(len(one.arrays["frames"]) for one in task.lessons), "lessons": int(task.ends[-1]), "scenes": families,
                 "renderer": task.lessons[0].info["recipe"]["renderer"]},
        "seconds": round(sum(r["s"] for r in rows)),
        "recipe": task.facts["recipe"],
        **facts,
        "curve": curve,
    }  # fmt: skip


def _parts(rows: list[dict[str, float]], size: int) -> list[list[dict[str, float]]]:
    return [rows[i : i + size] for i in range(0, len(rows), size)]
