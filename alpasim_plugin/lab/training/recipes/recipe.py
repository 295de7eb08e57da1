"""What a recipe is: stages of training, each with an objective, a share of the updates, initial
weights and trained parts.

An objective is a frozen configuration that makes a `Task`: batches and a loss over named parts
(``dit``, ``vae``, and parts that only the training has). The framework (`lab.training.fixer_run`)
trains, resumes, and writes the bundle and the card of every stage. A new system needs an objective
where its loss is new, and a `Recipe` in the registry.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, field
from types import MappingProxyType
from typing import Any, Literal, Protocol

from torch import Tensor, nn

from alpasim_plugin.block_fixers.settings import DiTSettings, LatentFixerSettings
from alpasim_plugin.block_fixers.tiny_vae import TinyVAE
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.lab.training.clip_batches import BatchForm, Conditioning
from alpasim_plugin.lab.training.latent_clips import LatentClips
from alpasim_plugin.lab.training.perceptual_term import Distance
from alpasim_plugin.lab.training.trainer import Loss, PartSchedule

INIT = "init"
INIT_BI = "init-bi"
GIVEN = (INIT, INIT_BI)  # weights that a run receives; all others are made by an earlier stage
DIT = MappingProxyType({"dit": f"{INIT}.dit"})
TRAINED_DIT = MappingProxyType({"dit": PartSchedule()})
Weights = Mapping[str, Tensor]


@dataclass(frozen=True)
class Attention:
    """What a latent attends to, in latents: the rows of the paper's attention mask, in training and
    at deployment.

    Args:
        block_latents: Latents made at once.
        window: Latents in sight, the own block and the sink included.
        sink: First latents of the rollout that stay in sight.
        history: Keys and values of a finished block: of an extra forward over its clean latents, or
            of its last step.
    """

    block_latents: int = 2
    window: int = 6
    sink: int = 0
    history: Literal["finalise", "last-forward"] = "finalise"


def whole_clip(latents: int) -> Attention:
    """Return the attention of a bidirectional network: the clip is one block."""
    return Attention(latents, latents, 0, "last-forward")


def causal(latents: int) -> Attention:
    """Return the attention of OneFixer's generator, at any length of the clip."""
    return Attention()


def frame_by_frame(latents: int) -> Attention:
    """Return the attention of a generator that takes every frame by itself."""
    return Attention(1, 1, 0)


class Task(Protocol):
    """Batches and loss of one stage, for `alpasim_plugin.lab.training.trainer.Trainer`.

    Attributes:
        parts: Every part by its name: ``dit`` and ``vae`` go into the bundle, others into the
            stage's checkpoints alone. Which are trained is the stage's to say; the framework
            freezes the rest.
    """

    parts: nn.ModuleDict

    @property
    def facts(self) -> Mapping[str, Any]:
        """Identify data and configuration: another run's folder is refused."""
        ...

    def batch(self, index: int) -> Any:
        """Make batch ``index``, a function of the index only."""
        ...

    def loss(self, batch: Any, index: int) -> Loss:
        """Return the loss of a batch, and values for the log."""
        ...


@dataclass(frozen=True)
class StageInputs:
    """What an objective makes its task of.

    Args:
        dit: Sizes of the transformer where no weights say them.
        rope_ratios: NTK stretch of its rotary positions: height, width, time.
        attention: Of the stage.
        conditioning: What the network sees.
        weights: Initial weights by part, as `Stage.start` names them.
        vae: Autoencoder of the clips, or the one that ``vae`` starts from; each task may train it
            or leave it frozen.
        clips: Training latents.
        form: Clips of a batch.
        updates: Of the stage.
        accumulate: Batches an update.
        equal_channels: Whether flow matching weights all latent channels alike.
        distance: Name and function of the perceptual term; None where the recipe has none.
        settings: Of the fixer that is trained.
        device: Of the batches in the loss, and of the distance.
    """

    dit: DiTSettings
    rope_ratios: tuple[float, float, float]
    attention: Attention
    conditioning: Conditioning
    weights: Mapping[str, Weights]
    vae: TinyVAE
    clips: LatentClips
    form: BatchForm
    updates: int
    accumulate: int = 1
    equal_channels: bool = False
    distance: tuple[str, Distance] | None = None
    settings: LatentFixerSettings | None = None
    device: str = "cpu"


class Objective(Protocol):
    """Configuration of a loss: a frozen dataclass, so that equal ones are equal runs."""

    @property
    def perceptual(self) -> bool:
        """Whether it has a perceptual term, so that a distance must be given."""
        ...

    def task(self, inputs: StageInputs) -> Task:
        """Make the stage's batches and loss.

        Raises:
            InputError: Inputs that the objective cannot train on.
        """
        ...


@dataclass(frozen=True)
class Stage:
    """One training of a recipe, in a folder of its own.

    Args:
        name: Of the folder, and of the weights for later stages.
        objective: Loss.
        share: Updates, in units of the run's ``--steps`` (U).
        attention: From the clip's latents to what a latent attends to.
        conditioning: What the network sees.
        start: Initial weights by part: ``SOURCE.PART``, where the source is ``init``, ``init-bi``
            or an earlier stage. A part that is not named is the objective's to initialise; ``vae``
            is then the run's ``--vae``.
        trained: Trained parts, by the first names of their parameters, with learning rates relative
            to the run's.
        decay: How the learning rate falls after the warm-up.
        last_share: Share of the peak that it falls to.
        latents: Latents from a clip's start; None for the whole clip.
        deployed: Settings of its weights besides those that attention and ``conditioning`` say.
        always_float32: Whether its forward passes are in float32 whatever the run's precision is.
    """

    name: str
    objective: Objective
    share: float = 1.0
    attention: Callable[[int], Attention] = causal
    conditioning: Conditioning = Conditioning()
    start: Mapping[str, str] = field(default_factory=lambda: dict(DIT))
    trained: Mapping[str, PartSchedule] = field(default_factory=lambda: dict(TRAINED_DIT))
    decay: Literal["cosine", "exponential", "constant"] = "cosine"
    last_share: float = 0.01
    latents: int | None = None
    deployed: Mapping[str, Any] = field(default_factory=dict)
    always_float32: bool = False

    @property
    def sources(self) -> tuple[str, ...]:
        """Weights that it starts from, without their parts."""
        return tuple(dict.fromkeys(source.partition(".")[0] for source in self.start.values()))

    def updates(self, unit: int) -> int:
        """Return its updates in a run whose unit U is ``unit`` updates."""
        return max(round(self.share * unit), 1)


@dataclass(frozen=True)
class Recipe:
    """One system: the stages that train it, in order, and the settings that it is deployed with.

    Args:
        name: As in the paper, lower case.
        about: Short description for tables and cards.
        stages: In order; the last one's weights are the result.
        fixer: Fixer that gives sizes and settings.
    """

    name: str
    about: str
    stages: tuple[Stage, ...]
    fixer: str = "onefixer-dit-tiny"

    def __post_init__(self) -> None:
        sources = list(GIVEN)
        for stage in self.stages:
            if unknown := [source for source in stage.sources if source not in sources]:
                raise InputError(
                    f"{self.name}: stage {stage.name!r} starts from {', '.join(unknown)}",
                    f"name one of {', '.join(sources)}",
                )
            sources.append(stage.name)

    def settings(self, stage: Stage, latents: int) -> dict[str, Any]:
        """Return the settings to deploy a stage's weights with in a block generator, for clips of
        so many latents.
        """
        return {
            "steps": (1000.0,),
            **asdict(stage.attention(latents)),
            **stage.conditioning.settings(),
            **stage.deployed,
        }
