"""Gymnasium environments over the closed loop: ``import alpasim_plugin.gym`` registers
``simrun/Drive-v0`` and ``simrun/Plan-v0``.

Needs the extra ``gym``. See docs/gym.md.
"""

from alpasim_plugin.core.errors import InputError

try:
    import gymnasium
except ImportError as error:
    raise InputError(
        f"library gymnasium: it cannot be imported: {error}",
        "install the extra [gym], or gymnasium>=1.0",
    ) from error

from alpasim_plugin.gym.env import DriveEnv
from alpasim_plugin.gym.reward import Reward

__all__ = ["DRIVE", "PLAN", "DriveEnv", "Reward"]

DRIVE = "simrun/Drive-v0"
PLAN = "simrun/Plan-v0"

for _id, _actions in ((DRIVE, "controls"), (PLAN, "trajectory")):
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id, entry_point="alpasim_plugin.gym.env:DriveEnv", kwargs={"actions": _actions}
        )
