"""Names of environments in Hydra and in Gymnasium."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.object_type import ObjectType
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.plugins.search_path_plugin import SearchPathPlugin
from omegaconf import OmegaConf

from safe_rl.envs.errors import ConfigError
from safe_rl.envs.families import GROUP, VELOCITY_TARGET, config_node, env_names, env_node
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.suite import EXTRAS, SUITE, resolve
from safe_rl.envs.velocity.velocity_config import VELOCITY_SUITE, VelocityConfig
from safe_rl.trust import allow

SCHEME = "safe-rl-environments"


class EnvironmentsSource(ConfigSource):
    """Source in which Hydra finds the group `env`; a node is made when it is loaded.

    Hydra's own store would hold every node, and Hydra copies the store about a hundred times.
    """

    @staticmethod
    def scheme() -> str:
        """Return the scheme of the source's address in Hydra's search path."""
        return SCHEME

    def available(self) -> bool:
        """Return whether the source is available: always."""
        return True

    def load_config(self, config_path: str) -> ConfigResult:
        """Return the node of `env/<name>`, for which Hydra has called `is_config`."""
        name = config_path.removesuffix(".yaml").removeprefix(f"{GROUP}/")
        return ConfigResult(
            provider=self.provider,
            path=self.full_path(),
            config=OmegaConf.create(env_node(name)),
            header={"package": None},
        )

    def is_group(self, config_path: str) -> bool:
        """Return whether a path is that of the group `env`, or of its parent."""
        return config_path.strip("/") in ("", GROUP)

    def is_config(self, config_path: str) -> bool:
        """Return whether a path is that of an environment in the group."""
        group, _, name = config_path.removesuffix(".yaml").rpartition("/")
        return group == GROUP and name in env_names()

    def list(self, config_path: str, results_filter: ObjectType | None) -> list[str]:
        """Return the names of environments for the group, and the group for its parent."""
        here = config_path.strip("/")
        found = {"": (ObjectType.GROUP, [GROUP]), GROUP: (ObjectType.CONFIG, sorted(env_names()))}
        kind, names = found.get(here, (None, []))
        return names if results_filter in (None, kind) else []


class EnvironmentsSearchPath(SearchPathPlugin):
    """Appends the source to the search path; folders of --config-dir come after it."""

    def manipulate_search_path(self, search_path: ConfigSearchPath) -> None:
        """Append the source."""
        search_path.append(provider="safe_rl", path=f"{SCHEME}://")


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
    if name in env_names():
        raise ConfigError(f"'{name}' is a built-in environment: choose another name.")
    if isinstance(config, Mapping) and config.get("_target_") is not None:
        node = {"name": name, **config}
        module = str(config["_target_"]).rpartition(".")[0]
        if module.partition(".")[0] not in ("safe_rl", "torch"):
            allow(module)
    elif isinstance(config, VelocityConfig):
        node = config_node(name, config, VELOCITY_TARGET)
    else:
        node = config_node(name, resolve(config))
    ConfigStore.instance().store(group=GROUP, name=name, node=node)


def store_configs() -> None:
    """Let Hydra find all names in its group `env`, as in `env=PointGoal1 env.hazards_num=3`."""
    for plugin in (EnvironmentsSource, EnvironmentsSearchPath):
        Plugins.instance().register(plugin)


def register_gymnasium() -> None:
    """Register `Safexp-{name}-v0` in Gymnasium for every name, and `Safexp-Custom-v0`.

    The custom environment has the default of every key. All of them take a `config` with keys to
    change. Ids of the velocity family are `SafeHopperVelocity-v0` and so on.
    """
    ids = {f"Safexp-{name}-v0": name for name in (*SUITE, *EXTRAS)} | {"Safexp-Custom-v0": None}
    ids |= {f"{name}-v0": name for name in VELOCITY_SUITE}
    for env_id, name in ids.items():
        if env_id not in gymnasium.registry:
            gymnasium.register(
                env_id,
                entry_point="safe_rl.envs.gymnasium.gymnasium_interfaces:WorldEnv",
                vector_entry_point="safe_rl.envs.gymnasium.gymnasium_interfaces:WorldVectorEnv",
                kwargs={"name": name},
            )
