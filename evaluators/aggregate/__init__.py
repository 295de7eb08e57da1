"""From series to one value per rollout, and from rollouts to tables with intervals, pairs and a ledger of what was left out."""

from evaluators.aggregate.censoring import censoring
from evaluators.aggregate.paired import paired
from evaluators.aggregate.reduce import Ledger, Reduction, RolloutValue, reduce_rollout, rollout_values
from evaluators.aggregate.summary import aggregate

__all__ = ["Ledger", "Reduction", "RolloutValue", "aggregate", "censoring", "paired", "reduce_rollout", "rollout_values"]
