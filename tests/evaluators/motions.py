"""Motions with known speed and deceleration."""

import numpy as np

from tests.evaluators.eval_build import car, rollout, track

N = 80
CRUISE = np.linspace(0.0, 63.2, N)  # 8 m/s


def braking(at=40.0, to=20.0):
    """A drive that stops in front of a standing car with 5 m/s2, as the recording does not."""
    t = np.arange(N) * 0.1
    v = np.maximum(8.0 - 5.0 * np.maximum(t - 2.5, 0.0), 0.0)
    x = np.concatenate([[0.0], np.cumsum((v[1:] + v[:-1]) * 0.05)])
    return rollout(
        track(x, 0.0), [car("stands", track(np.full(N, at), 0.0))], log=track(CRUISE, 0.0)
    )
