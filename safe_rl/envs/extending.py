"""Registration of elements, tasks, costs, observations and robots from outside the package.

Each function adds one row to the table of the built-in rows, and its configuration keys to the
built-in keys, with the same checks. To register a name again replaces its row, so that a notebook
cell can run twice. Environments that exist already do not change.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any

from pydantic import NonNegativeFloat, PositiveFloat

from safe_rl.envs.keys import ConfigError, Key
from safe_rl.envs.safety_gym.config import KEYS, ROBOTS, infer_key, register_keys
from safe_rl.envs.safety_gym.config_keys import Locations, Objects, Placements
from safe_rl.envs.safety_gym.costs import (
    BUILT_IN_COSTS,
    COSTS,
    EXCEPTION_KEY,
    Cost,
    contact_cost,
    hazard_cost,
)
from safe_rl.envs.safety_gym.elements import (
    BOX,
    BY_KIND,
    CYLINDER,
    ELEMENTS,
    PLACEMENT_ORDER,
    PUSHED,
    SPHERE,
    Element,
    Geom,
    Motion,
)
from safe_rl.envs.safety_gym.observations import READINGS, Reading
from safe_rl.envs.safety_gym.robots import load_robot
from safe_rl.envs.safety_gym.tasks import BUILT_IN_TASKS, TASKS, Task
from safe_rl.envs.safety_gym.world import World
from safe_rl.naming import did_you_mean

__all__ = [
    "BOX",
    "CYLINDER",
    "SPHERE",
    "Cost",
    "Element",
    "Geom",
    "Key",
    "Motion",
    "Reading",
    "Task",
    "World",
    "contact_cost",
    "hazard_cost",
    "register_cost",
    "register_element",
    "register_observation",
    "register_robot",
    "register_task",
]

_BUILT_IN = {
    "element": frozenset(BY_KIND),
    "task": BUILT_IN_TASKS,
    "cost": BUILT_IN_COSTS | {"cost", EXCEPTION_KEY},
    "observation": frozenset(row.name for row in READINGS),
    "robot": frozenset(ROBOTS),
}


def register_element(element: Element, keys: Mapping[str, Any] | None = None) -> None:
    """Add a kind of object.

    It gets the configuration keys `<kind>_placements`, `<kind>_locations`, `<kind>_keepout` and
    `<kind>_size`; also `<kind>_num`, unless it belongs to a task (kind and label are equal);
    `observe_<kind>`, unless the row names another flag; `<kind>_density` and `<kind>_rots` if it
    can be pushed; and `<kind>_travel` if it is guided. It is placed after the built-in kinds.

    Args:
        element: The row.
        keys: Further keys with their defaults, and other defaults for the keys above. If the
            default has no clear type (None, an empty tuple), give `Key(default, annotation)`.

    Raises:
        ConfigError: If the kind, its label or a key is taken, a default cannot be used, or the flag
            is no key.

    Examples:
        >>> puddle = Element(
        ...     kind="puddles",
        ...     label="puddle",
        ...     motion=Motion.VIRTUAL,
        ...     height=lambda c: 0.01,
        ...     geoms=lambda c: (Geom(CYLINDER, (c.puddles_size, 0.005)),),
        ...     rgb=(0.2, 0.4, 0.6),
        ...     group=3,
        ... )
        >>> register_element(puddle, keys={"puddles_keepout": 0.3, "puddles_depth": 0.1})
        >>> from safe_rl.envs import SafetyGymConfig
        >>> SafetyGymConfig(puddles_num=2).puddles_depth
        0.1
    """
    _refuse_taken("element", element.kind)
    standard = _keys_of(element)
    _refuse_unknown_flags((element.flag,) if element.flag else (), {**standard, **(keys or {})})
    others = [row for row in ELEMENTS if row.kind != element.kind]
    if element.label in {"robot", "floor", *(row.label for row in others)}:
        raise ConfigError(f"Another object is called '{element.label}': choose another label.")
    if element.label == element.kind and f"{element.kind}_num" in (keys or {}):
        raise ConfigError(
            f"There is only one object if 'label' and 'kind' are both '{element.kind}': give "
            "another label, or no number of objects."
        )
    _add_keys(keys, standard)
    # Rows of one motion stand together, because slots, bodies and `qpos` are in their order.
    place = 1 + max(i for i, row in enumerate(others) if row.motion is element.motion)
    ELEMENTS[:] = [*others[:place], element, *others[place:]]
    BY_KIND[element.kind] = element
    if element.kind not in PLACEMENT_ORDER:
        PLACEMENT_ORDER.append(element.kind)


def register_task(name: str, task: Task, keys: Mapping[str, Any] | None = None) -> None:
    """Add a task.

    Args:
        name: Value of the configuration key `task`.
        task: The row.
        keys: Its configuration keys with their defaults.

    Raises:
        ConfigError: If the name or a key is taken, or the row names unknown elements.

    Examples:
        >>> away = Task(lambda c, w, before, now: c.reward_away * w.robot_vel[:, 0].abs())
        >>> register_task("away", away, keys={"reward_away": 0.5})
    """
    _refuse_taken("task", name)
    for kinds in (task.elements, task.touches, task.at_origin):
        _refuse_unknown("element", kinds, BY_KIND)
    for kind in (kind for kind in task.elements if BY_KIND[kind].label != kind):
        raise ConfigError(f"Task '{name}' cannot add '{kind}': set the key '{kind}_num' instead.")
    if (task.met or task.goal_at_button) and "goal" not in task.elements:
        raise ConfigError(f"Task '{name}' meets or draws goals: add 'goal' to its elements.")
    _add_keys(keys)
    TASKS[name] = task


def register_cost(cost: Cost, keys: Mapping[str, Any] | None = None) -> None:
    """Add a cost key.

    Args:
        cost: The row; its key starts with "cost_".
        keys: Its configuration keys with their defaults.

    Raises:
        ConfigError: If the key is taken or badly named, or the row names unknown elements or keys.

    Examples:
        >>> speeding = Cost(
        ...     "cost_speeding",
        ...     flags=("constrain_speed",),
        ...     magnitude=lambda c, w: (w.robot_vel.norm(dim=-1) - c.speed_limit).clamp(min=0.0),
        ... )
        >>> register_cost(speeding, keys={"constrain_speed": False, "speed_limit": 1.0})
    """
    _refuse_taken("cost", cost.key)
    if not cost.key.startswith("cost_"):
        raise ConfigError(f"The cost key '{cost.key}' must start with 'cost_'.")
    _refuse_unknown("element", cost.touches, BY_KIND)
    _refuse_unknown_flags(cost.flags, keys)
    _add_keys(keys)
    COSTS[:] = [*(row for row in COSTS if row.key != cost.key), cost]


def register_observation(reading: Reading, keys: Mapping[str, Any] | None = None) -> None:
    """Add a component of the observation.

    Args:
        reading: The row.
        keys: Its configuration keys with their defaults.

    Raises:
        ConfigError: If the name or a key is taken, or the row names unknown elements or keys.

    Examples:
        >>> height = Reading(
        ...     "height",
        ...     flags=("observe_height",),
        ...     size=lambda c, scene: 1,
        ...     read=lambda w: w.robot_pos[:, 2:],
        ... )
        >>> register_observation(height, keys={"observe_height": False})
    """
    _refuse_taken("observation", reading.name)
    _refuse_unknown("element", reading.touches, BY_KIND)
    _refuse_unknown_flags(reading.flags, keys)
    _add_keys(keys)
    READINGS[:] = [*(row for row in READINGS if row.name != reading.name), reading]


def register_robot(name: str, path: str | Path) -> None:
    """Give an MJCF file a name that `robot_base` accepts.

    Raises:
        ConfigError: If the name is taken, or the file lacks what `robots` asks for.
    """
    _refuse_taken("robot", name)
    load_robot(Path(path))
    ROBOTS[name] = Path(path)


def _refuse_taken(what: str, name: str) -> None:
    if name in _BUILT_IN[what]:
        raise ConfigError(f"'{name}' is a built-in {what}: choose another name.")


def _refuse_unknown(
    what: str, names: Iterable[str], known: Collection[str], remedy: str = "Register it first."
) -> None:
    if isinstance(names, str):
        raise ConfigError(f"'{names}' must stand in a tuple: ('{names}',), with a comma.")
    for name in (name for name in names if name not in known):
        raise ConfigError(f"There is no {what} '{name}'.{did_you_mean(name, known)} {remedy}")


def _refuse_unknown_flags(flags: Iterable[str], keys: Mapping[str, Any] | None) -> None:
    """Refuse flags that are no keys; `keys` are those that the row adds."""
    _refuse_unknown("key", flags, {**KEYS, **(keys or {})}, "Add it to 'keys'.")


def _keys_of(element: Element) -> dict[str, Key]:
    """Return the keys that `register_element` adds by itself."""
    keys = {
        "placements": Key(None, Placements),
        "locations": Key((), Locations),
        "keepout": Key(0.4, NonNegativeFloat),
        "size": Key(0.1, PositiveFloat),
    }
    if element.label != element.kind:
        keys["num"] = Key(0, Objects)
    if element.motion in PUSHED:
        keys |= {"density": Key(0.001, PositiveFloat), "rots": Key((), tuple[float, ...])}
    if element.motion is Motion.GUIDED:
        keys["travel"] = Key(0.3, NonNegativeFloat)
    named = {f"{element.kind}_{suffix}": key for suffix, key in keys.items()}
    return named if element.flag else {**named, f"observe_{element.kind}": Key(False, bool)}


def _add_keys(given: Mapping[str, Any] | None, standard: Mapping[str, Key] | None = None) -> None:
    """Register standard keys and the given ones, whose values are defaults or `Key`s."""
    keys = dict(standard or {})
    for name, value in (given or {}).items():
        if isinstance(value, Key):
            keys[name] = value
        elif name in keys:
            keys[name] = keys[name]._replace(default=value)
        else:
            keys[name] = infer_key(name, value)
    register_keys(keys)
