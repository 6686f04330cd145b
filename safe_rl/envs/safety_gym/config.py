"""One environment is one flat, frozen `SafetyGymConfig`; see `config_keys` for its keys.

Lengths are in metres, angles in radians, and times in environment steps unless stated otherwise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import FrozenInstanceError, fields
from pathlib import Path
from typing import Any, get_type_hints

from safe_rl.envs.keys import ConfigError, Key, check_key
from safe_rl.envs.safety_gym.config_keys import Keys
from safe_rl.naming import did_you_mean

BUNDLED = Path(__file__).parent / "robots"
ROBOTS: dict[str, Path] = {path.stem: path for path in sorted(BUNDLED.glob("*.xml"))}
"""Name of a robot -> its file."""
# Paths in the dictionaries of 2019, relative to the folder of that package -> name.
PATHS_OF_2019 = {f"xmls/{name}.xml": name for name in ROBOTS}

_ANNOTATIONS = get_type_hints(Keys, include_extras=True)
_BUILT_IN: dict[str, Key] = {
    row.name: Key(row.default, annotation, annotation.__metadata__[-1])
    for row in fields(Keys)
    for annotation in [_ANNOTATIONS[row.name]]
}
KEYS = dict(_BUILT_IN)
"""The built-in keys and the registered ones."""


class SafetyGymConfig(Keys):
    """Everything that defines one environment.

    Keys that `safe_rl.envs.extending` registers are fields like the others. Types and ranges
    are checked here. Whether a task or robot exists, and whether keys fit together, is checked when
    an environment is made or stored, see `suite.resolve`.

    Raises:
        ConfigError: For an unknown key (the message suggests a known one), a wrong type or a value
            out of range.

    Examples:
        >>> config = SafetyGymConfig(task="goal", hazards_num=3)
        >>> config.replace(hazards_num=5).hazards_num
        5
    """

    def __init__(self, **values: Any) -> None:
        for name in values.keys() - KEYS.keys():
            raise ConfigError(
                f"Unknown configuration key '{name}'."
                f"{did_you_mean(name, [*KEYS, 'num_envs', 'num_threads'])} "
                "SafetyGymConfig lists every key with its default."
            )
        for name, row in KEYS.items():
            vars(self)[name] = check_key(name, row.annotation, values.get(name, row.default))

    def __setattr__(self, name: str, value: Any) -> None:
        raise FrozenInstanceError(f"A configuration cannot change: use replace({name}=…).")

    def __getattr__(self, name: str) -> Any:
        """Return the default of a key that was registered after this configuration was made."""
        if name in KEYS:
            return KEYS[name].default
        raise AttributeError(f"There is no configuration key '{name}'.{did_you_mean(name, KEYS)}")

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SafetyGymConfig) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash(tuple(getattr(self, key) for key in _BUILT_IN))

    def __repr__(self) -> str:
        values = (f"{k}={v!r}" for k, v in self.to_dict().items() if v != KEYS[k].default)
        return f"SafetyGymConfig({', '.join(values)})"

    def replace(self, **changes: Any) -> SafetyGymConfig:
        """Return a copy with some keys changed, checked like a new one."""
        return SafetyGymConfig(**{**self.to_dict(), **changes})

    def to_dict(self) -> dict[str, Any]:
        """Return a flat mapping of all keys, which the constructor accepts."""
        return {name: getattr(self, name) for name in KEYS}


def infer_key(name: str, default: Any) -> Key:
    """Return a key with the type of its default; ConfigError if the type is not clear."""
    kind = type(default[0] if isinstance(default, tuple) and default else default)
    if kind not in (bool, int, float, str):
        raise ConfigError(
            f"The type of key '{name}' does not follow from its default {default!r}: give "
            "Key(default, annotation), such as Key(None, float | None)."
        )
    if isinstance(default, tuple):
        return Key(default, tuple[float if kind is int else kind, ...])  # type: ignore[misc]
    return Key(default, kind)


def register_keys(keys: Mapping[str, Key]) -> None:
    """Add keys to the built-in ones.

    Raises:
        ConfigError: If a key is built in, or a default does not have the type of its key.
    """
    for name, row in keys.items():
        if name in _BUILT_IN:
            raise ConfigError(f"The configuration key '{name}' is taken: choose another name.")
        check_key(name, row.annotation, row.default)
    KEYS.update(keys)
