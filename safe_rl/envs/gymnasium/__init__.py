"""The environments in Gymnasium's interfaces, and Gymnasium's environments in TorchRL's.

Costs stand in `info`: `info["cost"]`, one `info["cost_<kind>"]` per constrained kind, and
`info["goal_met"]`. `gymnasium.make` and `gymnasium.make_vec` find the environments under the ids
that `safe_rl.envs.registration` registers.
"""

from typing import TYPE_CHECKING

from safe_rl.lazy import import_later

if TYPE_CHECKING:
    from safe_rl.envs.gymnasium.conversion import make_gymnasium, make_safety_gymnasium

__all__ = ["make_gymnasium", "make_safety_gymnasium"]

__getattr__, __dir__ = import_later(
    __name__, dict.fromkeys(__all__, "safe_rl.envs.gymnasium.conversion")
)
