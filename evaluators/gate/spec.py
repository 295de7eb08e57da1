"""Gate files: margins, limits and the least amount of data, as YAML (docs/ci.md)."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import BaseModel, ConfigDict, Field, model_validator

from alpasim_plugin.core.errors import EvaluatorError, InputError
from alpasim_plugin.io.config import load_yaml, validate
from alpasim_plugin.io.yaml_positions import Document
from evaluators.metrics import METRICS, MetricTable
from evaluators.presets import PRESETS

DOING = "reading a gate"
LIBRARY = Path(__file__).resolve().parents[2] / "configs" / "gates"


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class MetricRule(_Strict):
    """What one metric must meet: a margin on the paired difference, limits on the mean, or both."""

    margin: float | None = Field(default=None, ge=0.0, description="How much worse is accepted (without a better side: either way).")
    max: float | None = Field(default=None, description="Largest mean accepted.")
    min: float | None = Field(default=None, description="Smallest mean accepted.")
    must_decide: bool = Field(default=True, description="Undecided fails the gate with code 3; false: only worse does.")

    @model_validator(mode="after")
    def _says_something(self) -> MetricRule:
        if self.margin is None and self.max is None and self.min is None:
            raise ValueError("a rule without margin, max or min | add one of them, or remove the metric")
        return self


class GateSpec(_Strict):
    """A gate file."""

    version: Literal[1] = Field(description="Version of this schema: 1.")
    description: str = Field(default="", description="One sentence for people.")
    preset: str | None = Field(default=None, description="Evaluator preset that the run must have been scored with.")
    baseline: str | None = Field(
        default=None, description="Renderer to compare with; none: the run's first, or the same name in the stored baseline."
    )
    renderers: tuple[str, ...] = Field(default=(), description="Renderers to judge; none: all but the baseline.")
    min_scenes: int = Field(default=2, ge=2, description="Fewest scenes with a pair that a paired verdict may stand on.")
    max_failed: float = Field(default=0.0, ge=0.0, lt=1.0, description="Share of rollouts that may fail to run.")
    max_missing: float = Field(default=0.0, ge=0.0, lt=1.0, description="Share of cells that may lack a pair, per metric.")
    metrics: dict[str, MetricRule] = Field(min_length=1, description="Metric to rule.")


def load_gate(path_or_name: str | Path, known: MetricTable = METRICS) -> tuple[GateSpec, str]:
    """Read a gate file, or a shipped gate by name (``default``).

    Args:
        path_or_name: The file or the name.
        known: The metrics that it may name: those of the run that it judges.

    Returns:
        The gate and the file it came from.

    Raises:
        InputError: No such file, bad YAML, an unknown key, metric or preset: with file, line and column.
    """
    path = _locate(str(path_or_name))
    document = load_yaml(path, DOING)
    spec = validate(GateSpec, document, DOING)
    _check_names(spec, document, known)
    return spec, str(path)


def shipped_gates() -> list[str]:
    """Return the names of the gates that come with the package."""
    return sorted(path.stem for path in LIBRARY.glob("*.yaml"))


def _locate(text: str) -> Path:
    path = Path(text)
    if path.is_file():
        return path
    shipped = LIBRARY / f"{text}.yaml"
    if shipped.is_file():
        return shipped
    raise InputError(DOING, text, "no such file", f"name a YAML file, or a shipped gate: {', '.join(shipped_gates())}")


def _check_names(spec: GateSpec, document: Document, known: MetricTable) -> None:
    for name, rule in spec.metrics.items():
        try:
            facts = known.info(name)
        except EvaluatorError as error:
            raise document.error(DOING, ("metrics", name), f"no metric {name!r}", "simrun list metrics prints the known ones") from error
        if rule.margin == 0.0 and facts.direction == "none":
            found = f"a margin of 0 for {name!r}, which has no better side"
            raise document.error(DOING, ("metrics", name), found, "give the change to either side that is accepted")
    if spec.preset is not None and spec.preset not in PRESETS:
        raise document.error(DOING, ("preset",), f"preset {spec.preset!r}", f"known: {', '.join(PRESETS)}")
