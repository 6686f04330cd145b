"""Names in overrides of ``train.py``: which ones nothing reads, and what was meant.

Hydra answers a key that does not exist with advice to add it, after which it has no effect.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.object_type import ObjectType
from hydra.core.override_parser.types import Override
from omegaconf import DictConfig, OmegaConf

from safe_rl.cli.keys import KEYS
from safe_rl.cli.settings import optional_keys, plain
from safe_rl.naming import did_you_mean, nearest
from safe_rl.targets import locate

__all__ = [
    "CommandLineError",
    "check_added",
    "check_choices",
    "check_limits",
    "check_read",
    "explain",
]

_DEFAULT_RECIPE = "safe_rl.algorithms.OnPolicy"


class CommandLineError(ValueError):
    """A command line that cannot be used; the message says what to write instead."""


def check_choices(overrides: Sequence[Override], loader: ConfigLoader) -> None:
    """Check what is chosen of groups, such as ``env=CarGoal1`` or ``algo=ppo,cpo``.

    Args:
        overrides: Overrides of a command line.
        loader: Knows the files in all folders, and the environments that are registered.

    Raises:
        CommandLineError: For a choice that does not exist; the nearest one is named.

    Examples:
        >>> from hydra.core.override_parser.overrides_parser import OverridesParser
        >>> check_choices(OverridesParser.create().parse_overrides(["frames=9"]), loader=None)
    """
    for override in overrides:
        group = override.key_or_group
        is_named = override.is_discrete_sweep() or isinstance(override.value(), str | list)
        known = loader.get_group_options(group, ObjectType.CONFIG) if is_named else []
        if not known or override.is_delete():
            continue
        chosen = override.sweep_string_iterator() if override.is_sweep_override() else None
        # of some groups several are chosen: transforms=[saute,action_filter]
        for name in _names(chosen or [override.get_value_element_as_str()]):
            if name not in known:
                raise CommandLineError(
                    f"'{override.input_line}': there is no {group} '{name}'."
                    f"{did_you_mean(name, known)}"
                )


def _names(choices: Iterable[str]) -> Iterator[str]:
    """Single names of choices that are names or lists of them."""
    for choice in choices:
        yield from filter(None, re.split(r"[\[\],\s'\"]+", choice))


def check_limits(overrides: Sequence[Override]) -> None:
    """Refuse single limits, which would be merged into the default ones.

    Raises:
        CommandLineError: If there is one.
    """
    for override in overrides:
        section, _, cost = override.key_or_group.partition(".")
        if section == "cost_limits" and cost:
            raise CommandLineError(
                f"'{override.input_line}': limits are given all at once, as "
                f"cost_limits='{{{cost}: {override.get_value_element_as_str()}}}'."
            )


def check_added(overrides: Sequence[Override], config: DictConfig) -> None:
    """Refuse keys that are added at the top, where no table knows them, and that nothing reads.

    What sections and parts do not take is refused with their values.

    Args:
        overrides: Overrides of a command line.
        config: What they make.

    Raises:
        CommandLineError: For the first one; right ones are named.
    """
    text = OmegaConf.to_yaml(config)
    for override in overrides:
        head = override.key_or_group.partition(".")[0]
        is_added = override.is_add() or override.is_force_add()
        is_known = any(path.partition(".")[0] == head for path in KEYS)
        if not is_added or is_known or head not in config or "/" in override.key_or_group:
            continue
        # ${head}, ${head.key}, ${resolver:head.key}
        if not re.search(rf"\$\{{(?:[^${{}}]*[:,])?{re.escape(head)}[.,}}]", text):
            others = {key: node for key, node in plain(config).items() if key != head}
            raise CommandLineError(_unread(override.input_line, override.key_or_group, others))


def check_read(overrides: Sequence[Override], config: DictConfig) -> None:
    """Refuse keys that a configuration holds and its algorithm does not read.

    Args:
        overrides: Overrides of a command line.
        config: What they make.

    Raises:
        CommandLineError: For the first one; it says why.
        TargetError: If there is no such algorithm.
    """
    recipe = locate(config.algo.get("_target_", _DEFAULT_RECIPE), "algo._target_")
    for override in overrides:
        key = override.key_or_group.replace("/", ".")
        for unread, reason in getattr(recipe, "unread", {}).items():
            if f"{key}.".startswith(f"{unread}."):
                raise CommandLineError(
                    f"'{override.input_line}': algo={config.algo.name} does not read '{unread}'. "
                    f"{reason}"
                )


def explain(
    error: Exception, overrides: Sequence[str], compose: Callable[[str], DictConfig]
) -> str:
    """Say what is wrong with overrides that Hydra could not compose, in one line.

    Args:
        error: What Hydra says.
        overrides: The overrides.
        compose: Composes what they choose, without the one that it gets and all that set keys.
    """
    words = " ".join(str(error.__cause__ or error if not str(error) else error).split())
    key = _quoted(r"Could not override '([^']+)'", words)
    if key is None:
        there = _quoted(r"An item is already at '([^']+)'", words)
        return words if there is None else f"'{there}' is there already: write it without +."
    given = next(text for text in overrides if text.lstrip("+").startswith(f"{key}="))
    values = plain(compose(given))
    inner = _quoted(r"full_key: (\S+)", str(error.__cause__))
    if inner is not None and inner.startswith(f"{key}."):
        section, _, name = inner.rpartition(".")
        head = f"{section}."
        inside = [path.removeprefix(head) for path in _paths(values) if path.startswith(head)]
        meant = nearest(name, inside)
        advice = f"add +{inner}=…" if meant is None else f"did you mean '{meant}'?"
        return f"'{given}': '{section}' has no '{name}', {advice}"
    section = key.partition(".")[0]
    if section not in values and any(path.partition(".")[0] == section for path in KEYS):
        return f"'{given}': algo={values['algo']['name']} has no '{section}'."
    return _unread(given, key, values)


def _quoted(pattern: str, words: str) -> str | None:
    found = re.search(pattern, words)
    return None if found is None else found[1]


def _unread(given: str | None, key: str, values: Mapping[str, Any]) -> str:
    """That nothing reads a key, and the full paths of those that were meant."""
    written = {path: path for path in _paths(values)}
    written |= {path: f"+{path}" for path in optional_keys(values)}
    meant = [f"'{written[path]}'" for path in _meant(key, list(written))]
    hint = f" Did you mean {' or '.join(meant)}?" if meant else ""
    return f"'{given}': nothing reads '{key}'.{hint}"


def _meant(key: str, paths: Sequence[str]) -> list[str]:
    """Paths that end like the key, or else the nearest one, or those whose end is nearest."""
    name = key.rpartition(".")[2]
    by_end = [path for path in paths if path.rpartition(".")[2] == name]
    if by_end:
        return by_end
    whole = nearest(key, paths)
    end = nearest(name, [path.rpartition(".")[2] for path in paths])
    if whole is not None or end is None:
        return [] if whole is None else [whole]
    return [path for path in paths if path.rpartition(".")[2] == end]


def _paths(values: Mapping[str, Any], prefix: str = "") -> Iterator[str]:
    """Full paths of everything that can be overridden."""
    for key, value in values.items():
        path = f"{prefix}{key}"
        if isinstance(value, Mapping) and path not in _WHOLE:
            yield from _paths(value, f"{path}.")
        elif not str(key).startswith("_"):
            yield path


_WHOLE = ("cost_limits", "default_cost_limits", "model.input_scale", "paper")
