"""The table of families: names of environments, and the nodes of the configuration they stand for.

The key `_target_` of a node names its family: a function or class that is called with a mapping of
the node's other keys, and `num_envs=`, `device=`, `seed=` and `num_threads=`. A node without one is
Safety Gym's. Nothing here imports what builds environments, so that names and keys are known fast.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from safe_rl.envs.foreign import GYMNASIUM, SAFETY_GYMNASIUM, TORCHRL, complete_foreign
from safe_rl.envs.safety_gym.suite import EXTRAS, SUITE, resolve
from safe_rl.envs.velocity.velocity_config import VELOCITY_SUITE, resolve_velocity

GROUP = "env"
"""Of configurations, in Hydra."""
VELOCITY_TARGET = "safe_rl.envs.velocity.VelocityEnv"


@dataclass(frozen=True)
class Family:
    """What nodes with one `_target_` have in common.

    Attributes:
        complete: Fills up a node that holds only what differs from the defaults.
        suite: Name -> configuration, for environments that have a name of their own.
    """

    complete: Callable[[Mapping[str, Any]], dict[str, Any]]
    suite: Mapping[str, Any]


def config_node(name: str, config: Any, target: str | None = None) -> dict[str, Any]:
    """Return a configuration as a node of the group `env`: `name`, family, and every key.

    Args:
        name: Of the environment.
        config: A `SafetyGymConfig` or a `VelocityConfig`.
        target: `_target_` of the family; None is Safety Gym's.

    Examples:
        >>> config_node("mine", VELOCITY_SUITE["SafeHopperVelocity"])["healthy_angle_range"]
        [-0.2, 0.2]
    """
    family = {} if target is None else {"_target_": target}
    return {"name": name, **family, **{k: _plain(v) for k, v in config.to_dict().items()}}


def _plain(value: Any) -> Any:
    """Turn tuples into lists: Hydra knows no tuples."""
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def _complete(
    resolve: Callable[[Mapping[str, Any]], Any], target: str | None, node: Mapping[str, Any]
) -> dict[str, Any]:
    """Add the defaults of the keys that a node lacks; those it has stay as they are written."""
    config = resolve({key: value for key, value in node.items() if key not in ("name", "_target_")})
    return {**config_node(node.get("name", "custom"), config, target), **node}


FAMILIES: dict[str | None, Family] = {
    None: Family(partial(_complete, resolve, None), SUITE | EXTRAS),
    VELOCITY_TARGET: Family(partial(_complete, resolve_velocity, VELOCITY_TARGET), VELOCITY_SUITE),
    **{
        foreign.target: Family(partial(complete_foreign, foreign), {})
        for foreign in (GYMNASIUM, TORCHRL, SAFETY_GYMNASIUM)
    },
}
"""`_target_` -> family; nodes with any other are taken as they are."""

_TARGETS = {name: target for target, family in FAMILIES.items() for name in family.suite}


def env_names() -> list[str]:
    """Names that stand for an environment of any family."""
    return list(_TARGETS)


def env_node(name: str) -> dict[str, Any]:
    """Return the node of the group `env` that a name stands for, with every key.

    Raises:
        KeyError: If there is no such name.

    Examples:
        >>> env_node("CarPush2")["pillars_num"]
        4
    """
    target = _TARGETS[name]
    return config_node(name, FAMILIES[target].suite[name], target)


def complete_env(node: Mapping[str, Any]) -> dict[str, Any]:
    """Fill up a node that holds only what differs from its family's defaults.

    Args:
        node: As `make_env` takes it; what it holds stays as it is.

    Raises:
        ConfigError: For an unknown key or a value that cannot be used.

    Examples:
        >>> complete_env({"name": "mine", "robot_base": "point"})["randomize_layout"]
        True
    """
    family = FAMILIES.get(node.get("_target_"))
    return dict(node) if family is None else family.complete(node)


def stored_node(name: str) -> dict[str, Any] | None:
    """Return the node that was stored by a name, see `safe_rl.envs.store_config`; None without.

    Examples:
        >>> from safe_rl.envs import store_config
        >>> store_config("MyPoint", {"robot_base": "point", "hazards_num": 3})
        >>> stored_node("MyPoint")["hazards_num"]
        3
    """
    held = _stored().get(f"{name}.yaml")
    if held is None:
        return None
    node = OmegaConf.to_container(OmegaConf.create(held.node), resolve=False)
    return {str(key): value for key, value in node.items()} if isinstance(node, dict) else None


def known_names() -> list[str]:
    """Names that `make_env` takes: those of every family, and what has been stored."""
    return [*env_names(), *(key.removesuffix(".yaml") for key in _stored())]


def _stored() -> Mapping[str, Any]:
    """What Hydra holds in its group of environments, by file name."""
    group = ConfigStore.instance().repo.get(GROUP, {})
    return {key: held for key, held in group.items() if key.endswith(".yaml")}
