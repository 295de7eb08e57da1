"""The only place where the stages meet: one rollout, and runs of many."""
