"""Names and keys of all environments, for Hydra and Gymnasium, and `make_env`.

The key `_target_` of a node names its family: a function or class that is called with a mapping of
the node's other keys, and `num_envs=`, `device=`, `seed=` and `num_threads=`. A node without it
belongs to Safety Gym. Modules that build environments are not imported here, for a quick start.
"""

from __future__ import annotations

import json
from collections.abc import Container, Mapping
from textwrap import fill
from typing import TYPE_CHECKING, Any

import gymnasium
from hydra.core.config_store import ConfigStore
from omegaconf import OmegaConf

from safe_rl.checks import Text
from safe_rl.envs.foreign import FOREIGN, complete_foreign
from safe_rl.envs.keys import ConfigError, Count, Key, check_key, structured
from safe_rl.envs.safety_gym.config import KEYS, SafetyGymConfig
from safe_rl.envs.safety_gym.suite import EXTRAS, SUITE, resolve
from safe_rl.envs.velocity.velocity_config import (
    ANNOTATIONS,
    VELOCITY_SUITE,
    VelocityConfig,
    resolve_velocity,
    velocity_name,
)
from safe_rl.naming import did_you_mean
from safe_rl.trust import allow, locate

if TYPE_CHECKING:
    import torch

    from safe_rl.envs.contract import ConstrainedEnv

GROUP = "env"  # the group of environments in Hydra
VELOCITY_TARGET = "safe_rl.envs.velocity.VelocityEnv"
SAFETY_GYM = "safety_gym"  # the default of every key of Safety Gym, from which others inherit


def hint_of_gymnasium(name: str) -> str:
    """Return a hint how to choose an environment by its Gymnasium id; empty for other names."""
    spec = gymnasium.registry.get(name)
    if spec is None or str(spec.entry_point).startswith("safe_rl."):
        return ""
    return f" It is one of Gymnasium's: env=gymnasium env.id={name}."


_STORED: dict[str, dict[str, Any]] = {}  # the nodes of `store_config` by name
_IN_STORE: dict[str, dict[str, Any]] = {}  # what Hydra's ConfigStore has, by name
# an id may have a namespace, such as ALE/Pong-v5; its name is that of a folder
OmegaConf.register_new_resolver(
    "safe_rl.folder_name", lambda name: name.replace("/", "-"), replace=True
)
OmegaConf.register_new_resolver(
    "safe_rl.environments",
    lambda: fill(", ".join([*env_names(), *FOREIGN, *_STORED]), 100, break_on_hyphens=False),
    replace=True,
)


def env_names() -> list[str]:
    """Return the names of the environments of the package."""
    return [*SUITE, *EXTRAS, *VELOCITY_SUITE]


def env_node(env: str | SafetyGymConfig | VelocityConfig, name: str = "") -> dict[str, Any]:
    """Return the node of the group `env` for a name or a configuration, with every key.

    Raises:
        ConfigError: For an unknown name.
    """
    if isinstance(env, str):
        if env in _STORED:
            return dict(_STORED[env])
        if env in FOREIGN:
            return {"_target_": FOREIGN[env].target}
        if velocity_name(env) in VELOCITY_SUITE:
            return env_node(resolve_velocity(env), env)
        if env.removeprefix("Safexp-").removesuffix("-v0") not in SUITE | EXTRAS:
            hint = did_you_mean(env, [*env_names(), *FOREIGN, *_STORED])
            raise ConfigError(
                f"Unknown environment '{env}'.{hint} If a module of yours stores it by that name "
                "(store_config), import the module first."
            )
        return env_node(resolve(env), env)
    config = env if isinstance(env, VelocityConfig) else resolve(env)
    target = {"_target_": VELOCITY_TARGET} if isinstance(env, VelocityConfig) else {}
    # lists instead of tuples, which Hydra does not have
    return {"name": name or "custom", **target, **json.loads(json.dumps(config.to_dict()))}


def complete_env(node: Mapping[str, Any]) -> dict[str, Any]:
    """Check a node, and add the keys that it does not have.

    Raises:
        ConfigError: For an unknown key or a value that cannot be used.
    """
    target = node.get("_target_")
    for family in FOREIGN.values():
        if target == family.target:
            return complete_foreign(family, node)
    keys = {key: value for key, value in node.items() if key not in ("name", "_target_")}
    if target == VELOCITY_TARGET:
        return {**env_node(resolve_velocity(keys)), **node}
    if target is not None:
        return dict(node)
    config, is_complete = resolve(keys), KEYS.keys() <= node.keys()
    return dict(node) if is_complete else {**env_node(config), **node}


def store_config(name: str, config: Mapping[str, Any] | SafetyGymConfig | VelocityConfig) -> None:
    """Give a configuration a name, with which `env=<name>` and `make_env(name)` find it.

    Args:
        name: Name of the environment.
        config: A configuration (a mapping of Safety Gym's keys may have only those that differ from
            the defaults), or a node with the `_target_` of another family. The module of that
            target may then be imported, as with `import=`.

    Raises:
        ConfigError: For the name of a built-in environment, an unknown key, or a value that cannot
            be used.

    Examples:
        >>> from safe_rl.envs import make_env
        >>> store_config("CrowdedPoint", {"robot_base": "point", "hazards_num": 9})
        >>> make_env("CrowdedPoint").config.hazards_num
        9
    """
    if name in (*env_names(), *FOREIGN, SAFETY_GYM):
        raise ConfigError(f"'{name}' is a built-in environment: choose another name.")
    if isinstance(config, Mapping) and config.get("_target_") is not None:
        _STORED[name] = {"name": name, **config}
        module = str(config["_target_"]).rpartition(".")[0]
        if module.partition(".")[0] not in ("safe_rl", "torch"):
            allow(module)
    else:
        _STORED[name] = env_node(resolve(config) if isinstance(config, Mapping) else config, name)
    store_configs()


def store_configs(names: Container[str] | None = None) -> None:
    """Put environments into Hydra's ConfigStore, as in `env=PointGoal1 env.hazards_num=3`.

    Args:
        names: Names of the environments; None: all. To print its help, Hydra copies its store once
            per configuration group.
    """
    rows: dict[str, dict[str, Any]] = {}
    for name, keys in (SUITE | EXTRAS | _STORED).items():
        base = {} if "_target_" in keys else {"defaults": [SAFETY_GYM, "_self_"]}
        rows[name] = {**base, "name": name, **keys}
    for name, row in VELOCITY_SUITE.items():
        values = {"_target_": VELOCITY_TARGET, "name": name, **row}
        rows[name] = {key: Key(value, ANNOTATIONS.get(key, str)) for key, value in values.items()}
    for name, family in FOREIGN.items():
        head = {"_target_": family.target, "name": "${safe_rl.folder_name:${.id}}", "id": "???"}
        rows[name] = {**{key: Key(value, str) for key, value in head.items()}, **family.keys}
    if names is not None:
        rows = {name: row for name, row in rows.items() if name in names}
    rows[SAFETY_GYM] = {"name": Key(SAFETY_GYM, Text), **KEYS}
    for name, row in rows.items():
        if row != _IN_STORE.get(name):  # nodes of all would take a third of a second
            is_typed = any(isinstance(value, Key) for value in row.values())
            ConfigStore.instance().store(name, structured(name, row) if is_typed else row, GROUP)
            _IN_STORE[name] = row


def make_env(
    env: str | Mapping[str, Any] | SafetyGymConfig | VelocityConfig,
    *,
    num_envs: int = 1,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    num_threads: int = 0,
    transforms: Mapping[str, Any] | None = None,
    evaluating: bool = False,
    **keys: Any,
) -> ConstrainedEnv:
    """Make a batch of environments of any family.

    Args:
        env: A name, also one from `store_config`; a configuration of Safety Gym or of the velocity
            family; or a node of the group `env`: `name`, `_target_` and the family's keys.
        num_envs: Number of environments, N.
        device: Device of the TensorDicts.
        seed: Determines every random draw; None takes a seed from torch's generator.
        num_threads: Largest number of threads that step them; 0 for one per core.
        transforms: Name -> transform, or its node, as `transform_env` takes them.
        evaluating: Whether policies are evaluated; transforms that only help learning are then off.
        keys: Keys of the environment to change, such as ``hazards_num=12``.

    Raises:
        ConfigError: For an unknown name or key, or a value that cannot be used.
        TargetError: For a family whose target a configuration may not name.
        ContractError: If an environment of the user's family does not fulfil the contract.

    Examples:
        >>> make_env("PointGoal1", num_envs=2, hazards_num=12).config.hazards_num
        12
        >>> make_env({"name": "mine", "robot_base": "point"}, num_envs=2).batch_size
        torch.Size([2])
    """
    from safe_rl.envs.contract import ContractError, check_constrained_env
    from safe_rl.envs.safety_gym.env import SafetyGymEnv
    from safe_rl.envs.transforms import transform_env

    count = check_key("num_envs", Count, num_envs)
    given = {"num_envs": count, "device": device, "seed": seed, "num_threads": num_threads}
    node = dict(env if isinstance(env, Mapping) else env_node(env))
    node |= keys
    target = node.pop("_target_", None)
    node.pop("name", None)
    build: Any = SafetyGymEnv if target is None else locate(target, key="env._target_")
    batch = build(node, **given)
    if transforms:
        batch = transform_env(batch, transforms, evaluating=evaluating, seed=seed)
    if target is not None or transforms:
        check_constrained_env(batch)
    if list(batch.batch_size) != [num_envs]:
        raise ContractError(f"{target} made {batch.batch_size[0]} environments, not {num_envs=}.")
    return batch


# `Safexp-{name}-v0`, and `Safexp-Custom-v0` with the default of every key. They take a `config`
# with keys to change. Ids of the velocity family are `SafeHopperVelocity-v0` and so on.
_IDS = {f"Safexp-{name}-v0": name for name in (*SUITE, *EXTRAS)} | {"Safexp-Custom-v0": None}
for _id, _name in (_IDS | {f"{name}-v0": name for name in VELOCITY_SUITE}).items():
    if _id not in gymnasium.registry:
        gymnasium.register(
            _id,
            entry_point="safe_rl.envs.gymnasium.gymnasium_interfaces:WorldEnv",
            vector_entry_point="safe_rl.envs.gymnasium.gymnasium_interfaces:WorldVectorEnv",
            kwargs={"name": _name},
        )
