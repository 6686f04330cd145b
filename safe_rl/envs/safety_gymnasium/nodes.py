"""Nodes of `env=safety_gymnasium env.id=…`, see conf/env/safety_gymnasium.yaml."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from safe_rl.envs.costs import COST
from safe_rl.envs.errors import (
    ConfigError,
    nearest,
    require_integer,
    require_mapping,
    require_names,
)
from safe_rl.envs.safety_gymnasium.serve import MODULES

SAFETY_GYMNASIUM_TARGET = "safe_rl.envs.safety_gymnasium.make_safety_gymnasium"
DEFAULTS: dict[str, Any] = {
    **{"cost_keys": None, "num_steps": None, "kwargs": None},
    **{"workers": 0, "render_mode": None},
}


def complete_safety_gymnasium(node: Mapping[str, Any]) -> dict[str, Any]:
    """Fill a node up: kinds of costs and length of episodes are found by making and stepping one.

    Raises:
        ConfigError: for an unknown key or id, or if the package is not there.
    """
    for key in node:
        if key not in (*DEFAULTS, "id", "name", "_target_"):
            raise ConfigError(
                f"An environment of Safety-Gymnasium has no key '{key}'."
                f"{nearest(str(key), [*DEFAULTS, 'id'])} Arguments for safety_gymnasium.make stand "
                "in 'kwargs', as env.kwargs='{config: {…}}'."
            )
    if not isinstance(node.get("id"), str):
        raise ConfigError("Which environment? env.id=SafetyPointGoal1-v0, for example.")
    module, _, name = node["id"].rpartition(":")
    if module:  # which safety_gymnasium.make imports
        raise ConfigError(
            f"env.id={node['id']}: configurations import nothing. If you trust '{module}', use "
            f"env.id={name} and import={module}; for another Python, {MODULES}={module}."
        )
    full = {"name": node["id"], **DEFAULTS, **node}
    require_integer("workers", full["workers"], lowest=0)
    require_mapping("kwargs", full["kwargs"])
    require_names("cost_keys", full["cost_keys"])
    if full["num_steps"] is not None:
        require_integer("num_steps", full["num_steps"], lowest=1)
    if None in (full["cost_keys"], full["num_steps"]):
        # here, because making environments needs TorchRL, and names of environments do not
        from safe_rl.envs.safety_gymnasium.sources import describe

        found, steps = describe(full)
        if full["cost_keys"] is None:
            full["cost_keys"] = [COST, *found]
        full["num_steps"] = full["num_steps"] or steps
    if full["num_steps"] is None:
        raise ConfigError(
            f"env.id={full['id']} does not say how long episodes are: give env.num_steps=…"
        )
    return full
