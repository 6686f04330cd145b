"""Nodes of environments of other libraries: their keys, how each is checked, and what is found out.

A configuration may come from somebody else. So an `id` that has a library import a module, or that
names a class which is not listed here, is refused: the user names such a module by `import=`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Annotated, Any

import gymnasium

from safe_rl.envs.costs import parse_columns, parse_entries
from safe_rl.envs.errors import ConfigError, nearest
from safe_rl.ranges import Count, Range, Text, values_of

__all__ = [
    *("GYMNASIUM", "SAFETY_GYMNASIUM", "TORCHRL", "TORCHRL_CLASSES", "ForeignFamily"),
    *("complete_foreign", "hint_of_gymnasium"),
]

# MuJoCo's own library is installed; the default of these classes is another package.
_MUJOCO = {"backend": "mujoco", "parallel": False}
TORCHRL_CLASSES: dict[str, Mapping[str, Any]] = {
    "PendulumEnv": {},
    "FinancialRegimeEnv": {},
    "GymEnv": {"categorical_action_encoding": True},
    **dict.fromkeys(("AntEnv", "HopperEnv", "HumanoidEnv", "Walker2dEnv"), _MUJOCO),
}
"""Classes of `torchrl.envs` that need no `import=`, and the arguments that they get by default."""


@dataclass(frozen=True, kw_only=True)
class ForeignFamily:
    """The environments of one library.

    Attributes:
        target: `_target_` of its nodes.
        title: What messages call one of its environments.
        keys: Key -> its default, and an annotation that says what it may be. All have `id` and
            `name`.
        arguments: What `kwargs` are, for messages.
        which: What to say where no `id` is given.
        check: Checks the whole node, before an environment is made.
        describe: "module:function" that returns the cost keys and the length of episodes of a node,
            and finds out those that are None by making an environment.
    """

    target: str
    title: str
    keys: Mapping[str, tuple[Any, Any]]
    arguments: str
    which: str
    check: Callable[[Mapping[str, Any]], None]
    describe: str


def complete_foreign(family: ForeignFamily, node: Mapping[str, Any]) -> dict[str, Any]:
    """Fill a node up: the costs and the length of episodes are found out where they are None.

    Raises:
        ConfigError: For an unknown key or id, or an environment that the algorithms cannot use.
    """
    for key in node:
        if key not in (*family.keys, "id", "name", "_target_"):
            raise ConfigError(
                f"{family.title} has no key '{key}'.{nearest(str(key), [*family.keys, 'id'])} "
                f"{family.arguments}"
            )
    if not isinstance(node.get("id"), str):
        raise ConfigError(f"Which environment? {family.which}")
    full = {"name": node["id"], **{key: row[0] for key, row in family.keys.items()}, **node}
    for key, (_, annotation) in family.keys.items():
        values = values_of(annotation)
        if not values.hold(full[key]):
            raise ConfigError(f"'{key}' must be {values.words}, got {full[key]!r}.")
    family.check(full)
    if None in (full["cost_keys"], full["num_steps"]):
        # Imported here: making environments needs torch, and knowing their names does not.
        module, _, function = family.describe.partition(":")
        full["cost_keys"], full["num_steps"] = getattr(import_module(module), function)(full)
    return full


def hint_of_gymnasium(name: str) -> str:
    """Say how to choose an environment by its Gymnasium id; an empty text for any other name.

    Examples:
        >>> hint_of_gymnasium("CartPole-v1")
        " It is one of Gymnasium's: env=gymnasium env.id=CartPole-v1."
        >>> hint_of_gymnasium("Safexp-PointGoal1-v0"), hint_of_gymnasium("PointGaol1")
        ('', '')
    """
    spec = gymnasium.registry.get(name)
    if spec is None or str(spec.entry_point).startswith("safe_rl."):
        return ""
    return f" It is one of Gymnasium's: env=gymnasium env.id={name}."


def _refuse_module(key: str, name: str, instead: str) -> None:
    """Refuse `module:Name-v0`, for which a library imports the module."""
    module, _, plain = name.rpartition(":")
    if module:
        raise ConfigError(
            f"{key}={name}: configurations import nothing. If you trust '{module}', use "
            f"import={module} {instead}{plain}"
        )


def _check_gymnasium(node: Mapping[str, Any]) -> None:
    _refuse_module("env.id", node["id"], "env.id=")
    parse_columns("outside", node.get("outside"))


def _check_torchrl(node: Mapping[str, Any]) -> None:
    name = node["id"]
    if "." not in name and name not in TORCHRL_CLASSES:
        raise ConfigError(
            f"env.id={name} is not among {', '.join(TORCHRL_CLASSES)}."
            f"{nearest(name, TORCHRL_CLASSES)} Any other class of TorchRL's comes with "
            "import=torchrl.envs env.id=torchrl.envs.NAME, one of yours with import=my_module "
            "env.id=my_module.NAME, and one of Gymnasium's by its id with env=gymnasium."
        )
    parse_entries("outside", node["outside"])
    known_name = (node["kwargs"] or {}).get("env_name", "")
    _refuse_module("env.kwargs.env_name", str(known_name), "and env_name: ")


_Names, _Arguments = list[Text] | None, Mapping[str, Any] | None
_COMMON: dict[str, tuple[Any, Any]] = {
    "cost_keys": (None, _Names),
    "num_steps": (None, Count | None),
    "kwargs": (None, _Arguments),
}
_GYMNASIUM_KEYS = {
    **_COMMON,
    "workers": (0, Annotated[int, Range(0)]),
    "render_mode": (None, Text | None),
}

GYMNASIUM = ForeignFamily(
    target="safe_rl.envs.gymnasium.make_gymnasium",
    title="A Gymnasium environment",
    keys={**_GYMNASIUM_KEYS, "outside": (None, Any), "flatten": (False, bool)},
    arguments="Arguments for gymnasium.make stand in 'kwargs', as env.kwargs='{render_fps: 30}'.",
    which="Name a registered one: env.id=…",
    check=_check_gymnasium,
    describe="safe_rl.envs.gymnasium.conversion:describe_node",
)
SAFETY_GYMNASIUM = ForeignFamily(
    target="safe_rl.envs.gymnasium.make_safety_gymnasium",
    title="An environment of Safety-Gymnasium",
    keys=_GYMNASIUM_KEYS,
    arguments=(
        "Arguments for safety_gymnasium.make stand in 'kwargs', as env.kwargs='{config: {…}}'."
    ),
    which="env.id=SafetyPointGoal1-v0, for example.",
    check=_check_gymnasium,
    describe="safe_rl.envs.gymnasium.six_values:describe_node",
)
TORCHRL = ForeignFamily(
    target="safe_rl.envs.torchrl.make_torchrl",
    title="An environment of TorchRL",
    keys={**_COMMON, "observe": (None, _Names), "flatten": (True, bool)}
    | dict.fromkeys(("outside", "cost"), (None, Any)),
    arguments="Arguments of its class stand in 'kwargs', as env.kwargs='{frame_skip: 2}'.",
    which=f"env.id=…, one of {', '.join(TORCHRL_CLASSES)}, or your own.",
    check=_check_torchrl,
    describe="safe_rl.envs.torchrl.torchrl_batches:describe_node",
)
