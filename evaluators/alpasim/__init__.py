"""What AlpaSim does with scored rollouts: its settings file, the scene score, and the table over
repeated sweeps.
"""

from evaluators.alpasim.results import (
    ReducedRollout,
    SceneScore,
    ScoredRollout,
    metrics_results_table,
    metrics_unprocessed_table,
    over_sweeps,
    reduce_run,
    results_summary,
    scene_score,
)
from evaluators.alpasim.settings import EvalSettings, load_settings

__all__ = [
    "EvalSettings",
    "ReducedRollout",
    "SceneScore",
    "ScoredRollout",
    "load_settings",
    "metrics_results_table",
    "metrics_unprocessed_table",
    "over_sweeps",
    "reduce_run",
    "results_summary",
    "scene_score",
]
