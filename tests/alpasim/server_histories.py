"""Requests of rollouts that part from one another."""

SLOWLY_APART = (
    {},
    {},
    {"aside_mps": 0.05},
    {"aside_mps": 0.5},
    {"brake_mps2": 8.0},
    {"brake_mps2": 3.0, "aside_mps": 0.3},
)
