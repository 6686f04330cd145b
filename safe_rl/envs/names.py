"""Names of environments of every family, and the nodes of the configuration they stand for.

Nothing here builds an environment, so that names and keys are known without importing what does.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from safe_rl.envs.gymnasium.nodes import GYMNASIUM_TARGET, complete_gymnasium
from safe_rl.envs.safety_gym.suite import EXTRAS, SUITE, complete_safety_gym, safety_gym_node
from safe_rl.envs.safety_gymnasium.nodes import SAFETY_GYMNASIUM_TARGET, complete_safety_gymnasium
from safe_rl.envs.torchrl.nodes import TORCHRL_TARGET, complete_torchrl
from safe_rl.envs.velocity.nodes import VELOCITY_TARGET, complete_velocity, velocity_node
from safe_rl.envs.velocity.suite import VELOCITY_SUITE

GROUP = "env"
"""Of configurations, in Hydra."""


# What makes the node of a name.
_NODES: dict[str, Callable[[str], dict[str, Any]]] = {
    **dict.fromkeys([*SUITE, *EXTRAS], safety_gym_node),
    **dict.fromkeys(VELOCITY_SUITE, velocity_node),
}

# What fills a family's nodes up; others are taken as they are.
_COMPLETE: dict[str | None, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    None: complete_safety_gym,
    VELOCITY_TARGET: complete_velocity,
    GYMNASIUM_TARGET: complete_gymnasium,
    TORCHRL_TARGET: complete_torchrl,
    SAFETY_GYMNASIUM_TARGET: complete_safety_gymnasium,
}


def env_names() -> list[str]:
    """Names that stand for an environment of any family."""
    return list(_NODES)


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
    return {key: held for key, held in group.items() if hasattr(held, "node")}


def env_node(name: str) -> dict[str, Any]:
    """Return the node of the group `env` that a name stands for, with every key.

    Raises:
        KeyError: if there is no such name.

    Examples:
        >>> env_node("CarPush2")["pillars_num"]
        4
    """
    return _NODES[name](name)


def complete_env(node: Mapping[str, Any]) -> dict[str, Any]:
    """Fill up a node that holds only what differs from its family's defaults.

    Args:
        node: as `make_env` takes it; what it holds stays as it is.

    Raises:
        ConfigError: for an unknown key or a value that cannot be used.

    Examples:
        >>> complete_env({"name": "mine", "robot_base": "point"})["randomize_layout"]
        True
    """
    complete = _COMPLETE.get(node.get("_target_"))
    return dict(node) if complete is None else complete(node)
