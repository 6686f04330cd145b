"""One environment is one flat, frozen `SafetyGymConfig`; see `config_keys` for its keys.

Lengths are metres, angles radians, times environment steps unless said otherwise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from safe_rl.envs.errors import ConfigError, nearest
from safe_rl.envs.safety_gym.config_keys import RETIRED, Vocabulary
from safe_rl.envs.safety_gym.config_values import Range, check_retired, coerce, infer_range
from safe_rl.envs.safety_gym.config_values import key as declare


@dataclass(frozen=True, kw_only=True, eq=False)
class SafetyGymConfig(Vocabulary):
    """Everything that defines one environment.

    Keys that `safe_rl.envs.extending` registered are fields like the others. A record knows types
    and ranges; whether there is such a task or robot, and what keys need of one another, is checked
    where an environment is made or stored, see `suite.resolve`.

    Raises:
        ConfigError: if a value has the wrong type or is out of range.

    Examples:
        >>> config = SafetyGymConfig.from_dict({"task": "goal", "hazards_num": 3})
        >>> config.replace(hazards_num=5).hazards_num
        5
    """

    def __new__(cls, **values: Any) -> SafetyGymConfig:
        """Make an object of the present vocabulary, registered keys included."""
        return object.__new__(_vocabulary)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as values: the class with registered keys has no name to be found by."""
        return SafetyGymConfig.from_dict, (self.to_dict(),)

    def __eq__(self, other: object) -> bool:
        """Compare values: an object made before a key was registered has its default."""
        return isinstance(other, SafetyGymConfig) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        """Hash what never changes, the built-in keys."""
        return hash(tuple(getattr(self, key) for key in _BUILT_IN))

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            given, range = getattr(self, field.name), field.metadata["range"]
            value = coerce(field.name, str(field.type), given, range)
            object.__setattr__(self, field.name, value)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> SafetyGymConfig:
        """Build a configuration from a flat mapping.

        Raises:
            ConfigError: for a key that is not in the vocabulary (the nearest one is named), a
                wrong type or a value out of range.
        """
        known, given = known_keys(), {}
        for key, value in values.items():
            if key in RETIRED:
                check_retired(key, value, *RETIRED[key])
                continue
            if key not in known:
                raise ConfigError(
                    f"Unknown configuration key '{key}'.{nearest(str(key), known)} "
                    "SafetyGymConfig lists every key with its default."
                )
            given[key] = value
        return SafetyGymConfig(**given)

    def replace(self, **changes: Any) -> SafetyGymConfig:
        """Return a copy with some keys changed, checked like a new one."""
        return self.from_dict({**self.to_dict(), **changes})

    def to_dict(self) -> dict[str, Any]:
        """Return the flat mapping of every key, as `from_dict` takes it."""
        return {key: getattr(self, key) for key in known_keys()}


class Key(NamedTuple):
    """A key to register.

    Attributes:
        default: its value where none is given.
        annotation: its type, as `Vocabulary` writes it.
        meaning: what it is, for the table of keys.
        range: which values it may have; None takes that of built-in keys which end alike.
    """

    default: Any
    annotation: str
    meaning: str = ""
    range: Range | None = None


class KeyRow(NamedTuple):
    """A row of the table of keys: what a configuration may hold.

    Attributes:
        name: of the key.
        type: in words.
        range: in words; "" for any value of its type.
        meaning: what it is.
        default: its value where none is given.
    """

    name: str
    type: str
    range: str
    meaning: str
    default: Any


_TYPES = {
    "bool": "True or False",
    "int": "integer",
    "float": "number",
    "str": "text",
    "int | None": "integer or None",
    "float | None": "number or None",
    "Rectangle": "(xmin, ymin, xmax, ymax)",
    "Placements": "list of (xmin, ymin, xmax, ymax), or None",
    "Locations": "list of (x, y)",
    "tuple[str, ...]": "list of texts",
    "tuple[float, ...]": "list of numbers",
    "tuple[int, int]": "two integers",
}


def key_table() -> list[KeyRow]:
    """Return what there is to know of every key, registered ones included.

    Examples:
        >>> {row.name: row for row in key_table()}["hazards_size"][1:]
        ('number', 'greater than 0', 'radius [m]', 0.3)
    """
    return [
        KeyRow(
            name=field.name,
            type=_TYPES[str(field.type)],
            range=str(field.metadata["range"]),
            meaning=field.metadata["meaning"],
            default=field.default,
        )
        for field in dataclasses.fields(_vocabulary)
    ]


_BUILT_IN = frozenset(field.name for field in dataclasses.fields(SafetyGymConfig))
_registered: dict[str, Key] = {}
_vocabulary: type[SafetyGymConfig] = SafetyGymConfig


def known_keys() -> list[str]:
    """Return the names of all keys, registered ones included."""
    return [field.name for field in dataclasses.fields(_vocabulary)]


def registered_keys() -> dict[str, Key]:
    """Return the keys that are not built in."""
    return dict(_registered)


def set_registered_keys(keys: Mapping[str, Key]) -> None:
    """Let the vocabulary consist of the built-in keys and these.

    Raises:
        ConfigError: if a key is built in, or a default is not of its type.
    """
    global _vocabulary
    for name, key in keys.items():
        if name in _BUILT_IN:
            raise ConfigError(f"The configuration key '{name}' is taken: choose another name.")
        coerce(name, key.annotation, key.default, _range_of(name, key))
    for name in _registered:
        delattr(SafetyGymConfig, name)
    # Configurations that were made earlier have the default of what they don't know.
    for name, key in keys.items():
        setattr(SafetyGymConfig, name, key.default)
    _registered.clear()
    _registered.update(keys)
    _vocabulary = dataclasses.make_dataclass(
        "SafetyGymConfig",
        [(name, key.annotation, _field_of(name, key)) for name, key in keys.items()],
        bases=(SafetyGymConfig,),
        namespace={"__module__": __name__, "__doc__": SafetyGymConfig.__doc__},
        frozen=True,
        kw_only=True,
        eq=False,
    )


def _range_of(name: str, key: Key) -> Range:
    return infer_range(name) if key.range is None else key.range


def _field_of(name: str, key: Key) -> Any:
    return declare(key.default, key.meaning, _range_of(name, key))
