"""The interfaces of the replaceable parts. Required members are abstract; every other member is
optional and has its default here.

A part may inherit from its interface or only look like it: `complete` adds the defaults of the
optional members that it does not define, so that the loop never has to ask whether a member is
there. docs/extending.md shows one part of every kind.
"""

from __future__ import annotations

import copy
import inspect
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import MappingProxyType, MethodType
from typing import TYPE_CHECKING, Any, Protocol, TypeVar, runtime_checkable

from alpasim_plugin.core.errors import InputError, PolicyError, SimrunError

if TYPE_CHECKING:
    from alpasim_plugin.core.types import (
        U8,
        EgoState,
        Frame,
        MetricInfo,
        MetricSeries,
        Observation,
        Plan,
        RecordedFrame,
        RenderRequest,
        RolloutLog,
        Route,
        Scene,
        SensorSpec,
        Trajectory,
    )

EMPTY: Mapping[str, Any] = MappingProxyType({})


@dataclass(frozen=True)
class BlockRule:
    """How many frames a renderer or a fixer takes at a time.

    Example:
        >>> BlockRule.of_latents(2)
        BlockRule(first=5, then=8)
        >>> [BlockRule(5, 8).frames(i) for i in range(3)]
        [5, 8, 8]
    """

    first: int  # frames of a rollout's first block
    then: int  # frames of every later block

    @classmethod
    def of_latents(cls, latents: int) -> BlockRule:
        """Return the rule of a causal video autoencoder: the first latent holds one frame, every
        other one four.
        """
        return cls(1 + 4 * (latents - 1), 4 * latents)

    def frames(self, block: int) -> int:
        """Return the number of frames of block ``block``, counted from 0."""
        return self.first if block == 0 else self.then


@dataclass(frozen=True)
class Declaration:
    """What a part declares about itself before it is built; see
    `alpasim_plugin.core.parts.resolve.declaration_of`.

    Attributes:
        files: Files that shape what the part does, such as weights, by a name. A name that is a
            dotted key of the settings says that this setting is the file's path; the digest then
            holds the file's content instead of the path.
        trained: Whether the part's weights were learned; None where it has none.
        note: What the part is, for labels: "trained", "untrained (identity)".
        is_remote: The part's behaviour is decided elsewhere, as a service's is: it has no digest,
            and its rollouts are never reused.
        missing: What a user must still give before the part can be built, as an error says it;
            empty where nothing is missing. A run with such a part is refused before its first
            rollout.
    """

    files: Mapping[str, Path] = field(default_factory=dict)
    trained: bool | None = None
    note: str = ""
    is_remote: bool = False
    missing: str = ""


@runtime_checkable
class Renderer(Protocol):
    """One rollout's renderer session."""

    # requests carry a forecast of so many of the camera's next frames in ``ahead``
    lookahead: int = 0
    block: BlockRule | None = (
        # frames come in blocks of so many, and the policy is asked at each block's end; None: one
        # by one
        None
    )
    has_history: bool = True  # whether a frame may depend on the requests before its own
    # whether requests are of cameras with lenses; otherwise of the pinholes that cover them. A frame
    # through a lens has as depth the distance from the camera's centre.
    draws_lenses: bool = False
    stage_ms: Mapping[str, float] = (
        # parts of the last call's wall time that are stages of their own, such as {"fix": 12.0}
        EMPTY
    )

    @abstractmethod
    def render(self, request: RenderRequest) -> Frame:
        """Render one frame."""

    def render_batch(self, requests: Sequence[RenderRequest]) -> Sequence[Frame]:
        """Render all requests of an instant (of all cameras; of a whole block with ``block``). One
        by one unless overridden.
        """
        return [self.render(request) for request in requests]

    def recorded(self) -> Sequence[RecordedFrame]:
        """Return the frames of the recorded drive that the renderer's model was made from; none
        unless overridden.
        """
        return ()

    def facts(self) -> Mapping[str, Any]:
        """Return what the session is and did, for the rollout's manifest."""
        return {}


@runtime_checkable
class Fixer(Protocol):
    """One rollout's fixer session: repairs frames causally, from the past and the current block
    only.

    A block holds frames of one or several cameras in any order, each camera with the same number of
    frames, at most as many as ``blocks`` says. ``maps`` are the semantic maps of the same frames in
    the same order, or empty. What comes out has the order, times and cameras of what went in.
    """

    blocks: BlockRule = BlockRule(1, 1)  # frames of the first block and of each later one
    trained: bool = False  # whether the weights were learned
    label: str = ""  # what this is, for tables and reports: "onefixer, trained"
    reads_device: bool = False  # whether it takes a frame and its references from a device

    @abstractmethod
    def reset(self, seed: int) -> None:
        """Forget all history and take the noise of another seed."""

    @abstractmethod
    def step(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Fix a block and take it into the history."""

    def preview(self, block: Sequence[Frame], maps: Sequence[U8]) -> Sequence[Frame]:
        """Fix the block in progress and leave the history as it is; any number of times.

        By default a copy of the session makes the step. Override it where a session is large, or
        where a step after an equal preview can be had for nothing. It is called only for blocks of
        more than one frame.
        """
        return copy.deepcopy(self).step(block, maps)


@runtime_checkable
class Policy(Protocol):
    """Plans from observations."""

    sensors: Sequence[SensorSpec]  # which cameras, at which rate; nothing else is rendered
    # which controller moves the ego along its plans; declared on the class
    controller: str = "bicycle"
    # whether `Observation.road_users` tells it where the other road users are, which no camera has to
    # see; a reference, not a policy to be tested behind renderers
    sees_road_users: bool = False

    @abstractmethod
    def reset(self, seed: int, route: Route) -> None:
        """Start a new rollout."""

    @abstractmethod
    def act(self, observation: Observation) -> Plan:
        """Return the plan in the rig frame of the observation."""

    def end(self, frames: Mapping[str, Frame]) -> None:
        """Take the newest frame of each camera at the end of a rollout; no query follows."""
        return

    def close(self) -> None:
        """Give back what the policy holds, such as a session or a bus; called after a rollout, also
        after one that failed.
        """
        return

    def facts(self) -> Mapping[str, Any]:
        """Return what the policy did beside its plans, such as what happened on its bus, for the
        rollout's manifest.
        """
        return {}


@runtime_checkable
class Controller(Protocol):
    """Moves the ego along a plan. Pure, unless it is a remote one: the result depends on the
    arguments only.
    """

    # whether the poses that it returns stand on the ground; others are put on the scenario's
    grounds: bool = False

    @abstractmethod
    def advance(self, state: EgoState, plan: Trajectory | None, to_us: int) -> EgoState:
        """Return the state at ``to_us``.

        Args:
            state: The true state now.
            plan: Absolute rig poses in the world with their times; None: there is no plan yet,
                brake gently to a stop.
            to_us: When to arrive; later than ``state.t_us``.

        Raises:
            InputError: ``to_us`` is not later than ``state.t_us``.
        """

    def close(self) -> None:
        """Give back what the controller holds, such as a session; called after a rollout, also
        after one that failed.
        """
        return


@runtime_checkable
class Evaluator(Protocol):
    """Pure: a log in, series out; never a renderer, a policy or a GPU."""

    # the metrics that it gives and that `evaluators.metrics.METRICS` does not hold
    metrics: Mapping[str, MetricInfo] = EMPTY

    @abstractmethod
    def __call__(self, rollout: RolloutLog, scene: Scene) -> Sequence[MetricSeries]:
        """Score one rollout."""


@runtime_checkable
class Source(Protocol):
    """Reads one format of recorded drives."""

    help: str = ""  # the format in a few words: "Argoverse 2 log folder"

    @abstractmethod
    def matches(self, path: Path) -> bool:
        """Tell whether a file or folder has this format, without reading all of it."""

    @abstractmethod
    def read(self, path: Path, ego: str | None) -> Any:
        """Return the drive as a `scenarios.recorded.RecordedLog`.

        Args:
            path: File or folder.
            ego: Which recorded vehicle becomes the ego, for formats that do not say it; None: the
                reader chooses.
        """


T = TypeVar("T")


def complete(part: T, interface: Any, part_name: str = "") -> T:
    """Return a part with the defaults of the optional members that it does not define.

    Args:
        part: Any object with the interface's required members; it need not inherit from the
            interface.
        interface: Of this module.
        part_name: The part for messages.

    Raises:
        InputError: A required member is missing; of a policy it is a `PolicyError`, since only the
            loop finds it out.
    """
    required, optional = _members(interface)
    if inspect.isclass(part):
        raise contract_error(interface.__name__.lower())(
            f"{part_name}: the class {part.__name__}, not an object of it",
            f"Name the class itself, or return {part.__name__}(...).",
        )
    _require_none([n for n in required if not hasattr(part, n)], type(part), interface, part_name)
    for name, default in optional.items():
        if not hasattr(part, name):
            value = dict(default) if isinstance(default, Mapping) else default
            setattr(part, name, MethodType(value, part) if inspect.isfunction(value) else value)
    return part


def require_methods(factory: type, interface: Any, part_name: str) -> None:
    """Refuse a class without a method that its kind of part must have, before one is made.

    Raises:
        InputError: As `complete`.
    """
    required, _ = _members(interface)
    methods = [name for name in required if name not in interface.__annotations__]
    lacking = [name for name in methods if not hasattr(factory, name)]
    _require_none(lacking, factory, interface, part_name)


def _require_none(lacking: Sequence[str], made_by: type, interface: Any, part_name: str) -> None:
    if lacking:
        kind = interface.__name__.lower()
        required, _ = _members(interface)
        raise contract_error(kind)(
            f"{part_name or made_by.__name__}: a {made_by.__name__} without {', '.join(lacking)}",
            f"give it {', '.join(f'`{name}`' for name in required)}; docs/extending.md shows a {kind}",
        )


def contract_error(kind: str) -> type[SimrunError]:
    """Return the error of a part that does not have its kind's form: a policy is what is under
    test, so the fault is its own.
    """
    return PolicyError if kind == "policy" else InputError


def _members(interface: Any) -> tuple[list[str], dict[str, Any]]:
    """Return the names of the required members, and the optional ones with their defaults."""
    namespace = vars(interface)
    required = [name for name in interface.__annotations__ if name not in namespace]
    required += [
        name for name in namespace if getattr(namespace[name], "__isabstractmethod__", False)
    ]
    optional = [name for name in namespace if not name.startswith("_") and name not in required]
    return required, {name: namespace[name] for name in optional}
