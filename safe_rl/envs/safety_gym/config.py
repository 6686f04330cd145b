"""One environment is one flat, frozen `SafetyGymConfig`; see `config_keys` for its keys.

Lengths are in metres, angles in radians, and times in environment steps unless stated otherwise.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any, NamedTuple, get_type_hints

from safe_rl.envs.errors import ConfigError
from safe_rl.envs.safety_gym.config_keys import RETIRED, Key, Vocabulary
from safe_rl.naming import did_you_mean
from safe_rl.ranges import values_of

_BUILT_IN: dict[str, Key] = {
    name: vars(Vocabulary)[name]._replace(annotation=annotation)
    for name, annotation in get_type_hints(Vocabulary, include_extras=True).items()
}
_keys = dict(_BUILT_IN)  # built-in keys and registered ones


class SafetyGymConfig(Vocabulary):
    """Everything that defines one environment.

    Keys that `safe_rl.envs.extending` registers are attributes like the others. Types and ranges
    are checked here. Whether a task or robot exists, and whether keys fit together, is checked when
    an environment is made or stored, see `suite.resolve`.

    Args:
        values: Values of the keys that differ from their defaults.

    Raises:
        ConfigError: For an unknown key (the message suggests a known one), a wrong type or a value
            out of range.

    Examples:
        >>> config = SafetyGymConfig(task="goal", hazards_num=3)
        >>> config.replace(hazards_num=5).hazards_num
        5
    """

    def __init__(self, **values: Any) -> None:
        for name, (harmless, instead) in RETIRED.items():
            value = values.pop(name, harmless)
            if _plain(value) is not harmless:
                raise ConfigError(
                    f"Configuration key '{name}' does not exist any more: {instead}. Got {value!r}."
                )
        for name in values:
            if name not in _keys:
                raise ConfigError(
                    f"Unknown configuration key '{name}'.{did_you_mean(name, _keys)} "
                    "SafetyGymConfig lists every key with its default."
                )
        for name, key in _keys.items():
            vars(self)[name] = coerce(name, key, values.get(name, key.default))

    def __getattr__(self, name: str) -> Any:
        """Return the default of a key that was registered after this configuration was made."""
        if name in _keys:
            return _keys[name].default
        raise AttributeError(f"There is no configuration key '{name}'.{did_you_mean(name, _keys)}")

    def __setattr__(self, name: str, value: Any) -> None:
        raise AttributeError(f"A configuration cannot be changed: use replace({name}=…).")

    def __reduce__(self) -> tuple[Any, ...]:
        return SafetyGymConfig.from_dict, (self.to_dict(),)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, SafetyGymConfig) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        return hash(tuple(getattr(self, key) for key in _BUILT_IN))

    def __repr__(self) -> str:
        values = (f"{k}={v!r}" for k, v in self.to_dict().items() if v != _keys[k].default)
        return f"SafetyGymConfig({', '.join(values)})"

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> SafetyGymConfig:
        """Build a configuration from a flat mapping."""
        return cls(**{str(key): value for key, value in values.items()})

    def replace(self, **changes: Any) -> SafetyGymConfig:
        """Return a copy with some keys changed, checked like a new one."""
        return self.from_dict({**self.to_dict(), **changes})

    def to_dict(self) -> dict[str, Any]:
        """Return a flat mapping of all keys, which `from_dict` accepts."""
        return {name: getattr(self, name) for name in _keys}


allowed = cache(values_of)
"""Returns the allowed values of keys with an annotation."""


def coerce(name: str, key: Key, value: Any) -> Any:
    """Return a value as the type of its key; ConfigError if the type or range is wrong."""
    values, plain = allowed(key.annotation), _plain(value)
    if not values.hold(plain):
        raise ConfigError(f"Configuration key '{name}' must be {values.words}, got {value!r}.")
    return _cast(plain, int if values.whole else float)


def _plain(value: Any) -> Any:
    """Return numbers of NumPy and torch as Python's, and their arrays, lists, … as tuples."""
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, str | Mapping) or not isinstance(value, Iterable):
        return value
    return tuple(map(_plain, value))


def _cast(value: Any, kind: type) -> Any:
    """Convert all numbers in a value to one type."""
    if isinstance(value, tuple):
        return tuple(_cast(item, kind) for item in value)
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return kind(value) if is_number else value


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


class KeyRow(NamedTuple):
    """A row of the table of keys: name, allowed values in words, meaning and default."""

    name: str
    values: str
    meaning: str
    default: Any


def key_table() -> list[KeyRow]:
    """Return a row for every key, registered ones included.

    Examples:
        >>> {row.name: row for row in key_table()}["hazards_num"][1:]
        ('a whole number from 0 to 1,000', 'number of objects', 0)
    """
    return [
        KeyRow(name, allowed(key.annotation).words, key.meaning, key.default)
        for name, key in _keys.items()
    ]


def registered_keys() -> dict[str, Key]:
    """Return the keys that are not built in."""
    return {name: key for name, key in _keys.items() if name not in _BUILT_IN}


def set_registered_keys(keys: Mapping[str, Key]) -> None:
    """Set the keys that exist in addition to the built-in ones.

    Raises:
        ConfigError: If a key is built in, or a default does not have the type of its key.
    """
    for name, key in keys.items():
        if name in _BUILT_IN:
            raise ConfigError(f"The configuration key '{name}' is taken: choose another name.")
        coerce(name, key, key.default)
    _keys.clear()
    _keys.update({**_BUILT_IN, **keys})
