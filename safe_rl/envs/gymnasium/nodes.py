"""Nodes of `env=gymnasium env.id=…`, see conf/env/gymnasium.yaml.

A configuration may come from somebody else, so an id that has Gymnasium import a module
("module:Name-v0") is refused: a module of one's own is named by `import=`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from typing import Any

import gymnasium

from safe_rl.envs.errors import (
    ConfigError,
    nearest,
    require_boolean,
    require_integer,
    require_mapping,
    require_names,
)
from safe_rl.envs.gymnasium.outside import CostsOutside, Ranges, check_outside

GYMNASIUM_TARGET = "safe_rl.envs.gymnasium.make_gymnasium"
KEYS = ("id", "cost_keys", "outside", "num_steps", "kwargs", "workers", "flatten", "render_mode")


def complete_gymnasium(node: Mapping[str, Any]) -> dict[str, Any]:
    """Fill a node up: costs and length of episodes are found by making and stepping one.

    Raises:
        ConfigError: for an unknown key or id, or an environment that the algorithms cannot use.
    """
    for key in node:
        if key not in (*KEYS, "name", "_target_"):
            raise ConfigError(
                f"A Gymnasium environment has no key '{key}'.{nearest(str(key), KEYS)} Arguments "
                "for gymnasium.make stand in 'kwargs', as env.kwargs='{render_fps: 30}'."
            )
    if not isinstance(node.get("id"), str):
        raise ConfigError("Which environment? Name a registered one: env.id=…")
    defaults: dict[str, Any] = {"name": node["id"], "cost_keys": None, "num_steps": None}
    defaults |= {"outside": None, "kwargs": None, "workers": 0, "flatten": False}
    defaults |= {"render_mode": None}
    full = {**defaults, **node}
    require_integer("workers", full["workers"], lowest=0)
    require_boolean("flatten", full["flatten"])
    require_mapping("kwargs", full["kwargs"])
    require_names("cost_keys", full["cost_keys"])
    if full["outside"] is not None:
        check_outside(full["outside"])
    if full["num_steps"] is not None:
        require_integer("num_steps", full["num_steps"], lowest=1)
    if None in (full["cost_keys"], full["num_steps"]):
        # here, because making environments needs TorchRL, and names of environments do not
        from safe_rl.envs.gymnasium.conversion import describe

        try:
            costs, steps = describe(
                maker(full), full["cost_keys"], full["num_steps"], full["flatten"]
            )
        except ConfigError:  # says which environment it is about
            raise
        except (gymnasium.error.Error, TypeError, ValueError) as error:
            raise ConfigError(f"env.id={full['id']}: {error}") from error
        full |= {"cost_keys": costs, "num_steps": steps}
    return full


def hint_of_gymnasium(name: str) -> str:
    """A sentence on how to choose what is no name, but Gymnasium's id of an environment; or none.

    Examples:
        >>> hint_of_gymnasium("CartPole-v1")
        " It is one of Gymnasium's: env=gymnasium env.id=CartPole-v1."
        >>> hint_of_gymnasium("Safexp-PointGoal1-v0"), hint_of_gymnasium("PointGaol1")
        ('', '')
    """
    spec = gymnasium.registry.get(name)
    if spec is None or str(spec.entry_point).startswith("safe_rl."):
        return ""
    return f" It is one of Gymnasium's: env=gymnasium env.id={name}."


def maker(config: Mapping[str, Any]) -> Callable[[], gymnasium.Env]:
    """Return a function that makes one environment.

    What is registered goes with it to other processes.

    Raises:
        ConfigError: for an id that is not registered.
    """
    env_id = config["id"]
    module, _, name = env_id.rpartition(":")
    if module:
        raise ConfigError(
            f"env.id={env_id}: configurations import nothing. If you trust '{module}', use "
            f"import={module} env.id={name}"
        )
    try:
        spec = gymnasium.spec(env_id)
    except gymnasium.error.Error as error:
        raise ConfigError(
            f"env.id={env_id}: {error} {nearest(env_id, gymnasium.registry)} A module that "
            "registers an environment is imported by import=my_module."
        ) from error
    kwargs = dict(config["kwargs"] or {})
    if config["num_steps"] is not None:
        kwargs.setdefault("max_episode_steps", config["num_steps"])
    if config["render_mode"] is not None:
        kwargs["render_mode"] = config["render_mode"]
    make = partial(gymnasium.make, spec, **kwargs)
    return partial(_with_costs, make, config["outside"]) if config["outside"] else make


def _with_costs(make: Callable[[], gymnasium.Env], outside: Ranges) -> gymnasium.Env:
    return CostsOutside(make(), outside)
