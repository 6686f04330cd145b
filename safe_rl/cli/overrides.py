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
from hydra.errors import HydraException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from safe_rl.cli.keys import KEYS
from safe_rl.cli.meant import choice_with, keys_meant, paths_of
from safe_rl.cli.settings import SettingError, optional_keys, plain
from safe_rl.envs.foreign import hint_of_gymnasium
from safe_rl.naming import did_you_mean, nearest

__all__ = [
    "COMPOSING_ERRORS",
    "GIVEN_WHOLE",
    "CommandLineError",
    "check_added",
    "check_choices",
    "check_read",
    "check_whole",
    "explain",
]

COMPOSING_ERRORS = (HydraException, OmegaConfBaseException, YAMLError, ValueError)
"""What Hydra raises about overrides and files."""

_BUDGETED = ("saute", "simmer", "early_termination")
GIVEN_WHOLE = {
    **{"cost_limits": "limits", "model.input_scale": "factors"},
    **{f"transforms.{name}.budgets": "budgets" for name in _BUDGETED},
}
_MOST_LISTED = 40
_ONE_EACH = ("env", "algo", "preset", "model", "risk", "collector", "logger", "lagrangian")


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
        group, value = override.key_or_group, override.value()
        may_choose = value is None or isinstance(value, bool | str | list)
        is_choice = may_choose or override.is_discrete_sweep()
        known = loader.get_group_options(group, ObjectType.CONFIG) if is_choice else []
        if not known or override.is_delete():
            continue
        sweep = override.sweep_string_iterator() if override.is_sweep_override() else None
        chosen = list(_names(sweep or [override.get_value_element_as_str()]))
        if isinstance(value, list) and chosen and group in _ONE_EACH:
            raise CommandLineError(
                f"'{override.input_line}': a run has one {group}; for a run with each of them: "
                f"-m {group}={','.join(chosen)}"
            )
        # of some groups several are chosen, or none: transforms=[saute,action_filter]
        for name in chosen if chosen or isinstance(value, list) else [""]:
            if name not in known:
                family = hint_of_gymnasium(name) if group == "env" else ""
                raise CommandLineError(
                    f"'{override.input_line}': there is no {group} '{name}'."
                    f"{family or did_you_mean(name, known) or _listed(known)}"
                )


def _names(choices: Iterable[str]) -> Iterator[str]:
    """Single names of choices that are names or lists of them."""
    for choice in choices:
        yield from filter(None, re.split(r"[\[\],\s'\"]+", choice))


def _listed(choices: Sequence[str]) -> str:
    """What there is to choose from, or where that is told if a line cannot hold it."""
    if len(choices) > _MOST_LISTED:
        return " 'python train.py --help' names all there are."
    return f" There are {', '.join(choices)}."


def check_whole(overrides: Sequence[Override]) -> None:
    """Refuse a single limit or factor, and two mappings of them: a mapping is given as a whole.

    Raises:
        CommandLineError: If there are any.
    """
    for section, what in GIVEN_WHOLE.items():
        whole = [o for o in overrides if o.key_or_group == section and not o.is_delete()]
        if whole[1:]:
            given = ", ".join(str(override.input_line) for override in whole)
            raise CommandLineError(f"'{section}' is given more than once: {given}.")
        for override in overrides:
            name = override.key_or_group.removeprefix(f"{section}.")
            if name != override.key_or_group:
                raise CommandLineError(
                    f"'{override.input_line}': {what} are given all at once, as "
                    f"{section}='{{{name}: {override.get_value_element_as_str()}}}'."
                )


def check_added(overrides: Sequence[Override], config: DictConfig) -> None:
    """Refuse keys that are added at the top level, ``+key=…``, and that nothing reads.

    Keys below sections and parts are checked with their values.

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
    algo = config.get("algo") or {}
    refused = _unread_by(algo)
    for override in overrides:
        key = override.key_or_group.replace("/", ".")
        for unread, reason in refused.items():
            path, _, choice = unread.partition("=")
            is_chosen = not choice or OmegaConf.select(config, path) == choice
            if is_chosen and f"{key}.".startswith(f"{path}."):
                verb = "has no" if choice else "does not read"
                raise CommandLineError(
                    f"'{override.input_line}': algo={algo.get('name')} {verb} '{unread}'. {reason}"
                )


def _unread_by(algo: Mapping[str, Any]) -> Mapping[str, str]:
    """Keys that an algorithm does not read, choices that are not for it, and the reasons."""
    from safe_rl.algorithms.parts import find_recipe  # with torch: not for help and --cfg

    return find_recipe(OmegaConf.create({"algo": dict(algo)})).unused_keys


def explain(
    error: Exception,
    overrides: Sequence[str],
    choices: list[str],
    compose: Callable[[list[str]], DictConfig],
    options: Callable[[str], Sequence[str]],
) -> str:
    """Say what is wrong with overrides, or files, that Hydra could not compose, in one line.

    Args:
        error: What Hydra says.
        overrides: The overrides.
        choices: Those among them that choose files.
        compose: Composes what some of these choose.
        options: Names of the files in a group.
    """
    words = " ".join(str(error.__cause__ or error if not str(error) else error).split())
    if (place := re.match(r"In '([^']+)': (.*)", words)) is not None:  # said of files alone
        return _in_file(place[1], place[2], getattr(error, "options", None))
    if (there := _quoted(r"An item is already at '([^']+)'", words)) is not None:
        return f"'{there}' is there already: write it without +."
    key = _quoted(r"Could not override '([^']+)'", words)
    given = next((text for text in overrides if text.lstrip("+").startswith(f"{key}=")), None)
    if key is None or given is None:
        return _of_a_choice(words, choices, compose)
    others = [choice for choice in choices if choice != given]
    # with all that is right, for what refers to it: the name of env=gymnasium is its env.id
    right = [text for text in overrides if text != given]
    try:
        values = plain(compose(right))
    except COMPOSING_ERRORS as another:
        return explain(another, right, others, compose, options)
    inner = _quoted(r"full_key: (\S+)", str(error.__cause__))
    if inner is not None and inner.startswith(f"{key}."):
        section, _, name = inner.rpartition(".")
        head = f"{section}."
        inside = [path.removeprefix(head) for path in paths_of(values) if path.startswith(head)]
        meant = nearest(name, inside)
        advice = f"add +{inner}=…" if meant is None else f"did you mean '{meant}'?"
        return f"'{given}': '{section}' has no '{name}', {advice}"
    section = key.partition(".")[0]
    is_known = section in KEYS and section != "note"  # which is nobody's until it is added
    if section not in values and is_known:
        return f"'{given}': algo={values['algo']['name']} has no '{section}'."

    def values_with(choice: str) -> Mapping[str, Any]:
        try:
            return plain(compose([*right, choice]))
        except (*COMPOSING_ERRORS, SettingError):
            return {}

    choice = choice_with(key, options(section), values_with)
    if choice is not None:
        return f"'{given}': nothing reads '{key}' without {choice}."
    return _unread(given, key, values)


def _of_a_choice(
    words: str, choices: Sequence[str], compose: Callable[[list[str]], DictConfig]
) -> str:
    """Words on what is wrong, after the choice without which the others compose, if it is one."""

    def compose_without(choice: str | None) -> bool:
        try:
            compose([other for other in choices if other != choice])
        except COMPOSING_ERRORS:
            return False
        return True

    at_fault = None if compose_without(None) else next(filter(compose_without, choices), None)
    return words if at_fault is None else f"'{at_fault}': {words}"


def _in_file(file: str, words: str, options: Sequence[str] | None) -> str:
    """What is wrong with a file of configurations, named by its path in their folder."""
    choice = _quoted(r"Could not override '([^']+)'", words)
    if choice is not None:
        likely = _quoted(r"Did you mean to override (.+)\?$", words)
        advice = "to choose it there, write it without 'override'"
        return (
            f"{file}.yaml: 'override /{choice}' in its defaults, but nothing before chooses "
            f"'{choice}': {advice if likely is None else f'did you mean {likely!r}?'}"
        )
    missing = _quoted(r"Could not (?:find|load) '([^']+)'", words)
    if missing is not None:
        hint = did_you_mean(missing.rpartition("/")[2], options or ())
        return (
            f"{file}.yaml: there is no '{missing}', which its defaults name, or an override of "
            f"them in a file that builds on it.{hint}"
        )
    return f"{file}.yaml: {words}"


def _quoted(pattern: str, words: str) -> str | None:
    found = re.search(pattern, words)
    return None if found is None else found[1]


def _unread(given: str | None, key: str, values: Mapping[str, Any]) -> str:
    """That nothing reads a key, and the full paths of those that were meant."""
    algo = values.get("algo") or {}
    unread = _unread_by(algo)

    def reason(path: str) -> str | None:
        heads = [head for head in unread if f"{path}.".startswith(f"{head}.")]
        return unread[heads[0]] if heads else None

    optional = {path: f"+{path}" for path in optional_keys(values) if reason(path) is None}
    held = list(paths_of(values))
    refused = [path for path in held if reason(path) is not None]
    meant = keys_meant(key, [path for path in held if path not in refused], [*optional], refused)
    if meant and meant[0] in refused:
        why = reason(meant[0])
        return f"'{given}': algo={algo['name']} does not read '{meant[0]}'. {why}"
    read = [f"'{optional.get(path, path)}'" for path in meant]
    hint = f" Did you mean {' or '.join(read)}?" if read else ""
    return f"'{given}': nothing reads '{key}'.{hint}"
