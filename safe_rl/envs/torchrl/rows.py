"""Classes of `torchrl.envs` that configurations may name without `import=`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class Row(NamedTuple):
    """A class of `torchrl.envs` that configurations may name.

    Attributes:
        kwargs: arguments that it gets unless `env.kwargs` has others.
    """

    kwargs: Mapping[str, Any]


# MuJoCo's own library is installed; the default of these classes is another package.
_MUJOCO = Row({"backend": "mujoco", "parallel": False})
ROWS: dict[str, Row] = {
    "PendulumEnv": Row({}),
    "FinancialRegimeEnv": Row({}),
    "GymEnv": Row({"categorical_action_encoding": True}),
    **dict.fromkeys(("AntEnv", "HopperEnv", "HumanoidEnv", "Walker2dEnv"), _MUJOCO),
}
