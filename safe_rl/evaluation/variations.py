"""Variations of a run's environment: named changes of its keys, as training takes them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from safe_rl.evaluation.loading import check_env_keys

__all__ = ["Variation", "expand", "varied"]

TransformNode = Callable[[str], Mapping[str, Any]]
_FACTOR = "x"
_PARTS = ("env", "transforms")


class Variation(NamedTuple):
    """A change of an environment.

    Attributes:
        row: What is changed, a name.
        value: To what, where the row has several values; else None.
        keys: Full key of a run's configuration -> value.
    """

    row: str
    value: Any
    keys: Mapping[str, Any]

    def __str__(self) -> str:
        """The row and its value."""
        return self.row if self.value is None else f"{self.row} {self.value}"


def expand(rows: Mapping[str, Any]) -> list[Variation]:
    """Turn the rows of a set into variations, one for each value of a list.

    Args:
        rows: Name -> keys with their values; one of the keys of a row may have a list.

    Raises:
        ValueError: For what is no such row, or keys of something else than the environment.

    Examples:
        >>> [str(v) for v in expand({"mass": {"env.mass_scale": [0.5, 2.0]}})]
        ['mass 0.5', 'mass 2.0']
    """
    return [variation for row, keys in rows.items() for variation in _expand_row(str(row), keys)]


def _expand_row(row: str, keys: Any) -> Iterator[Variation]:
    if not isinstance(keys, Mapping) or not keys:
        raise ValueError(
            f"variations: '{row}' must have keys, as {{{row}: {{env.mass_scale: 1.5}}}}; got "
            f"{keys!r}."
        )
    for key in keys:
        parts = str(key).split(".")
        if parts[0] not in _PARTS or len(parts) < (3 if parts[0] == "transforms" else 2):
            raise ValueError(
                f"variations: '{row}' changes '{key}': it must be a key of the environment "
                "(env.mass_scale) or of a transform (transforms.sensor_noise.std)."
            )
    lists = [key for key, value in keys.items() if isinstance(value, list)]
    if len(lists) > 1:
        raise ValueError(f"variations: '{row}' has several lists: {', '.join(map(str, lists))}.")
    if not lists:
        yield Variation(row, None, dict(keys))
        return
    for value in keys[lists[0]]:
        yield Variation(row, value, {**keys, lists[0]: value})


def varied(
    config: DictConfig, variation: Variation, transform_node: TransformNode
) -> DictConfig | None:
    """A run's configuration with a variation of its environment.

    Args:
        config: Of the run.
        variation: What is changed. A text ``x1.5`` is 1.5 times the run's own value.
        transform_node: Name of a transform -> its node, for those that the run lacks.

    Returns:
        The configuration; None if its environment is that of the run: if that has these values
        itself, or none of the elements that they are about.

    Raises:
        ValueError: For a factor of what the environment lacks, or of no number; for a key that an
            environment of one's own does not have.

    Examples:
        >>> config = OmegaConf.create({"env": {"hazards_num": 8}})
        >>> varied(config, Variation("dense", None, {"env.hazards_num": "x1.5"}), dict).env
        {'hazards_num': 12}
    """
    values: Any = OmegaConf.to_container(config)
    transforms = dict(values.get("transforms") or {})
    before = {"env": values["env"], "transforms": transforms}
    changed = before
    for key, value in variation.keys.items():
        part, *path = key.split(".")
        if part == "env":
            check_env_keys(before[part], path[:1])
        if part == "transforms" and path[0] not in changed[part]:
            changed = _with(changed, [part, path[0]], dict(transform_node(path[0])))
        changed = _with(changed, [part, *path], _resolved(value, changed[part], key))
    is_same = _present(changed) == _present(before)
    return None if is_same else OmegaConf.create({**values, **changed})


def _present(parts: Mapping[str, Any]) -> dict[str, Any]:
    """Parts but for what a Safety Gym environment says of elements of which it has none."""
    env = parts["env"]
    absent = tuple(k.removesuffix("num") for k in env if k.endswith("_num") and env[k] == 0)
    if "_target_" in env:  # another family's
        absent = ()
    return {**parts, "env": {key: env[key] for key in env if not key.startswith(absent)}}


def _with(node: Mapping[str, Any], path: list[str], value: Any) -> dict[str, Any]:
    first, *others = path
    below = node.get(first)
    inner = _with(below if isinstance(below, Mapping) else {}, others, value) if others else value
    return {**node, first: inner}


def _resolved(value: Any, part: Mapping[str, Any], key: str) -> Any:
    """A value, of a factor the product with what the run has."""
    if not (isinstance(value, str) and value.startswith(_FACTOR)):
        return value
    own: Any = part
    for name in key.split(".")[1:]:
        own = own.get(name) if isinstance(own, Mapping) else None
    try:
        product = float(value.removeprefix(_FACTOR)) * own
    except (TypeError, ValueError):
        raise ValueError(f"{key}={value}: this environment has no number '{key}'.") from None
    return round(product) if isinstance(own, int) else product
