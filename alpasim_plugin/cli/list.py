"""``simrun list``: names for the command line, and the runs below a folder.

What a kind needs is imported where it is listed, so that a short list loads no numerical library.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal, get_args

from alpasim_plugin.cli.options import Json
from alpasim_plugin.cli.output import show
from alpasim_plugin.core.errors import InputError
from alpasim_plugin.core.flags import Flag, Positional
from alpasim_plugin.core.parts import names, unidentified
from alpasim_plugin.core.parts.resolve import declaration_of, note_of
from alpasim_plugin.core.parts.source import load

EPILOG = """
Examples:

- `simrun list scenarios`

- `simrun list runs`: every run folder below runs/, the newest first

- `simrun list runs nightly --renderer onefixer --metric offroad`
"""

Kind = Literal["renderers", "fixers", "policies", "scenarios", "metrics", "presets", "runs"]


def list_names(
    kind: Annotated[Kind | None, Positional("What to list; without it, the kinds.")] = None,
    roots: Annotated[
        tuple[Path, ...],
        Positional("Folders of runs; default: runs.", metavar="[FOLDER]..."),
    ] = (),
    renderer: Annotated[
        tuple[str, ...], Flag("Runs with this renderer; * and ? match. Repeatable.")
    ] = (),
    policy: Annotated[
        tuple[str, ...], Flag("Runs with this policy; * and ? match. Repeatable.")
    ] = (),
    metric: Annotated[tuple[str, ...], Flag("Show this metric of each run. Repeatable.")] = (),
    as_json: Json = False,
) -> None:
    """List renderers, fixers, policies, scenarios, metrics, presets or runs."""
    if kind == "runs":
        from alpasim_plugin.cli.list_runs import list_runs

        list_runs(roots or (Path("runs"),), renderer, policy, metric, as_json)
        return
    if roots or renderer or policy or metric:
        raise InputError(f"simrun list {kind}: filters are for runs", "Leave them out.")
    descriptions = DESCRIPTIONS[kind]() if kind is not None else _kinds()
    width = max((len(name) for name in descriptions), default=0)
    show(
        as_json, descriptions, *(f"{name:<{width}}  {text}" for name, text in descriptions.items())
    )


def _kinds() -> Mapping[str, str]:
    return {name: f"simrun list {name}" for name in get_args(Kind)}


def _renderers() -> Mapping[str, str]:
    descriptions = names("renderer")
    for name, text in names("fixer").items():
        descriptions[name] = f"3dgs, repaired by the fixer {name}: {text}"
    return descriptions


def _fixers() -> Mapping[str, str]:
    descriptions = {}
    for fixer, help_text in names("fixer").items():
        spec = unidentified("fixer", fixer)
        factory = load(spec.target, "fixer")
        help_text = getattr(factory, "help", {}).get(fixer, help_text)
        declaration = declaration_of(factory, spec.settings)
        descriptions[fixer] = f"{help_text} [{note_of(spec, declaration)}]"
    return descriptions


def _policies() -> Mapping[str, str]:
    return names("policy")


def _scenarios() -> Mapping[str, str]:
    from scenarios.suite import shipped

    return shipped()


def _metrics() -> Mapping[str, str]:
    from evaluators.metrics import table_of
    from evaluators.metrics.score import resolve_plugins

    return {name: facts.help for name, facts in table_of(resolve_plugins()).items()}


def _presets() -> Mapping[str, str]:
    from evaluators.metrics.presets import described

    return described()


# What each kind lists: a name, and a sentence about it.
DESCRIPTIONS = {
    "renderers": _renderers,
    "fixers": _fixers,
    "policies": _policies,
    "scenarios": _scenarios,
    "metrics": _metrics,
    "presets": _presets,
}
