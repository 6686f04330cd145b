"""Classes of `torchrl.envs` that configurations may name without `import=`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

# MuJoCo's own library is installed; the default of these classes is another package.
_MUJOCO = {"backend": "mujoco", "parallel": False}
ROWS: dict[str, Mapping[str, Any]] = {
    "PendulumEnv": {},
    "FinancialRegimeEnv": {},
    "GymEnv": {"categorical_action_encoding": True},
    **dict.fromkeys(("AntEnv", "HopperEnv", "HumanoidEnv", "Walker2dEnv"), _MUJOCO),
}
"""Name -> arguments that it gets unless `env.kwargs` has others."""
