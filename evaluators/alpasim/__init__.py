"""What AlpaSim does with scored rollouts: its settings file, the scene score, and the table over repeated sweeps."""

from evaluators.alpasim.files import metrics_results_table, metrics_unprocessed_table, results_summary
from evaluators.alpasim.reduction import ReducedRollout, ScoredRollout, reduce_run
from evaluators.alpasim.scene_score import SceneScore, scene_score
from evaluators.alpasim.settings import EvalSettings, load_settings
from evaluators.alpasim.sweeps import over_sweeps

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
