"""Arms: what is compared is a policy behind a renderer with its weights, and which other arm each
one is compared with.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.schema import cell_name
from alpasim_plugin.log.run_folder.sides import Side


@dataclass(frozen=True)
class Arm:
    """A policy behind a renderer; within a run the renderer's name stands for its weights, whose
    digests are in ``run.json``.
    """

    renderer: str
    policy: str

    @property
    def name(self) -> str:
        """Give ``RENDERER/POLICY``."""
        return cell_name(self.renderer, self.policy)


@dataclass(frozen=True)
class Base:
    """What arms are compared with: a renderer behind which each policy also drove, a policy behind
    each renderer, or one arm.

    Attributes:
        renderer: The renderer; None: each arm's own.
        policy: The policy; None: each arm's own.
    """

    renderer: str | None = None
    policy: str | None = None

    @property
    def name(self) -> str:
        """Give ``RENDERER``, ``POLICY`` or ``RENDERER/POLICY``."""
        return cell_name(*(part for part in (self.renderer, self.policy) if part is not None))

    def of(self, arm: Arm) -> Arm:
        """Return the arm that an arm is compared with."""
        return Arm(self.renderer or arm.renderer, self.policy or arm.policy)

    def pairs(self, arms: Sequence[Arm]) -> list[tuple[Arm, Arm]]:
        """Return every arm that has another one to be compared with, and that one."""
        known = set(arms)
        return [
            (arm, self.of(arm)) for arm in arms if self.of(arm) != arm and self.of(arm) in known
        ]


def short_name(arm: Arm, other: Arm) -> str:
    """Name an arm by what it does not share with the one that it is compared with."""
    if arm.policy == other.policy:
        return arm.renderer
    return arm.policy if arm.renderer == other.renderer else arm.name


def as_policy(side: Side, policy: str) -> Side:
    """Return rollouts as if a policy of that name had driven them, so that they pair with that
    policy's.
    """
    cells = tuple((policy, scene, seed) for _, scene, seed in side.cells)
    return replace(side, cells=cells)


def arms_of(cells: Iterable[tuple[str, str]]) -> list[Arm]:
    """Return the arms of (renderer, policy), each once, in order of appearance."""
    return [Arm(*cell) for cell in dict.fromkeys(cells)]


def base_named(text: str, arms: Sequence[Arm], where: str) -> Base:
    """Return the base that a text names: RENDERER, POLICY or RENDERER/POLICY.

    Args:
        text: The name.
        arms: Those that there are.
        where: Who has the arms, for the error.

    Raises:
        InputError: No arm has that name.

    Example:
        >>> base_named("clean/b", [Arm("clean", "a"), Arm("clean", "b")], "comparing", "the run")
        Base(renderer='clean', policy='b')
    """
    if any(text == arm.renderer for arm in arms):
        return Base(renderer=text)
    if any(text == arm.policy for arm in arms):
        return Base(policy=text)
    match = next((arm for arm in arms if text == arm.name), None)
    if match is None:
        raise InputError(
            f"baseline {text!r}: {where} does not have it",
            f"choose one of {', '.join(choices(arms)) or 'none'}",
        )
    return Base(match.renderer, match.policy)


def choices(arms: Sequence[Arm]) -> list[str]:
    """Return the names that `base_named` knows, without those that name every arm."""
    renderers, policies = (
        list(dict.fromkeys(names))
        for names in ([a.renderer for a in arms], [a.policy for a in arms])
    )
    if len(policies) == 1:
        return renderers
    return policies if len(renderers) == 1 else [*renderers, *policies, *(arm.name for arm in arms)]


def usual_base(arms: Sequence[Arm], baseline: str | None = None) -> Base:
    """Return the base of a comparison where nothing else is asked for.

    Args:
        arms: Those that there are, in the order of the command.
        baseline: What the run was told to compare with; what no arm has counts as nothing.

    Returns:
        The named base; else the first renderer where there are several, else the first policy.
    """
    if not arms:
        return Base()
    named = next((arm for arm in arms if arm.name == baseline), None)
    if named is not None:
        return Base(named.renderer, named.policy)
    by_renderer, by_policy = axis_bases(arms, baseline)
    if by_policy is not None and baseline == by_policy.policy:
        return by_policy
    return by_renderer or by_policy or Base(renderer=arms[0].renderer)


def axis_bases(arms: Sequence[Arm], baseline: str | None = None) -> tuple[Base | None, Base | None]:
    """Return what renderers are compared with, and what policies are; None where there is only one.

    Args:
        arms: Those that there are, in the order of the command.
        baseline: A name that `base_named` knows; what it does not say is the first of its kind.
    """
    renderers, policies = (
        list(dict.fromkeys(names))
        for names in ([a.renderer for a in arms], [a.policy for a in arms])
    )
    named = Base()
    if baseline in {*renderers, *policies, *(arm.name for arm in arms)}:
        named = base_named(str(baseline), arms, "")
    return (
        Base(renderer=named.renderer or renderers[0]) if len(renderers) > 1 else None,
        Base(policy=named.policy or policies[0]) if len(policies) > 1 else None,
    )
