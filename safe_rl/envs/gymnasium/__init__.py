"""The environments of safe_rl in Gymnasium's interfaces, and Gymnasium's in TorchRL's interface.

`info` contains the costs, `info["cost"]` and one `info["cost_<kind>"]` per constrained kind, and
events such as `info["goal_met"]`. `gymnasium.make` and `gymnasium.make_vec` know the environments
by the ids that `safe_rl.envs.families` registers.
"""

from safe_rl.envs.gymnasium.conversion import make_gymnasium, make_safety_gymnasium

__all__ = ["make_gymnasium", "make_safety_gymnasium"]
