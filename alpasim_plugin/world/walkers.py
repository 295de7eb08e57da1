"""Road users on a track who wait for the ego where they would walk into its way."""

from dataclasses import dataclass

import numpy as np

from alpasim_plugin.core.geometry import interpolate, inverse
from alpasim_plugin.core.types import Actor, EgoState, Vehicle

SEEN_S = np.linspace(0.0, 1.5, 7)  # of the own track, on which one looks ahead
COVERED_S = 3.0  # the ego's way: the strip that it covers in that time, straight ahead
MARGIN_M = 0.5  # around its body
CHANGE_PER_S = 1.0  # one stops, and starts again, within a second


@dataclass
class Walker:
    """One who waits: its own time, by which it is on its track, lags behind the scene's.

    Who is in the ego's way already walks on.
    """

    actor: Actor
    lag_us: float = 0.0
    rate: float = 1.0  # of the own time: 1 walks, 0 stands

    def own_us(self, t_us: int) -> int:
        """Return the time at which its track is read."""
        return round(t_us - self.lag_us)

    def step(self, from_us: int, to_us: int, ego: EgoState, vehicle: Vehicle) -> None:
        """Walk on, or wait, from one time to the next."""
        track = self.actor.track
        seen_us = self.own_us(from_us) + np.round(SEEN_S * 1e6).astype(np.int64)
        poses = interpolate(track, np.clip(seen_us, track.t_us[0], track.t_us[-1]))
        from_ego = inverse(ego.T_world_rig) @ poses
        ahead_m = from_ego[:, 0, 3] - vehicle.rear_axle_to_centre_m
        lateral_m = np.abs(from_ego[:, 1, 3])
        reach_m = max(self.actor.box.length_m, self.actor.box.width_m) / 2 + MARGIN_M
        half_m = vehicle.box.length_m / 2 + reach_m
        covered_m = half_m + max(ego.speed_mps, 0.0) * COVERED_S
        inside = (ahead_m > -half_m) & (ahead_m < covered_m)
        inside &= lateral_m < vehicle.box.width_m / 2 + reach_m
        wanted = 0.0 if inside.any() and not inside[0] else 1.0
        step = CHANGE_PER_S * ((to_us - from_us) * 1e-6)
        self.rate += float(np.clip(wanted - self.rate, -step, step))
        self.lag_us += (1.0 - self.rate) * (to_us - from_us)
