"""Variations of a run's environment: named changes of its keys, and a policy evaluated in each."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from torchrl.envs import EnvBase

from safe_rl.evaluation.loading import (
    check_env_keys,
    find_checkpoint,
    load_config,
    override_env,
    without_cost,
)
from safe_rl.evaluation.measuring import Trial, check_places, summarise
from safe_rl.evaluation.settings import EvaluationOptions, check_options
from safe_rl.files import replace_csv
from safe_rl.runs.folder import RunFolder, checkpoint_steps
from safe_rl.scores.comparisons import Estimate

__all__ = [
    *("AS_TRAINED", "Varied", "VariedRow", "Variation", "evaluate_variations", "expand", "varied"),
]

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
    """Turn the rows of a set, keys with values, into variations, one for each value of a list.

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
    """A run's configuration with a variation of its environment; None if it would be as it is.

    It is if that has these values itself, or none of the elements that they are about. A text
    ``x1.5`` is 1.5 times the run's own value; ``transform_node`` has the nodes of transforms that
    the run lacks.

    Raises:
        ValueError: For a factor of what the environment lacks, or of no number; for a key that an
            environment of one's own does not have.

    Examples:
        >>> config = OmegaConf.create({"env": {"hazards_num": 8}})
        >>> varied(config, Variation("dense", None, {"env.hazards_num": "x1.5"}), dict).env
        {'hazards_num': 12}
    """
    before: Any = OmegaConf.to_container(config)
    before["transforms"] = before.get("transforms") or {}
    changed = OmegaConf.create(before)
    for key, value in variation.keys.items():
        part, name, *_ = key.split(".")
        if part == "env":
            check_env_keys(changed.env, [name])
        elif name not in changed.transforms:
            changed.transforms[name] = dict(transform_node(name))
        value = _resolved(value, OmegaConf.select(changed, key), key)
        OmegaConf.update(changed, key, value, merge=False, force_add=True)
    is_same = _present(OmegaConf.to_container(changed)) == _present(before)
    return None if is_same else changed


def _present(config: Any) -> dict[str, Any]:
    """A configuration but for what a Safety Gym environment says of elements that it has not."""
    env = config["env"]
    absent = tuple(k.removesuffix("num") for k in env if k.endswith("_num") and env[k] == 0)
    if "_target_" in env:  # another family's
        absent = ()
    return {**config, "env": {key: env[key] for key in env if not key.startswith(absent)}}


def _resolved(value: Any, own: Any, key: str) -> Any:
    """A value, of a factor the product with what the run has."""
    if not (isinstance(value, str) and value.startswith(_FACTOR)):
        return value
    try:
        product = float(value.removeprefix(_FACTOR)) * own
    except (TypeError, ValueError):
        raise ValueError(f"{key}={value}: this environment has no number '{key}'.") from None
    return round(product) if isinstance(own, int) else product


AS_TRAINED = Variation("as trained", None, {})


class VariedRow(NamedTuple):
    """What was found under a variation.

    Attributes:
        variation: What was changed; `AS_TRAINED` for nothing.
        estimates: As :func:`safe_rl.evaluation.summarise` returns them.
    """

    variation: Variation
    estimates: Mapping[str, Estimate]


@dataclass(frozen=True)
class Varied:
    """What an evaluation under variations found.

    Attributes:
        rows: First the environment as trained on, then every variation.
        left_out: Variations that this environment cannot have, and why.
        cost_limits: Cost key -> d, of the environment as trained on.
        facts: Of what, for the terminal.
        file: The table.
    """

    rows: tuple[VariedRow, ...]
    left_out: tuple[tuple[Variation, str], ...]
    cost_limits: Mapping[str, float]
    facts: Mapping[str, Any]
    file: Path


def evaluate_variations(
    directory: Path,
    options: EvaluationOptions,
    variations: Sequence[Variation],
    *,
    make_env: Callable[..., EnvBase],
    transform_node: TransformNode,
    refusals: tuple[type[Exception], ...],
    may_lack: Callable[[Variation], bool],
    progress: bool = False,
) -> Varied:
    """Run a trained policy in its own environment and in variations of it.

    All of them draw from the same seed, so that what differs between them is not luck.

    Args:
        directory: Folder of a run.
        options: As for an evaluation; ``env`` changes every one of the environments.
        variations: What is changed.
        make_env: ``make_env(node, num_envs=, device=, seed=, num_threads=)``.
        transform_node: Name of a transform -> its node, for those that the run lacks.
        refusals: What an environment raises that cannot have a variation, beside ValueError.
        may_lack: Whether a variation is left out where the environment cannot have it.
        progress: Whether to say what is next.

    Raises:
        FileNotFoundError: If the folder is not a run's, or has no such checkpoint.
        OSError: If what it finds cannot be written, which is seen before any episode.
        CheckpointError: If the policy does not fit a varied environment.
        ValueError: If an environment cannot have a variation that was asked for by itself.
    """
    check_options(options)
    config = load_config(directory)
    config.env = override_env(config, options.env)
    checkpoint = find_checkpoint(directory, options.checkpoint)
    file = RunFolder(directory).variations(options.name, "csv")
    check_places([file, RunFolder(directory).variations(options.name, "png")])
    rows: list[VariedRow] = []
    left_out: list[tuple[Variation, str]] = []
    facts = {"algorithm": config.algo.name, "environment": config.env.get("name", "")}
    facts |= {"steps": checkpoint_steps(checkpoint), "episodes": options.episodes}
    cannot: tuple[type[Exception], ...] = (ValueError, *refusals)
    for variation in (AS_TRAINED, *variations):
        try:
            changed = varied(config, variation, transform_node) if variation.keys else config
            if changed is None:
                left_out.append((variation, "it would be as it was trained"))
                continue
            if progress:
                print(f"… {variation}", flush=True)
            _, episodes, limits = Trial(changed, checkpoint, options, make_env).run()
        except cannot as error:
            if variation is AS_TRAINED or not may_lack(variation):
                raise
            left_out.append((variation, str(error)))
            continue
        if not rows:
            own_limits = limits
            facts["limits_without_cost"] = without_cost(config, episodes.costs)
        rows.append(VariedRow(variation, summarise(episodes, limits, None, options.cvar_alpha)))
    _write(file, rows)
    return Varied(tuple(rows), tuple(left_out), own_limits, facts, file)


def _write(path: Path, rows: Sequence[VariedRow]) -> None:
    """A row per variation: what was changed to what, and every estimate with its interval.

    Nothing stands where a variation does not have the cost of another one.
    """
    names = list(dict.fromkeys(name for row in rows for name in row.estimates))
    columns = [f"{name}{end}" for name in names for end in ("", "_low", "_high")]
    table: list[list[Any]] = [["variation", "row", "value", "keys", *columns]]
    for variation, estimates in rows:
        row, value, keys = variation
        changes = " ".join(f"{key}={changed}" for key, changed in keys.items())
        found = [number for name in names for number in estimates.get(name, ("", "", ""))]
        table.append([str(variation), row, "" if value is None else value, changes, *found])
    replace_csv(path, table)
