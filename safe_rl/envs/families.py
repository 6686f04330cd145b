"""The table of families: names of environments, nodes of the configuration, and their defaults.

The key `_target_` of a node names its family: a function or class that is called with a mapping of
the node's other keys, and `num_envs=`, `device=`, `seed=` and `num_threads=`. A node without it
belongs to Safety Gym. Modules that build environments are not imported here, for a quick start.

A configuration may come from an unknown source. So an `id` is refused if it makes a library import
a module, or names a class that is not listed here. The user permits such a module by `import=`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import import_module
from typing import Any

import gymnasium
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from safe_rl.envs.costs import parse_ranges
from safe_rl.envs.errors import ConfigError, on_cpu_only
from safe_rl.envs.safety_gym.suite import EXTRAS, SUITE, resolve
from safe_rl.envs.velocity.velocity_config import VELOCITY_SUITE, resolve_velocity
from safe_rl.naming import did_you_mean
from safe_rl.ranges import Count, Text, values_of

# These classes use another package by default; MuJoCo's own library is installed.
_MUJOCO = {"backend": "mujoco", "parallel": False}
TORCHRL_CLASSES: dict[str, Mapping[str, Any]] = {
    "PendulumEnv": {},
    "FinancialRegimeEnv": {},
    **dict.fromkeys(("AntEnv", "HopperEnv", "HumanoidEnv", "Walker2dEnv"), _MUJOCO),
}
"""Classes of `torchrl.envs` that need no `import=`, and their default arguments."""


@dataclass(frozen=True, kw_only=True)
class ForeignFamily:
    """The environments of one library.

    Attributes:
        target: `_target_` of its nodes.
        title: Name of one of its environments in messages.
        keys: Key -> its default, and an annotation of its allowed values. `id` and `name`, which
            all families have, are not listed.
        check: Checks the whole node before an environment is made.
        describe: "module:function" that returns the cost keys and the length of episodes of a node.
            If one of them is None, it makes an environment to find out.
    """

    target: str
    title: str
    keys: Mapping[str, tuple[Any, Any]]
    check: Callable[[Mapping[str, Any]], None]
    describe: str


def complete_foreign(family: ForeignFamily, node: Mapping[str, Any]) -> dict[str, Any]:
    """Return a node with all keys.

    If its cost keys or the length of its episodes are None, they are read from an environment.

    Raises:
        ConfigError: For an unknown key or id, or an environment that the algorithms cannot use.
    """
    for key in node:
        if key not in (*family.keys, "id", "name", "_target_"):
            meant = did_you_mean(str(key), [*family.keys, "id"])
            others = " The environment's own arguments belong in 'kwargs': env.kwargs='{…}'."
            raise ConfigError(
                f"{family.title} has no key '{key}'.{on_cpu_only(key) or meant + others}"
            )
    if not isinstance(node.get("id"), str):
        raise ConfigError("Which environment? Name it: env.id=…")
    full = {"name": node["id"], **{key: row[0] for key, row in family.keys.items()}, **node}
    for key, (_, annotation) in family.keys.items():
        values = values_of(annotation)
        if not values.hold(full[key]):
            raise ConfigError(f"'{key}' must be {values.words}, got {full[key]!r}.")
    family.check(full)
    parse_ranges(full.get("outside"))
    if None in (full["cost_keys"], full["num_steps"]):
        # Imported here, because environments need torch and their names do not.
        module, _, function = family.describe.partition(":")
        full["cost_keys"], full["num_steps"] = getattr(import_module(module), function)(full)
    return full


def hint_of_gymnasium(name: str) -> str:
    """Return a hint how to choose an environment by its Gymnasium id; empty for other names."""
    spec = gymnasium.registry.get(name)
    if spec is None or str(spec.entry_point).startswith("safe_rl."):
        return ""
    return f" It is one of Gymnasium's: env=gymnasium env.id={name}."


def _check_gymnasium(node: Mapping[str, Any]) -> None:
    module, _, plain = node["id"].rpartition(":")
    if module:  # Gymnasium would import it
        raise ConfigError(
            f"env.id={node['id']}: a configuration cannot import a module. If you trust "
            f"'{module}', use import={module} env.id={plain}"
        )


def _check_torchrl(node: Mapping[str, Any]) -> None:
    name = node["id"]
    if "." not in name and name not in TORCHRL_CLASSES:
        raise ConfigError(
            f"env.id={name} is not among {', '.join(TORCHRL_CLASSES)}."
            f"{did_you_mean(name, TORCHRL_CLASSES)} For another class of TorchRL use "
            "import=torchrl.envs env.id=torchrl.envs.NAME, for a class of yours import=my_module "
            "env.id=my_module.NAME, and for a Gymnasium environment env=gymnasium and its id."
        )


_Names, _Arguments = list[Text] | None, Mapping[str, Any] | None
_COMMON: dict[str, tuple[Any, Any]] = {
    "cost_keys": (None, _Names),
    "num_steps": (None, Count | None),
    "kwargs": (None, _Arguments),
}
_GYMNASIUM_KEYS = {**_COMMON, "render_mode": (None, Text | None)}

GYMNASIUM = ForeignFamily(
    target="safe_rl.envs.gymnasium.make_gymnasium",
    title="A Gymnasium environment",
    keys={**_GYMNASIUM_KEYS, "outside": (None, Any), "flatten": (False, bool)},
    check=_check_gymnasium,
    describe="safe_rl.envs.gymnasium.conversion:describe_gymnasium",
)
SAFETY_GYMNASIUM = ForeignFamily(
    target="safe_rl.envs.gymnasium.make_safety_gymnasium",
    title="An environment of Safety-Gymnasium",
    keys=_GYMNASIUM_KEYS,
    check=_check_gymnasium,
    describe="safe_rl.envs.gymnasium.conversion:describe_safety_gymnasium",
)
TORCHRL = ForeignFamily(
    target="safe_rl.envs.torchrl.make_torchrl",
    title="An environment of TorchRL",
    keys={**_COMMON, "observe": (None, _Names), "flatten": (True, bool)}
    | dict.fromkeys(("outside", "cost"), (None, Any)),
    check=_check_torchrl,
    describe="safe_rl.envs.torchrl.torchrl_env:describe_node",
)

FOREIGN = {
    "gymnasium": GYMNASIUM, "torchrl": TORCHRL, "safety_gymnasium": SAFETY_GYMNASIUM
}  # fmt: skip
"""Name in the group `env` -> family of another library; its environment is named by `id`."""
GROUP = "env"
"""The group of environments in Hydra."""
VELOCITY_TARGET = "safe_rl.envs.velocity.VelocityEnv"


def config_node(name: str, config: Any, target: str | None = None) -> dict[str, Any]:
    """Return a configuration as a node of the group `env`: `name`, family, and every key.

    Args:
        name: Name of the environment.
        config: A `SafetyGymConfig` or a `VelocityConfig`.
        target: `_target_` of the family; None is Safety Gym's.
    """
    family = {} if target is None else {"_target_": target}
    return {"name": name, **family, **{k: _plain(v) for k, v in config.to_dict().items()}}


def _plain(value: Any) -> Any:
    """Turn tuples into lists, because Hydra has no tuples."""
    return [_plain(item) for item in value] if isinstance(value, tuple) else value


def _complete(
    resolve: Callable[[Mapping[str, Any]], Any], target: str | None, node: Mapping[str, Any]
) -> dict[str, Any]:
    """Add the defaults of missing keys to a node; its own keys keep their values."""
    config = resolve({key: value for key, value in node.items() if key not in ("name", "_target_")})
    return {**config_node(node.get("name", "custom"), config, target), **node}


_SUITES: dict[str | None, Mapping[str, Any]] = {
    None: SUITE | EXTRAS,
    VELOCITY_TARGET: VELOCITY_SUITE,
}
FAMILIES: dict[str | None, Callable[[Mapping[str, Any]], dict[str, Any]]] = {
    None: partial(_complete, resolve, None),
    VELOCITY_TARGET: partial(_complete, resolve_velocity, VELOCITY_TARGET),
    **{family.target: partial(complete_foreign, family) for family in FOREIGN.values()},
}
"""`_target_` -> function that completes a node. A node with another target is used as it is."""

_TARGETS = {name: target for target, suite in _SUITES.items() for name in suite}


def env_names() -> list[str]:
    """Return the names of the environments of all families, without stored ones."""
    return list(_TARGETS)


def env_node(name: str) -> dict[str, Any]:
    """Return the node of the group `env` for a name; KeyError if there is none."""
    target = _TARGETS[name]
    return config_node(name, _SUITES[target][name], target)


def complete_env(node: Mapping[str, Any]) -> dict[str, Any]:
    """Complete a node that has only the keys that differ from the defaults of its family.

    Raises:
        ConfigError: For an unknown key or a value that cannot be used.
    """
    complete = FAMILIES.get(node.get("_target_"))
    return dict(node) if complete is None else complete(node)


def stored_node(name: str) -> dict[str, Any] | None:
    """Return the node that `safe_rl.envs.store_config` stored by a name, or None."""
    held = _stored().get(f"{name}.yaml")
    if held is None:
        return None
    node = OmegaConf.to_container(OmegaConf.create(held.node), resolve=False)
    return {str(key): value for key, value in node.items()} if isinstance(node, dict) else None


def known_names() -> list[str]:
    """Return the names that `make_env` takes: those of all families, and the stored ones."""
    return [*env_names(), *FOREIGN, *(key.removesuffix(".yaml") for key in _stored())]


def _stored() -> Mapping[str, Any]:
    """Return the nodes in Hydra's group of environments, by file name."""
    group = ConfigStore.instance().repo.get(GROUP, {})
    return {key: held for key, held in group.items() if key.endswith(".yaml")}
