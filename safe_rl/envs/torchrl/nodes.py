"""Nodes of `env=torchrl env.id=…`, see conf/env/torchrl.yaml.

A configuration may come from somebody else, so an `id` without a dot is one of `ROWS`, and any
other class of TorchRL's, or of one's own, is reached by `import=` alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from safe_rl.envs.errors import (
    ConfigError,
    nearest,
    require_boolean,
    require_integer,
    require_mapping,
    require_names,
)
from safe_rl.envs.torchrl.outside import parse_outside
from safe_rl.envs.torchrl.rows import ROWS

TORCHRL_TARGET = "safe_rl.envs.torchrl.make_torchrl"
DEFAULTS: dict[str, Any] = {
    **{"kwargs": None, "observe": None, "flatten": True, "num_steps": None},
    **{"cost_keys": None, "outside": None, "cost": None},
}


def complete_torchrl(node: Mapping[str, Any]) -> dict[str, Any]:
    """Fill a node up: the length of episodes is found by making an environment.

    Raises:
        ConfigError: for an unknown key or environment, or one that the algorithms cannot use.
    """
    for key in node:
        if key not in (*DEFAULTS, "id", "name", "_target_"):
            raise ConfigError(
                f"An environment of TorchRL has no key '{key}'."
                f"{nearest(str(key), [*DEFAULTS, 'id'])} Arguments of its class stand in 'kwargs', "
                "as env.kwargs='{frame_skip: 2}'."
            )
    env_id = node.get("id")
    if not isinstance(env_id, str):
        raise ConfigError(f"Which environment? env.id=…, one of {', '.join(ROWS)}, or your own.")
    if "." not in env_id and env_id not in ROWS:
        raise ConfigError(
            f"env.id={env_id} is not among {', '.join(ROWS)}.{nearest(env_id, ROWS)} Any other "
            "class of TorchRL's comes with import=torchrl.envs env.id=torchrl.envs.NAME, one of "
            "yours with import=my_module env.id=my_module.NAME, and one of Gymnasium's by its id "
            "with env=gymnasium."
        )
    full = {"name": env_id, **DEFAULTS, **node}
    _check(full)
    if None in (full["num_steps"], full["cost_keys"]):
        # here, because making environments needs TorchRL, and names of environments do not
        from safe_rl.envs.torchrl.batching import describe

        full["cost_keys"], full["num_steps"] = describe(full)
    if not (full["cost_keys"] or full["outside"] or full["cost"]):
        raise ConfigError(
            f"env.id={env_id}: what does a step cost? Name entries that are costs "
            "(env.cost_keys=[…]), the range that one has to stay in (env.outside='{cost_speed: "
            "[thdot, -4, 4]}'), or a function of yours (import=my_module env.cost=my_module:speed)."
        )
    return full


def _check(node: Mapping[str, Any]) -> None:
    if node["num_steps"] is not None:
        require_integer("num_steps", node["num_steps"], lowest=1)
    for key in ("observe", "cost_keys"):
        require_names(key, node[key])
    require_boolean("flatten", node["flatten"])
    require_mapping("kwargs", node["kwargs"])
    if node["outside"] is not None:
        parse_outside(node["outside"])
    name = (node["kwargs"] or {}).get("env_name")
    if isinstance(name, str) and ":" in name:
        module, _, plain = name.rpartition(":")
        raise ConfigError(
            f"env.kwargs.env_name={name}: configurations import nothing. If you trust '{module}', "
            f"use import={module} and env_name: {plain}"
        )
