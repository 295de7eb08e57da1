"""Files for a CI service: summary.md and junit.xml of a run, and the same of a gate."""

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from alpasim_plugin.core.escape import markdown, terminal, xml
from alpasim_plugin.core.files import read_text, real
from alpasim_plugin.core.files.atomic import write_text
from alpasim_plugin.log.run_folder.reader import reporting
from alpasim_plugin.log.run_folder.rows import Rollout
from evaluators.metrics.outcomes import in_words, outcomes_of, told
from evaluators.metrics.presets import contact_note
from evaluators.pages import tables
from evaluators.pages.gate import worst_of, write_gate
from evaluators.pages.html import command_of
from evaluators.pages.overview import overview_of
from evaluators.pages.terminal import forest_lines
from evaluators.statistics.gate import GateVerdict
from evaluators.statistics.numbers import Cell, plural, short
from evaluators.statistics.opening import Run

PLOT_LETTERS = 80  # of a line of the plot
MAX_BYTES = 1_000_000  # job pages refuse more than 1 MiB
CUT_NOTE = "\n_Cut here: the full tables are in report.html and rollouts.parquet._\n"
# cases whose metric values are written, 2 KB each: CI servers refuse files of tens of megabytes
MAX_WITH_VALUES = 2000
SUMMARY_VARIABLE = "GITHUB_STEP_SUMMARY"
INTERVAL_NOTE = "a to b is the 95 % interval with scenes as clusters"
CHECK_FACTS = ("diff", "ci95", "interval", "margin", "mean", "max", "min", "n_scenes")
PAIR_HEADS = ("variant", "baseline", "metric", "difference", "95 % interval", "p", "verdict")


def _as_markdown(value: object) -> Markup:
    return value if isinstance(value, Markup) else Markup(markdown(str(value)))


def _as_xml(value: object) -> str:
    return value if isinstance(value, Markup) else xml(str(value))


# Every value that a template prints goes through `finalize`; XML's own escapes come after it.
MARKDOWN, JUNIT = (
    Environment(
        loader=PackageLoader("evaluators.pages"),
        finalize=finalize,
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    for finalize in (_as_markdown, _as_xml)
)


def write_summary_md(run: Run) -> Path:
    """Write ``summary.md`` into a run folder and return its path: the first screen, all metrics in
    a fold, and the command.
    """
    path = run.folder / "summary.md"
    heads = [
        f"{column.variant} ({plural(column.n_rollouts, 'rollout')}, {plural(column.n_scenes, 'scene')})"
        for column in tables.columns(run)
    ]
    with reporting(run):
        metrics = [
            [
                " ".join(filter(None, (row.name, f"({row.unit})" if row.unit else "", row.arrow))),
                *map(_cell_text, row.cells),
            ]
            for row in tables.metric_rows(run.summary, run.invalid_reasons, run.table)
        ]
        pairs = [
            [
                pair.variant,
                pair.baseline,
                pair.metric,
                pair.diff.text,
                pair.interval.text,
                pair.p_value.text,
                pair.verdict,
            ]
            for pair in tables.pair_rows(run.summary.differences, run.table)
        ]
        note = contact_note(run.summary.preset)
        text = MARKDOWN.get_template("summary.md.j2").render(
            metric_heads=["metric", *heads],
            metrics=metrics,
            note=". ".join(filter(None, (INTERVAL_NOTE, note))) + ".",
            pair_heads=PAIR_HEADS,
            pairs=pairs,
            command=Markup(terminal(command_of(run)).replace("`", "")),
            **_first_screen(run),
        )
    write_text(path, cut(text))
    return path


def _first_screen(run: Run) -> dict[str, Any]:
    """Return what the first screen's template prints."""
    overview = overview_of(run)
    forest = "\n".join(line.plain.rstrip() for line in forest_lines(overview, PLOT_LETTERS))
    body = [overview.cells(row) for row in overview.rows]
    return {"overview": overview, "body": body, "forest": Markup(forest.replace("`", ""))}


def cut(text: str, limit: int = MAX_BYTES) -> str:
    """Cut at the end of a line so that the text with its note stays within ``limit`` bytes of
    UTF-8.
    """
    data = text.encode()
    if len(data) <= limit:
        return text
    kept = data[: limit - len(CUT_NOTE.encode())]
    return kept[: kept.rfind(b"\n") + 1].decode() + CUT_NOTE


def _cell_text(cell: Cell) -> str:
    """Print a mean with its count and interval, or why there is none."""
    if cell.missing:
        return f"{cell.text} ({cell.note})" if cell.note else cell.text
    return f"{cell.text}, {cell.detail}" if cell.detail else cell.text


@dataclass(frozen=True)
class Case:
    """A test case of JUnit.

    Attributes:
        result: ``pass``, ``failure``, ``error`` or ``skipped``; the next three say why.
        facts: Its properties.
    """

    group: str
    name: str
    facts: Mapping[str, object]
    time_s: float = 0.0
    result: str = "pass"
    kind: str = ""
    message: str = ""
    text: str = ""


@dataclass(frozen=True)
class Suite:
    """A suite of JUnit's cases."""

    name: str
    cases: list[Case]
    facts: Mapping[str, object] = field(default_factory=dict)
    timestamp: str = ""

    @property
    def time_s(self) -> float:
        """Give how long its cases took."""
        return sum(case.time_s for case in self.cases)


def write_junit(run: Run) -> Path:
    """Write ``junit.xml`` into a run folder and return its path."""
    with reporting(run):
        return _write_suites(run.folder / "junit.xml", [rollout_suite(run)])


def _write_suites(path: Path, suites: Sequence[Suite]) -> Path:
    time_s = sum(suite.time_s for suite in suites)
    cases = [case for suite in suites for case in suite.cases]
    text = JUNIT.get_template("junit.xml.j2").render(suites=suites, cases=cases, time_s=time_s)
    write_text(path, text)
    return path


def rollout_suite(run: Run, outcomes_fail: bool = True, accepts_failures: bool = False) -> Suite:
    """Return one case for each rollout.

    Args:
        run: The run.
        outcomes_fail: A rollout with an outcome is a failed case; otherwise the outcome is a
            property of the case alone.
        accepts_failures: A rollout that did not run to its end is skipped and no error.
    """
    named = run.info.asked or ()
    counts = Counter(rollout.cell for rollout in run.rollouts)
    facts = {
        "preset": run.summary.preset,
        "version": run.info.version,
        "key": run.info.key,
        "command": " ".join(run.info.command),
    }
    with_values = len(run.rollouts) <= MAX_WITH_VALUES
    return Suite(
        # what the command named, if that was one thing
        named[0] if len(named) == 1 else name_of(run),
        [
            _rollout_case(
                rollout,
                case_name(rollout, counts[rollout.cell] > 1),
                with_values,
                outcomes_fail,
                accepts_failures,
            )
            for rollout in run.rollouts
        ]
        + check_cases(run),
        {key: value for key, value in facts.items() if value},
        run.info.started_at or "",
    )


def check_cases(run: Run) -> list[Case]:
    """Return a skipped case for each breach that the check of a policy found before the run: it
    fails nothing, and CI services list it.
    """
    return [
        Case(f"check.{policy}", name, {}, result="skipped", message=sentence)
        for policy, check in run.info.policy_checks.items()
        for name, sentence in check.breaches
    ]


def name_of(run: Run) -> str:
    """Return the name of a run's folder, or of those of the runs that were joined."""
    return ", ".join(real(folder).name for folder in run.folders or (run.folder,))


def case_name(rollout: Rollout, is_repeated: bool) -> str:
    """Return the name of a rollout's case within its scene; of several logs of one cell with the
    log's name, since CI services take cases of one name for one.
    """
    name = f"{rollout.renderer}/{rollout.policy}/{rollout.seed}"
    return f"{name} {rollout.log}" if is_repeated and rollout.log else name


def _rollout_case(
    rollout: Rollout, name: str, with_values: bool, outcomes_fail: bool, accepts_failures: bool
) -> Case:
    time_s = rollout.wall_s or 0.0
    facts: dict[str, object] = {"path": rollout.path} if rollout.path else {}
    if not rollout.ok:
        kind = rollout.failure_class or "unknown"
        lines = [line for line in rollout.failure.splitlines() if line.strip()]
        message = lines[0] if lines else "no message was recorded"
        result = "skipped" if accepts_failures else "error"
        return Case(rollout.scene, name, facts, time_s, result, kind, message, rollout.failure)
    outcomes = outcomes_of(rollout)
    words = in_words(outcomes)
    facts["outcome"] = words
    if with_values:
        for metric, value in rollout.metrics.items():
            facts[metric] = "invalid" if value is None else value
    if not (outcomes and outcomes_fail):
        return Case(rollout.scene, name, facts, time_s)
    kind = told(outcomes)[0].name
    return Case(rollout.scene, name, facts, time_s, "failure", kind, words, words)


def check_suite(verdict: GateVerdict, gate: str) -> Suite:
    """Return one case for each check of a gate.

    A check that is worse or over its limit is a failure of type ``regression``, one that is not
    decided a failure of type ``undecided``; one that does not bind is skipped.
    """
    cases = []
    for check in verdict.checks:
        facts = {key: check.entry[key] for key in CHECK_FACTS if check.entry.get(key) is not None}
        result = "pass"
        kind = ""
        if check.cause != "pass":
            result, kind = ("failure", check.cause) if check.binding else ("skipped", "")
        cases.append(
            Case(
                f"gate.{check.renderer}/{check.policy}",
                f"{check.metric} {check.kind}",
                facts,
                result=result,
                kind=kind,
                message=check.text,
                text=check.text,
            )
        )
    has_failed = any(case.result == "failure" for case in cases)
    if verdict.exit_code != 0 and not has_failed:  # what decides is in no check
        text = "; ".join(verdict.outcome.reasons)
        cause = verdict.outcome.cause
        cases.append(Case("gate", "verdict", {}, 0.0, "failure", cause, text, text))
    facts = {"about": verdict.about}
    if verdict.sizes:
        facts["sizes"] = "; ".join(verdict.sizes)
    return Suite(f"gate {gate}", cases, facts)


def write_gate_files(verdict: GateVerdict, gate: str, run: Run, folder: Path | None) -> list[Path]:
    """Write ``gate.md``, ``gate.junit.xml`` and in the run folder ``gate.json``; append the
    Markdown to what $GITHUB_STEP_SUMMARY names.

    How the rollouts ended fails nothing in ``gate.junit.xml``: the gate's checks are the verdict.

    Args:
        verdict: What `evaluators.statistics.gate.check_gate` gave.
        gate: Name or file of the gate.
        run: The run that was gated, or several that were joined.
        folder: Where the files go; None: nowhere.

    Returns:
        The files that were written.

    Raises:
        InfrastructureError: The disk refused.
    """
    checks = []
    for check in verdict.checks:
        result = check.cause if check.binding else f"{check.cause} (not binding)"
        variant = f"{check.renderer}/{check.policy}"
        checks.append([check.metric, variant, result, check.kind, check.text])
    worst = []
    for pair in worst_of(verdict.as_dict()["checks"]):
        names = [pair["scene"], f"{pair['renderer']}/{pair['policy']}", pair["seed"]]
        worst.append([*names, pair["metric"], short(pair["was"]), short(pair["now"])])
    text = MARKDOWN.get_template("gate.md.j2").render(
        verdict=verdict, gate=gate, run=run.title, checks=checks, worst=worst, **_first_screen(run)
    )
    _append_job_summary(text)
    if folder is None:
        return []
    folder.mkdir(parents=True, exist_ok=True)
    page = folder / "gate.md"
    write_text(page, cut(text))
    rollouts = rollout_suite(run, outcomes_fail=False, accepts_failures=verdict.accepts_failures)
    suites = [check_suite(verdict, gate), rollouts]
    tests = _write_suites(folder / "gate.junit.xml", suites)
    if run.folders or real(folder) != real(run.folder):
        return [page, tests]
    return [page, tests, write_gate(run, verdict, gate)]


def _append_job_summary(text: str) -> None:
    """Append Markdown to the CI job's summary file, if $GITHUB_STEP_SUMMARY names one; the whole
    file stays below 1 MiB.
    """
    named = os.environ.get(SUMMARY_VARIABLE)
    if not named:
        return
    path = Path(named)
    before = read_text(path).rstrip("\n") + "\n\n" if os.path.exists(path) else ""
    room = MAX_BYTES - len(before.encode())
    if room > len(CUT_NOTE):
        write_text(path, before + cut(text, room))
