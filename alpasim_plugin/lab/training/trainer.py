"""The training loop: gradient accumulation, clipping, EMA of the weights, log, checkpoints, resume,
stop at a non-finite loss.

The batch of step i is a function of i only, and what a task carries from one step to the next is
part of the checkpoint. So a resumed run ends with the weights of an uninterrupted one.
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields, is_dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Generic, Literal, Protocol, TypeVar

import torch
from torch import Tensor, distributed, nn

from alpasim_plugin.core.devices import autocast, upload
from alpasim_plugin.core.errors import InfrastructureError, InputError
from alpasim_plugin.core.files import parse_json, parsing, read_text
from alpasim_plugin.core.files.arrays import START_ANEW, read_checkpoint
from alpasim_plugin.core.files.atomic import atomic_file, disk_error, write_safetensors, write_text
from alpasim_plugin.fixers.network.checkpoints import listed, load_weights
from alpasim_plugin.lab.training.processes import join_ranks, rows_of_all, side_stream

Batch = TypeVar("Batch")
Loss = tuple[Tensor, Mapping[str, Tensor | float]]  # loss, and values for the log

STATE_FILE = "state.safetensors"
LOG_FILE = "log.jsonl"
BAD_FILE = "bad_batch.pt"
# processor time of an update, all threads together: unlike the wall clock's "s" alike on an idle
# and on a busy machine
CORE_S = "core_s"
CARRIED = "carried."


@dataclass(frozen=True)
class Schedule:
    """Optimisation schedule.

    The learning rate rises linearly, then falls to a share of its peak, along a cosine unless said
    otherwise. With ``decay_from`` it stays at its peak until that update, so that a run whose end
    is not known yet can go on: ``steps`` and ``decay_from`` may be changed until the decay begins.

    Args:
        steps: Total updates.
        peak_lr: Learning rate after the warm-up.
        warmup: Updates of linear warm-up.
        accumulate: Batches per update.
        clip: Largest gradient norm.
        weight_decay: Of AdamW, on matrices and kernels only.
        ema: Decay of the exponential moving average of the weights.
        save_every: Updates between checkpoints.
        decay_from: Update at which the decay begins; None: at the end of the warm-up.
        decay: Form of the decay.
        last_share: Share of the peak at the end.
    """

    steps: int
    peak_lr: float = 1e-3
    warmup: int = 100
    accumulate: int = 1
    clip: float = 1.0
    weight_decay: float = 0.01
    ema: float = 0.999
    save_every: int = 200
    decay_from: int | None = None
    decay: Literal["cosine", "exponential", "constant"] = "cosine"
    last_share: float = 0.01

    def lr(self, step: int) -> float:
        """Return the learning rate of an update, counted from 0."""
        if step < self.warmup:
            return self.peak_lr * (step + 1) / self.warmup
        begin = self.warmup if self.decay_from is None else max(self.decay_from, self.warmup)
        t = min(max(step - begin, 0) / max(self.steps - begin, 1), 1.0)
        if self.decay == "constant":
            return self.peak_lr
        if self.decay == "exponential":
            return self.peak_lr * math.pow(self.last_share, t)
        return self.peak_lr * (
            self.last_share + (1 - self.last_share) * 0.5 * (1 + math.cos(math.pi * t))
        )

    def of_length(self, steps: int) -> Schedule:
        """Return the same for another number of updates: a twentieth of them is warm-up, and a
        checkpoint follows every fortieth.
        """
        return replace(
            self, steps=steps, warmup=max(steps // 20, 1), save_every=max(steps // 40, 5)
        )

    @property
    def identity(self) -> dict[str, Any]:
        """What a folder's other runs must have in common with this one."""
        facts = asdict(self)
        for open_end in ("steps", "decay_from") if self.decay_from is not None else ("decay_from",):
            del facts[open_end]
        return facts


@dataclass(frozen=True)
class PartSchedule:
    """Optimisation of one part of a module, where it differs from the whole's.

    Args:
        rate: Learning rate over the schedule's.
        betas: Of AdamW.
        clip: Largest gradient norm of the part; None for the schedule's.
    """

    rate: float = 1.0
    betas: tuple[float, float] = (0.9, 0.99)
    clip: float | None = None


WHOLE: Mapping[str, PartSchedule] = MappingProxyType({"": PartSchedule()})


class Carried(Protocol):
    """What a task carries from one batch to the next, such as the state of a recurrent network. Each
    of several processes has its own rows of every batch.
    """

    def carried(self) -> Mapping[str, Tensor]:
        """Return it as named tensors, whose rows are this process's; empty before the first batch."""
        ...

    def carry(self, tensors: Mapping[str, Tensor]) -> None:
        """Take what `carried` returned at a checkpoint, with the rows of all processes."""
        ...


class Trainer(Generic[Batch]):
    """Train one module in one run folder; the same folder resumes.

    Processes of torchrun share the batches of an update, or the rows of each batch where a task
    carries something from batch to batch, and end with the weights of one process.

    Args:
        module: Its parameters that require a gradient are trained.
        folder: Receives state.safetensors (weights, average, moments), log.jsonl.
        schedule: Optimisation schedule.
        batch: Returns batch number i, a function of i only.
        loss: Maps a batch and its number to the loss and values for the log.
        facts: Identity of the run; a folder of another run is refused.
        autocast: Precision of the forward pass, or None.
        carried: What the task carries from batch to batch, or None.
        parts: Schedules of the module's parts, by the first names of their parameters (``dit``,
            ``vae.decoder``; the empty name is the whole). A part without a gradient in an update
            keeps its weights, moments and average.

    Raises:
        InputError: The folder holds another run, or one whose decay has begun under another
            schedule; or a parameter of no part; or processes that cannot share an update.
    """

    def __init__(
        self,
        module: nn.Module,
        folder: Path,
        schedule: Schedule,
        batch: Callable[[int], Batch],
        loss: Callable[[Batch, int], Loss],
        facts: Mapping[str, Any],
        autocast: torch.dtype | None = None,
        carried: Carried | None = None,
        parts: Mapping[str, PartSchedule] = WHOLE,
    ) -> None:
        self.module, self.folder, self.schedule = module, folder, schedule
        self._batch, self._loss, self._autocast, self._carried = batch, loss, autocast, carried
        self.parameters = {name: p for name, p in module.named_parameters() if p.requires_grad}
        self.device = next(iter(self.parameters.values())).device
        self._parts = [
            (name, part, _parameters_of(name, self.parameters)) for name, part in parts.items()
        ]
        if nobodys := sorted(
            set(self.parameters) - {key for _, _, parameters in self._parts for key in parameters}
        ):
            problem = listed("trained without a schedule", nobodys)
            raise InputError(f"{folder}: {problem}", "freeze them, or name their part")
        groups = [
            group
            for _, part, parameters in self._parts
            for group in _groups(part, parameters, schedule)
        ]
        self.optimiser = torch.optim.AdamW([g for g in groups if g["params"]], lr=schedule.peak_lr)
        self.average = {name: p.detach().clone() for name, p in self.parameters.items()}
        self.step = 0
        self.rank, self.ranks = join_ranks(self.device)
        self._stride = self.ranks if carried is None else 1
        if schedule.accumulate % self._stride:
            raise InputError(
                f"{folder}: {self.ranks} processes cannot share the batches of an update",
                "make --accumulate a multiple of them",
            )
        self._beside = side_stream(self.device)
        self._end = schedule.steps * schedule.accumulate
        self._ahead: dict[int, Batch] = {}  # the next batch, made while the device computes
        self._kept: dict[str, Tensor] = {}
        several = (
            {}
            if parts == WHOLE
            else {"parts": {name: asdict(part) for name, part in parts.items()}}
        )
        self._facts = json.dumps(
            {**facts, **several, "schedule": schedule.identity}, sort_keys=True, default=str
        )
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / STATE_FILE).exists():
            self._resume()
        if self.rank == 0:
            self._cut_log()

    def run(
        self,
        report: Callable[[int, Mapping[str, float]], None] | None = None,
        until: int | None = None,
    ) -> None:
        """Train to the schedule's end, or to update ``until``.

        Raises:
            InfrastructureError: A loss or gradient is not finite; the weights are those of the last
                good update, and the batch is saved.
        """
        last = min(until or self.schedule.steps, self.schedule.steps)
        self._end = last * self.schedule.accumulate
        while self.step < last:
            numbers = self._update()
            if self.rank == 0:
                self._write_log(numbers)
                if report is not None:
                    report(self.step, numbers)
            if self.step % self.schedule.save_every == 0 or self.step == last:
                self.save()

    def begin_from(self, checkpoint: Path) -> None:
        """Start a run at the weights, averages and moments of another run's checkpoint; does
        nothing once this run has updates.

        Raises:
            InputError: A checkpoint of other parameters.
        """
        if self.step:
            return
        tensors = load_weights(checkpoint)
        missing = sorted(
            name
            for name in self.parameters
            if f"average.{name}" not in tensors or f"weight.{name}" not in tensors
        )
        wrong = sorted(
            name
            for name, p in self.parameters.items()
            if name not in missing and tensors[f"weight.{name}"].shape != p.shape
        )
        if missing or wrong:
            problem = "; ".join(
                filter(None, (listed("no weights of", missing), listed("another shape of", wrong)))
            )
            raise InputError(
                f"{checkpoint}: {problem}",
                f"give the {STATE_FILE} of a run with the same network",
            )
        self._take(tensors)

    def averaged(self) -> dict[str, Tensor]:
        """Return the module's state dict with averaged (EMA) parameters."""
        return {**self.module.state_dict(), **self.average}

    def save(self) -> None:
        """Write the checkpoint, in the first process; the others wait for it."""
        carried = self._kept
        if self.ranks > 1:
            carried = {name: rows_of_all(rows, self.ranks) for name, rows in carried.items()}
        if self.rank == 0:
            self._write(carried)
        if self.ranks > 1:
            distributed.barrier()

    def _write(self, carried: Mapping[str, Tensor]) -> None:
        tensors: dict[str, Tensor] = {f"average.{n}": t for n, t in self.average.items()}
        tensors |= {f"weight.{n}": p.detach() for n, p in self.parameters.items()}
        # A part that has had no gradient yet has no moments
        for (
            name,
            p,
        ) in self.parameters.items():
            tensors |= {
                f"moment.{key}.{name}": value
                for key, value in self.optimiser.state.get(p, {}).items()
            }
        tensors |= {f"{CARRIED}{name}": value.contiguous() for name, value in carried.items()}
        meta = {
            "step": str(self.step),
            "facts": self._facts,
            "end": json.dumps([self.schedule.steps, self.schedule.decay_from]),
        }
        write_safetensors(self.folder / STATE_FILE, tensors, meta)

    def _update(self) -> dict[str, float]:
        began = time.perf_counter()
        core_began = time.process_time()
        self.optimiser.zero_grad(set_to_none=True)
        sums: dict[str, Tensor | float] = {}
        n = self.schedule.accumulate
        first = self.step * n + self.rank % self._stride
        indices = range(first, (self.step + 1) * n, self._stride)
        parts = len(indices) * self.ranks  # whose mean is the update's
        held = []  # until the host has waited for the device
        losses = []
        for index in indices:
            held.append(self._ahead.pop(index) if index in self._ahead else self._sent(index))
            with autocast(self.device, self._autocast):
                loss, numbers = self._loss(held[-1], index)
            (loss / parts).backward()  # type: ignore[no-untyped-call]
            following = index + self._stride
            if following < self._end:
                self._ahead[following] = self._sent(following)
            losses.append(loss.detach())
            for name, value in {"loss": loss.detach(), **numbers}.items():
                sums[name] = sums.get(name, 0.0) + value / parts
        totals = stacked(sums, self.device)
        if self.ranks > 1:
            gradients = [p.grad for p in self.parameters.values() if p.grad is not None]
            for part in (totals, *gradients):
                distributed.all_reduce(part)
        norms = self._clip()
        values = torch.stack([*totals, *norms.values()]).cpu()  # the host waits here alone
        logged = dict(zip([*sums, *norms], values.tolist(), strict=True))
        if not all(map(math.isfinite, logged.values())):
            self._stop(held, losses, f"update {self.step}: {logged}")
        lr = self.schedule.lr(self.step)
        for group in self.optimiser.param_groups:
            group["lr"] = lr * group["rate"]
        self.optimiser.step()
        self.step += 1
        # Only now: a failed update leaves the last one's
        self._kept = {} if self._carried is None else dict(self._carried.carried())
        self._update_average()
        return {
            **logged,
            "lr": lr,
            "s": time.perf_counter() - began,
            CORE_S: time.process_time() - core_began,
        }

    def _sent(self, index: int) -> Batch:
        """Make a batch and send it to the device, beside what it computes."""
        with self._beside():
            sent: Batch = moved(self._batch(index), self.device)
        return sent

    def _clip(self) -> dict[str, Tensor]:
        """Clip the gradients of every part that has any, and return their norms."""
        norms = {}
        for name, part, parameters in self._parts:
            if any(p.grad is not None for p in parameters.values()):
                clip = self.schedule.clip if part.clip is None else part.clip
                key = f"grad_norm.{name}" if len(self._parts) > 1 else "grad_norm"
                norms[key] = nn.utils.clip_grad_norm_(list(parameters.values()), clip)
        return norms

    def _update_average(self) -> None:
        """Update the EMA; its decay is lower in early updates, so that the initial weights have
        little influence.
        """
        decay = min(self.schedule.ema, (1 + self.step) / (10 + self.step))
        with torch.no_grad():
            for name, p in self.parameters.items():
                if p.grad is not None:
                    self.average[name].lerp_(p, 1 - decay)

    def _stop(self, batches: Sequence[Batch], losses: Sequence[Tensor], problem: str) -> None:
        """Save the batch whose loss is not finite, the last one where all losses are, and raise."""
        is_bad = [not math.isfinite(float(loss)) for loss in losses]
        batch = batches[is_bad.index(True)] if any(is_bad) else batches[-1]
        path = self.folder / BAD_FILE
        with atomic_file(path) as partial:
            torch.save(moved(batch, torch.device("cpu")), partial)
        self.save()
        raise InfrastructureError(
            f"{self.folder}: {problem}",
            f"inspect the batch in {path}. This folder goes on with its own settings alone: after "
            "repairing what makes the batch, give the same command; with a lower learning rate, "
            "begin in another folder",
        )

    def _write_log(self, numbers: Mapping[str, float]) -> None:
        row = {"step": self.step, **{k: float(f"{v:.6g}") for k, v in numbers.items()}}
        path = self.folder / LOG_FILE
        try:
            with path.open("a", encoding="utf-8") as file:
                file.write(json.dumps(row) + "\n")
        except OSError as error:
            raise disk_error(path, error) from error

    def _resume(self) -> None:
        path = self.folder / STATE_FILE
        meta, tensors = read_checkpoint(path, self._facts)
        with parsing(path, START_ANEW, "not a whole checkpoint"):
            self.step = int(meta["step"])
            steps, decay_from = json.loads(meta.get("end", "[null, null]"))
        if (
            decay_from is not None
            and self.step > decay_from
            and [steps, decay_from] != [self.schedule.steps, self.schedule.decay_from]
        ):
            raise InputError(
                f"{path}: its decay from {decay_from} to {steps} has begun: it is at {self.step}",
                "give the same steps and decay, or begin a run from its weights",
            )
        with parsing(path, START_ANEW, "not a whole checkpoint"):
            if self._carried is not None:
                carried = {
                    key.removeprefix(CARRIED): value
                    for key, value in tensors.items()
                    if key.startswith(CARRIED)
                }
                self._carried.carry(moved(carried, self.device))
                self._kept = dict(self._carried.carried())
            self._take(tensors)

    def _take(self, tensors: Mapping[str, Tensor]) -> None:
        """Take weights, averages and moments from a checkpoint's tensors."""
        with torch.no_grad():
            for name, p in self.parameters.items():
                p.copy_(tensors[f"weight.{name}"])
                self.average[name].copy_(tensors[f"average.{name}"])
                moments = {
                    k.split(".")[1]: t
                    for k, t in tensors.items()
                    if k.startswith("moment.") and k.split(".", 2)[2] == name
                }
                if wrong := [
                    key for key, t in moments.items() if t.shape not in (p.shape, torch.Size([]))
                ]:
                    raise ValueError(f"the moments {wrong} of {name} have another shape")
                if not all(
                    bool(t.isfinite().all()) for t in (p, self.average[name], *moments.values())
                ):
                    raise ValueError(f"{name} or its moments are not finite")
                self.optimiser.state[p] = {
                    k: t if k == "step" else t.to(p.device) for k, t in moments.items()
                }

    def _cut_log(self) -> None:
        """Drop log rows of updates after the checkpoint (without one, all), which are repeated, and
        a last row that a kill cut short.
        """
        path = self.folder / LOG_FILE
        if path.is_file():
            lines = read_text(path).split("\n")[:-1]
            with parsing(path, f"remove {path}; only the curves are lost", "not a training log"):
                kept = [line for line in lines if parse_json(line, path)["step"] <= self.step]
            write_text(path, "".join(line + "\n" for line in kept))


def moved(value: Any, device: torch.device) -> Any:
    """Return a batch with its tensors on a device: a tensor, or dataclasses, mappings and tuples
    of them; anything else as it is.
    """
    if isinstance(value, Tensor):
        return upload(value, device)
    if is_dataclass(value) and not isinstance(value, type):
        parts = {field.name: getattr(value, field.name) for field in fields(value)}
        return replace(value, **moved(parts, device))
    if isinstance(value, Mapping):
        return {key: moved(part, device) for key, part in value.items()}
    if isinstance(value, tuple):
        parts_moved = [moved(part, device) for part in value]
        return type(value)(*parts_moved) if hasattr(value, "_fields") else tuple(parts_moved)
    return value


def stacked(numbers: Mapping[str, Tensor | float], device: torch.device) -> Tensor:
    """Return numbers ``(N,)`` float32 on a device."""
    return torch.stack([upload(value, device).float() for value in numbers.values()])


def _parameters_of(part: str, parameters: Mapping[str, nn.Parameter]) -> dict[str, nn.Parameter]:
    """Return a part's parameters; the empty name is the whole."""
    return {
        name: p for name, p in parameters.items() if not part or f"{name}.".startswith(f"{part}.")
    }


def _groups(
    part: PartSchedule, parameters: Mapping[str, nn.Parameter], schedule: Schedule
) -> list[dict[str, Any]]:
    """Return the optimiser's groups of a part: matrices and kernels decay, gains and biases do
    not.
    """
    shared = {"rate": part.rate, "betas": part.betas}
    return [
        {
            "params": [p for p in parameters.values() if p.ndim > 1],
            "weight_decay": schedule.weight_decay,
            **shared,
        },
        {"params": [p for p in parameters.values() if p.ndim <= 1], "weight_decay": 0.0, **shared},
    ]
