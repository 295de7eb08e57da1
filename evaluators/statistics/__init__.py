"""From series to one value per rollout, from rollouts to tables with intervals and pairs, and from
these to verdicts.
"""
