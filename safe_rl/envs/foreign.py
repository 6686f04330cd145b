"""Environments of other libraries: their families, and costs for leaving a range.

A configuration may come from an unknown source. So an `id` cannot make a library import a module:
the user permits it by `import=`.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from pkgutil import resolve_name
from shlex import quote
from typing import Annotated, Any, NamedTuple

from annotated_types import Interval
from pydantic import AllowInfNan, ValidationError

from safe_rl.checks import Text
from safe_rl.envs.keys import ConfigError, Count, Key, adapter, as_plain, check_key, is_cost
from safe_rl.naming import did_you_mean

_RANGES = (
    "costs of leaving a range: cost_<kind> -> [column of the observation, lowest, highest], of "
    "another entry [entry, column, lowest, highest]"
)
_PRIVILEGED = Key(None, Text | None, "entry that becomes `privileged`, for critics only")
_COMMON = {
    "cost_keys": Key(
        None, tuple[Text, ...] | None, "names of the costs; null: `cost` and all `cost_<kind>`"
    ),
    "num_steps": Key(
        None, Count | None, "steps after which an episode is truncated; null: its own number"
    ),
    "kwargs": Key(None, dict[str, Any] | None, "arguments of its constructor: {g: 9.81}"),
}


_GYMNASIUM = {
    **_COMMON,
    "privileged": _PRIVILEGED,
    "render_mode": Key(None, Text | None, "rgb_array for pictures; evaluate video=true sets it"),
    "outside": Key(None, Any, _RANGES),
    "flatten": Key(False, bool, "true: one vector; false: dictionaries and pictures stay"),
}


class ForeignFamily(NamedTuple):
    """The environments of one library; `env=<name> env.id=…` chooses one.

    Attributes:
        target: `_target_` of its nodes.
        keys: Its keys. `id` and `name`, which all families have, are not listed.
        describe: "module:function" that returns the cost keys and the length of episodes of a node.
            If one of them is None, it makes an environment to find out.
    """

    target: str
    keys: Mapping[str, Key]
    describe: str


# Name in the group `env` -> family of another library.
FOREIGN = {
    "gymnasium": ForeignFamily(
        "safe_rl.envs.gymnasium.make_gymnasium",
        _GYMNASIUM,
        "safe_rl.envs.gymnasium.conversion:describe_gymnasium",
    ),
    "safety_gymnasium": ForeignFamily(
        "safe_rl.envs.gymnasium.make_safety_gymnasium",
        _GYMNASIUM | {"flatten": _GYMNASIUM["flatten"]._replace(default=True)},
        "safe_rl.envs.gymnasium.conversion:describe_safety_gymnasium",
    ),
    "torchrl": ForeignFamily(
        "safe_rl.envs.torchrl.make_torchrl",
        {
            **_COMMON,
            "observe": Key(None, tuple[Text, ...] | None, "entries; null: `observation` or all"),
            "privileged": _PRIVILEGED,
            "flatten": Key(True, bool, "true: several entries become one vector"),
            "outside": Key(None, Any, _RANGES),
            "cost": Key(None, Any, "a function from a step to its cost: my_module:function, or "
                        "{_target_: my_module.function, limit: 4}"),
        },
        "safe_rl.envs.torchrl:describe_node",
    ),
}  # fmt: skip


def complete_foreign(family: ForeignFamily, node: Mapping[str, Any]) -> dict[str, Any]:
    """Return a node with all keys.

    If its cost keys or the length of its episodes are None, they are read from an environment.

    Raises:
        ConfigError: For an unknown key or id, or an environment that the algorithms cannot use.
    """
    for key in node:
        if key not in (*family.keys, "id", "name", "_target_"):
            hint = did_you_mean(str(key), [*family.keys, "id"])
            raise ConfigError(
                f"This environment has no key '{key}'.{hint} The environment's own arguments "
                "belong in 'kwargs': env.kwargs='{…}'. Its physics cannot use preset=gpu."
            )
    if not isinstance(node.get("id"), str):
        raise ConfigError("Which environment? Name it: env.id=…")
    module, _, plain = node["id"].rpartition(":")
    if module and family is not FOREIGN["torchrl"]:  # Gymnasium would import it
        raise ConfigError(
            f"env.id={node['id']}: a configuration cannot import a module. If you trust "
            f"'{module}', use {quote(f'import={module}')} {quote(f'env.id={plain}')}"
        )
    if plain.startswith("GymV"):  # of OpenAI's gym, which imports the module in the argument env_id
        raise ConfigError(
            f"env.id={node['id']}: it imports what its arguments name. Make the environment in a "
            "module of yours, and register it with Gymnasium: import=my_module"
        )
    full = {"name": node["id"], **node}
    for key, row in family.keys.items():
        check_key(key, row.annotation, full.setdefault(key, row.default))
    parse_ranges(full.get("outside"))
    if None in (full["cost_keys"], full["num_steps"]):
        full["cost_keys"], full["num_steps"] = resolve_name(family.describe)(full)
    return full


_FORM = (
    "'{cost_speed: [2, -4, 4]}' (column of the observation, lowest, highest), or for another entry "
    "[thdot, -4, 4], or with its column [thdot, 0, -4, 4]"
)
_Column = Annotated[int, Interval(ge=0)]
_Bound = int | Annotated[float, AllowInfNan()]
_Row = (
    tuple[_Column, _Bound, _Bound]
    | tuple[str, _Bound, _Bound]
    | tuple[str, _Column, _Bound, _Bound]
)


class CostRange(NamedTuple):
    """A range of values without a cost; values outside it have a cost.

    Attributes:
        entry: Name of the entry, with dots where it is nested.
        column: Column of the entry, counted from 0.
        low: Lowest value without a cost.
        high: Highest value without a cost.
    """

    entry: str
    column: int
    low: float
    high: float


def parse_ranges(outside: Any) -> dict[str, CostRange]:
    """Return the ranges of the configuration key `outside`, by the names of their costs.

    Args:
        outside: Name -> (entry, column, lowest, highest). The default entry is the observation. The
            default column of another entry is the first one. None means no ranges.

    Raises:
        ConfigError: If a name, the form of a range or its bounds are wrong.

    Examples:
        >>> parse_ranges({"cost_speed": ["thdot", -4, 4]})
        {'cost_speed': CostRange(entry='thdot', column=0, low=-4, high=4)}
    """
    if outside is not None and not isinstance(outside, Mapping):
        raise ConfigError(f"'outside' must have the form {_FORM}; got {outside!r}.")
    ranges = {}
    for name, row in (outside or {}).items():
        try:
            *place, low, high = adapter(_Row).validate_python(as_plain(row))
        except ValidationError:
            message = f"'outside' must have the form {_FORM}; got {name}: {row!r}."
            raise ConfigError(message) from None
        entry = place[0] if isinstance(place[0], str) else "observation"
        kept = CostRange(entry, place[-1] if isinstance(place[-1], int) else 0, low, high)
        if not kept.low <= kept.high or (math.isinf(kept.low) and math.isinf(kept.high)):
            raise ConfigError(f"'outside': {name} cannot have the range {kept.low} to {kept.high}.")
        if not is_cost(name):
            raise ConfigError(f"'outside': costs are called cost or cost_<kind>, not '{name}'.")
        ranges[name] = kept
    return ranges
