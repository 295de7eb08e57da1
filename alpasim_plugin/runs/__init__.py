"""The closed loop: one rollout, and runs of many rollouts."""
