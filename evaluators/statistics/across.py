"""Paired differences within a run, or between two runs on the rollouts that both have."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

from alpasim_plugin.core.errors import InputError
from alpasim_plugin.log.run_folder.sides import RolloutTable
from evaluators.metrics import METRICS, MetricTable
from evaluators.results import DifferenceTable
from evaluators.statistics.baselines import check_scenes, scene_hashes, table_of_run
from evaluators.statistics.opening import Run
from evaluators.statistics.paired import BLOCKS, Pair, compare_pairs, pairs_within
from evaluators.statistics.variants import Base, base_named, choices, variants_in

NO_PAIRS: Sequence[Pair] = ()


@dataclass(frozen=True)
class Comparison:
    """Paired differences.

    Attributes:
        paired: VARIANT -> METRIC -> difference; a variant is RENDERER, or RENDERER/POLICY where
            there are several policies.
        paired_with_base: The same of renderers with a fixer against the renderer below it, where
            that is not the baseline.
        paired_policies: The same of policies behind one renderer, RENDERER/POLICY -> METRIC; empty
            where one variant is the baseline of all.
        notes: What a reader must know, such as policies that were paired although their names
            differ.
        metrics: What the metrics are.
    """

    paired: DifferenceTable
    paired_with_base: DifferenceTable = field(default_factory=dict)
    paired_policies: DifferenceTable = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    metrics: MetricTable = field(default_factory=lambda: METRICS)


def compare_within(
    run: Run,
    baseline: str | None,
    listed: int,
) -> Comparison:
    """Compare the variants of one run with one of them, by default with the run's own baseline, or
    with the first.

    Args:
        run: The run.
        baseline: RENDERER, POLICY or RENDERER/POLICY; None: renderers with the run's own, and
            policies too where there are several.
        listed: As for `evaluators.statistics.paired.paired`.

    Raises:
        InputError: Only one variant, or an unknown baseline.
    """
    table = table_of_run(run)
    variants = variants_in(table)
    base = None if baseline is None else base_named(baseline, variants, str(run.folder))
    if len(variants) < 2:
        only = variants[0].name if variants else "none"
        raise InputError(
            f"{run.folder}: only one variant, {only}",
            "name a second run, or run two renderers or two policies",
        )
    if base is not None and base.policy is not None:
        blocks: dict[str, Sequence[Pair]]
        pairs = [
            Pair(variant.name, variant, other, other.name)
            for variant, other in base.pairs(variants)
        ]
        blocks = dict.fromkeys(BLOCKS, NO_PAIRS) | {BLOCKS[0]: pairs}
    else:
        blocks = {**pairs_within(table, baseline or run.info.baseline, run.info.bases)}
        if baseline is not None:
            named = [pair for pair in blocks[BLOCKS[0]] if pair.baseline == baseline]
            blocks = dict.fromkeys(BLOCKS, NO_PAIRS) | {BLOCKS[0]: named}
            if len(table.renderers) == 1:
                raise InputError(
                    f"{run.folder}: only one renderer, {baseline}",
                    f"choose one of {', '.join(choices(variants))}",
                )
    tables = compare_pairs(table, blocks, run.table, listed=listed)
    paired, with_base, of_policies = (tables[block] for block in BLOCKS)
    return Comparison(paired, with_base, of_policies, metrics=run.table)


def compare_runs(
    first: Run,
    second: Run,
    baseline: str | None,
    listed: int,
) -> Comparison:
    """Compare the second run with the first: each variant with the one of the same name, or all with
    ``baseline`` of the first run.

    A policy is paired with the policy of the same name; where the runs share none and have one
    each, with the other's. A baseline is a RENDERER, a POLICY or a RENDERER/POLICY of the first
    run.

    Raises:
        InputError: The runs differ in preset or in a scene's content, share no scene, a renderer or
            policy has no partner, or a metric is another quantity in the other run.
    """
    folders = f"{first.folder} and {second.folder}"
    _check_alike(first, second, folders)
    table = table_of_run(second)
    base_table = table_of_run(first)
    base_variants = variants_in(base_table)
    named = None if baseline is None else base_named(baseline, base_variants, str(first.folder))
    names_policy = named is not None and named.policy is not None
    other_policy = _policy_of_another_name(table, base_table, names_policy)
    base = named or _usual_partner(base_table)
    if not names_policy:
        base = replace(base, policy=other_policy)
    pairs = []
    alone = []
    for variant in variants_in(table):
        other = base.of(variant)
        if other.renderer not in base_table.renderers:
            raise InputError(
                f"renderer {variant.renderer} of {second.folder}: {first.folder} has "
                f"{', '.join(base_table.renderers)}",
                "name one by --baseline",
            )
        if other not in base_variants:
            alone.append(variant.name)
            continue
        label = other.name if names_policy else other.renderer
        has_policy_in_key = len(table.policies) > 1 or names_policy
        key = variant.name if has_policy_in_key else variant.renderer
        pairs.append(Pair(key, variant, other, f"{first.folder}: {label}"))
    if not pairs:
        raise InputError(
            f"baseline {baseline!r}: behind no renderer of {second.folder}", "name RENDERER/POLICY"
        )
    partners = {pair.other for pair in pairs}
    expected = base_variants if baseline is None else []
    left = [variant.name for variant in expected if variant not in partners]
    notes = [] if other_policy is None else [_policy_note(table.policies[0], other_policy)]
    notes += other_weights(first, second)
    notes += without_partner(alone, second, first)
    notes += without_partner(left, first, second)
    metrics = second.table.joined(first.table, {*table.metrics} & {*base_table.metrics}, folders)
    tables = compare_pairs(table, {BLOCKS[0]: pairs}, metrics, base_table, listed)
    return Comparison(tables[BLOCKS[0]], notes=tuple(notes), metrics=metrics)


def _check_alike(first: Run, second: Run, folders: str) -> None:
    """Refuse runs that were scored by different rules or drove different scenes.

    Raises:
        InputError: They differ in preset or in a scene's content, or share no scene.
    """
    presets = [run.summary.preset for run in (first, second)]
    if presets[0] != presets[1]:
        raise InputError(
            f"{folders}: presets {presets[0]!r} and {presets[1]!r}",
            "give the command of one run again with --preset",
        )
    check_scenes(
        scene_hashes(first), scene_hashes(second), folders, "run both on the same scene files"
    )


def _usual_partner(table: RolloutTable) -> Base:
    """Return what all variants are compared with: the first run's renderer where it has one, else
    each variant's own.
    """
    return Base(renderer=table.renderers[0]) if len(table.renderers) == 1 else Base()


def _policy_of_another_name(
    table: RolloutTable, base_table: RolloutTable, names_policy: bool
) -> str | None:
    """Return the policy of the first run with which that of the second is compared although it has
    another name: where each run has one. None: policies are compared with those of their names, or
    with the one that the baseline names.

    Raises:
        InputError: No policy has a partner.
    """
    if {*table.policies} & {*base_table.policies}:
        return None
    if len(table.policies) == len(base_table.policies) == 1:
        return base_table.policies[0]
    if names_policy:
        return None
    raise InputError(
        f"policies {base_table.policies} and {table.policies}: none in common",
        "compare runs of one policy each or of the same policies, or name one with "
        "--baseline RENDERER/POLICY",
    )


def _policy_note(policy: str, other: str) -> str:
    return f"policy {policy} is compared with policy {other}"


def other_weights(first: Run, second: Run) -> tuple[str, ...]:
    """Say which parts have other weights in the second run: they are other variants, whatever their
    names.
    """
    before = first.info.weights
    after = second.info.weights
    changed = sorted(name for name in before.keys() & after.keys() if before[name] != after[name])
    return (f"other weights: {', '.join(changed)}",) if changed else ()


def without_partner(names: Sequence[str], run: Run, other: Run) -> tuple[str, ...]:
    """Say which variants of a run are not compared since the other run has none of that name;
    nothing where there are none.
    """
    if not names:
        return ()
    return (
        f"not compared, since {other.folder} has no partner: {', '.join(names)} of {run.folder}",
    )
