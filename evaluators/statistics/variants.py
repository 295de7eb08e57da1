"""Variants: what is compared is a policy behind a renderer with its weights, and which other variant
each one is compared with.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.schema import cell_name
from alpasim_plugin.log.run_folder.sides import RolloutTable, Side


@dataclass(frozen=True)
class Variant:
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
    """What variants are compared with: a renderer behind which each policy also drove, a policy
    behind each renderer, or one variant.

    Attributes:
        renderer: The renderer; None: each variant's own.
        policy: The policy; None: each variant's own.
    """

    renderer: str | None = None
    policy: str | None = None

    @property
    def name(self) -> str:
        """Give ``RENDERER``, ``POLICY`` or ``RENDERER/POLICY``."""
        return cell_name(*(part for part in (self.renderer, self.policy) if part is not None))

    def of(self, variant: Variant) -> Variant:
        """Return the variant that a variant is compared with."""
        return Variant(self.renderer or variant.renderer, self.policy or variant.policy)

    def pairs(self, variants: Sequence[Variant]) -> list[tuple[Variant, Variant]]:
        """Return every variant that has another one to be compared with, and that one."""
        pairs = [(variant, self.of(variant)) for variant in variants]
        return [
            (variant, other) for variant, other in pairs if other != variant and other in variants
        ]


def short_name(variant: Variant, other: Variant) -> str:
    """Name a variant by what it does not share with the one that it is compared with."""
    if variant.policy == other.policy:
        return variant.renderer
    return variant.policy if variant.renderer == other.renderer else variant.name


def as_policy(side: Side, policy: str) -> Side:
    """Return rollouts as if a policy of that name had driven them, so that they pair with that
    policy's.
    """
    return replace(side, cells=tuple((policy, scene, seed) for _, scene, seed in side.cells))


def variants_of(cells: Iterable[tuple[str, str]]) -> list[Variant]:
    """Return the variants of (renderer, policy), each once, in order of appearance."""
    return [Variant(*cell) for cell in dict.fromkeys(cells)]


def variants_in(table: RolloutTable) -> list[Variant]:
    """Return the variants of a table, policy by policy."""
    return [Variant(name, policy) for policy in table.policies for name in table.sides(policy)]


def _names(variants: Sequence[Variant]) -> tuple[list[str], list[str]]:
    """Return renderers and policies, each once, in order of appearance."""
    renderers = dict.fromkeys(variant.renderer for variant in variants)
    return list(renderers), list(dict.fromkeys(variant.policy for variant in variants))


def base_named(text: str, variants: Sequence[Variant], owner: str) -> Base:
    """Return the base that a text names: RENDERER, POLICY or RENDERER/POLICY.

    Args:
        text: The name.
        variants: Those that there are.
        owner: Who has the variants, for the error.

    Raises:
        InputError: No variant has that name.

    Example:
        >>> base_named("clean/b", [Variant("clean", "a"), Variant("clean", "b")], "the run")
        Base(renderer='clean', policy='b')
    """
    renderers, policies = _names(variants)
    if text in renderers:
        return Base(renderer=text)
    if text in policies:
        return Base(policy=text)
    for variant in variants:
        if text == variant.name:
            return Base(variant.renderer, variant.policy)
    raise InputError(
        f"baseline {text!r}: {owner} does not have it",
        f"choose one of {', '.join(choices(variants)) or 'none'}",
    )


def choices(variants: Sequence[Variant]) -> list[str]:
    """Return the names that `base_named` knows, without those that name every variant."""
    renderers, policies = _names(variants)
    if len(policies) == 1:
        return renderers
    if len(renderers) == 1:
        return policies
    return [*renderers, *policies, *(variant.name for variant in variants)]


def usual_base(variants: Sequence[Variant], baseline: str | None = None) -> Base:
    """Return the base of a comparison where nothing else is asked for.

    Args:
        variants: Those that there are, in the order of the command.
        baseline: What the run was told to compare with; what no variant has counts as nothing.

    Returns:
        The named base; else the first renderer where there are several, else the first policy.
    """
    if not variants:
        return Base()
    for variant in variants:
        if variant.name == baseline:
            return Base(variant.renderer, variant.policy)
    by_renderer, by_policy = axis_bases(variants, baseline)
    if by_policy is not None and baseline == by_policy.policy:
        return by_policy
    return by_renderer or by_policy or Base(renderer=variants[0].renderer)


def axis_bases(
    variants: Sequence[Variant], baseline: str | None = None
) -> tuple[Base | None, Base | None]:
    """Return what renderers are compared with, and what policies are; None where there is only one.

    Args:
        variants: Those that there are, in the order of the command.
        baseline: A name that `base_named` knows; what it does not say is the first of its kind.
    """
    renderers, policies = _names(variants)
    named = Base()
    if baseline in {*renderers, *policies, *(variant.name for variant in variants)}:
        named = base_named(str(baseline), variants, "")
    return (
        Base(renderer=named.renderer or renderers[0]) if len(renderers) > 1 else None,
        Base(policy=named.policy or policies[0]) if len(policies) > 1 else None,
    )
