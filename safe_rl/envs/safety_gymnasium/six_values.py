"""Six values of a step as Gymnasium's five: the cost joins those in `info`."""

from __future__ import annotations

from typing import Any

import gymnasium

from safe_rl.envs.costs import COST

__all__ = ["SixValues", "kinds_of"]

_SUM = "cost_sum"  # of the kinds: the same as the cost


def kinds_of(info: dict[str, Any]) -> list[str]:
    """Names of the kinds of costs in what Safety-Gymnasium's environments report beside the cost.

    Examples:
        >>> kinds_of({"cost_hazards": 1.0, "cost_sum": 1.0, "goal_met": True})
        ['cost_hazards']
    """
    return [key for key in info if key.startswith(f"{COST}_") and key != _SUM]


class SixValues(gymnasium.Wrapper):
    """An environment whose step returns (observation, reward, cost, terminated, truncated, info).

    Examples:
        >>> class Slide(gymnasium.Env):
        ...     observation_space = gymnasium.spaces.Box(-1, 1, (1,))
        ...     action_space = gymnasium.spaces.Box(-1, 1, (1,))
        ...     def step(self, action):
        ...         return action, 1.0, float(action[0] > 0), False, False, {"cost_ice": 0.0}
        >>> SixValues(Slide()).step([0.5])[-1]
        {'cost_ice': 0.0, 'cost': 1.0}
    """

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Take an action.

        Raises:
            ValueError: if the environment returns another number of values.
        """
        values: tuple[Any, ...] = self.env.step(action)
        if len(values) != 6:
            raise ValueError(
                f"A step of {self.env} returned {len(values)} values instead of six (observation, "
                "reward, cost, terminated, truncated, info). Five with the cost in info are for "
                "env=gymnasium."
            )
        observation, reward, cost, terminated, truncated, info = values
        others = {key: value for key, value in info.items() if key != _SUM}
        return observation, reward, terminated, truncated, {**others, COST: float(cost)}
