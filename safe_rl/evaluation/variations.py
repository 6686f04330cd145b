"""Evaluation of a policy in variations of its environment, which are named changes of its keys."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf
from torchrl.envs import EnvBase

from safe_rl.evaluation.loading import check_env_keys, maker_of, override_env
from safe_rl.evaluation.measuring import (
    PolicyEvaluation,
    check_places,
    format_limits_without_cost,
    summarise,
)
from safe_rl.evaluation.policies import writable_copy
from safe_rl.evaluation.settings import EvaluationOptions, check_options
from safe_rl.files import CONF, read_yaml, replace_csv
from safe_rl.naming import did_you_mean
from safe_rl.runs.checkpoints import hold
from safe_rl.runs.run import Run
from safe_rl.scores.comparisons import Estimate

_FACTOR = "x"
_SETS = Path(__file__).with_suffix(".yaml")


class Variation(NamedTuple):
    """A change of an environment.

    Attributes:
        row: Name of the row in the set of variations.
        value: Value of the changed key, if the row has a list of values; else None.
        keys: Full key of a run's configuration -> value.
        may_lack: Whether it is left out, without an error, if the environment cannot have it.
    """

    row: str
    value: Any
    keys: Mapping[str, Any]
    may_lack: bool = False

    def __str__(self) -> str:
        """The row and its value."""
        return self.row if self.value is None else f"{self.row} {self.value}"


def read_variations(given: Any) -> list[Variation]:
    """Variations that ``variations=…`` asks for, one for each value of a row's list.

    Args:
        given: Name of a set in ``variations.yaml`` (variations that the environment cannot
            have are left out), path of a YAML file with rows, a mapping from row to keys, or a list
            of these.

    Raises:
        ValueError: If a set or file does not exist, has no rows, or has a key that is none of the
            environment or of a transform.

    Examples:
        >>> [str(v) for v in read_variations({"mass": {"env.mass_scale": [0.5, 2.0]}})]
        ['mass 0.5', 'mass 2.0']
        >>> len(read_variations(["sensing", {"heavy": {"env.mass_scale": 2.0}}]))
        9
    """
    variations: list[Variation] = []
    if given == []:
        raise ValueError("variations=[]: it must name at least one set, file or row.")
    for part in given if isinstance(given, list) else [given]:
        is_set = isinstance(part, str) and not part.endswith((".yaml", ".yml"))
        rows = _set_of(part) if is_set else part
        if not isinstance(rows, Mapping):
            try:
                rows = read_yaml(Path(part).expanduser())
            except (OSError, ValueError) as error:
                raise ValueError(f"variations={part}: {error}") from error
        if not isinstance(rows, Mapping) or not rows:
            raise ValueError(f"variations={part}: it must have rows, as {_SETS} has.")
        variations += [
            v._replace(may_lack=is_set) for name in rows for v in _expand(str(name), rows[name])
        ]
    return variations


def _set_of(name: str) -> Mapping[str, Any]:
    """A set of the package's configuration."""
    sets = read_yaml(_SETS)
    if name not in sets:
        raise ValueError(
            f"variations: there is no '{name}'.{did_you_mean(name, sets)} There are "
            f"{', '.join(sets)}; a file of yours ends in .yaml; keys are given as "
            "variations='{heavy: {env.mass_scale: 1.5}}'."
        )
    return sets[name]


def _transform(name: str) -> Any:
    """The settings of a transform in the package's configuration."""
    files = {path.stem: path for path in (CONF / "transforms").glob("*.yaml")}
    if name not in files:
        raise ValueError(
            f"variations: there is no '{name}' among transforms.{did_you_mean(name, sorted(files))}"
        )
    return read_yaml(files[name])[name]


def _expand(row: str, keys: Any) -> Iterator[Variation]:
    parts = [str(key).split(".") for key in keys] if isinstance(keys, Mapping) else []
    lists = [key for key in keys if isinstance(keys[key], list)] if parts else []
    least = {"env": 2, "transforms": 3}
    if not parts or len(lists) > 1 or any(len(p) < least.get(p[0], 99) for p in parts):
        raise ValueError(
            f"variations: '{row}: {keys}' must have keys of the environment (env.mass_scale) or of "
            "a transform (transforms.sensor_noise.std), one of them with a list at most."
        )
    if not lists:
        yield Variation(row, None, dict(keys))
    for value in keys[lists[0]] if lists else ():
        yield Variation(row, value, {**keys, lists[0]: value})


def varied(config: DictConfig, variation: Variation) -> DictConfig | None:
    """A run's configuration with a variation of its environment; None if nothing would change.

    Nothing changes if the environment has these values already, or none of the elements that they
    describe. A text ``x1.5`` is 1.5 times the run's own value. Other transforms are from ``conf/``.

    Raises:
        ValueError: If a factor is given for a key that is missing or no number, or if a custom
            environment does not have a key.

    Examples:
        >>> config = OmegaConf.create({"env": {"hazards_num": 8}})
        >>> varied(config, Variation("dense", None, {"env.hazards_num": "x1.5"})).env
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
            changed.transforms[name] = _transform(name)
        if isinstance(value, str) and value.startswith(_FACTOR):
            trained_value = OmegaConf.select(changed, key)
            if not isinstance(trained_value, int | float):
                raise ValueError(f"{key}={value}: this environment has no number '{key}'.")
            product = float(value.removeprefix(_FACTOR)) * trained_value
            value = round(product) if isinstance(trained_value, int) else product
        OmegaConf.update(changed, key, value, merge=False, force_add=True)
    is_same = _present(OmegaConf.to_container(changed)) == _present(before)
    return None if is_same else changed


def _present(config: Any) -> dict[str, Any]:
    """A configuration without the keys of Safety Gym's elements of which the environment has 0."""
    env = config["env"]
    absent = tuple(k.removesuffix("num") for k in env if k.endswith("_num") and env[k] == 0)
    if "_target_" in env:  # an environment of another family, without such elements
        absent = ()
    return {**config, "env": {key: env[key] for key in env if not key.startswith(absent)}}


AS_TRAINED = Variation("as trained", None, {})


class VariedRow(NamedTuple):
    """Estimates under a variation.

    Attributes:
        variation: The variation; `AS_TRAINED` if nothing was changed.
        estimates: Name -> estimate, see `safe_rl.evaluation.summarise`.
    """

    variation: Variation
    estimates: Mapping[str, Estimate]


@dataclass(frozen=True)
class Varied:
    """The result of an evaluation under variations.

    Attributes:
        rows: First the run's own environment, then every variation.
        left_out: Variations that this environment cannot have, and why.
        facts: What was evaluated in the run's own environment, and how.
        file: The table.
    """

    rows: tuple[VariedRow, ...]
    left_out: tuple[tuple[Variation, str], ...]
    facts: Mapping[str, Any]
    file: Path

    @property
    def cost_limits(self) -> dict[str, float]:
        """Cost key -> d, for the run's own environment."""
        return dict(self.facts["cost_limits"])

    def __str__(self) -> str:
        """Return and costs under every variation, as the command prints them."""
        keys = list(self.cost_limits) or ["cost"]
        heads = ["", "return", *keys, *(f"{k} over {d:g}" for k, d in self.cost_limits.items())]
        names = ["episode_return", *(f"episode_{key}" for key in keys)]
        names += [f"over_limit_{key}" for key in self.cost_limits]
        lines = [heads, *([str(v), *(str(e.get(n, "—")) for n in names)] for v, e in self.rows)]
        widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
        facts = self.facts
        steps = "" if facts["steps"] is None else f" at {facts['steps']:,} steps"
        text = [
            f"{facts['algorithm']} on {facts['environment']}{steps}: {facts['episodes']} episodes "
            "each, means with 95 % intervals"
        ]
        for line in lines:
            cells = (cell.ljust(width) for cell, width in zip(line, widths, strict=True))
            text.append("  ".join(cells).rstrip())
        text += format_limits_without_cost(facts["limits_without_cost"])
        reasons: dict[str, list[str]] = {}
        for variation, reason in self.left_out:
            reasons.setdefault(reason, []).append(str(variation))
        text += [f"left out: {', '.join(which)}: {reason}" for reason, which in reasons.items()]
        return "\n".join(text)


def evaluate_variations(
    directory: Path,
    options: EvaluationOptions,
    *,
    make_env: Callable[..., EnvBase] | None = None,
    progress: bool = False,
) -> Varied:
    """Run a trained policy in its own environment and under ``options.variations``.

    All environments have the same seed, so that differences between them are less due to chance.
    Arguments and errors are those of `safe_rl.evaluation.evaluate`; ``options.env`` changes
    all environments.
    """
    check_options(options)
    variations, directory = read_variations(options.variations), writable_copy(directory)
    run, make_env = Run(directory), make_env or maker_of(directory)
    config = run.config
    config.env = override_env(config, options.env)
    checkpoint = hold(run.find_checkpoint(options.checkpoint))
    file, picture = (
        run.evaluation_file(options.name, kind, "variations") for kind in ("csv", "png")
    )
    check_places(directory, [file, picture])
    for variation in variations:  # wrong keys and layouts are found before the first episode
        if not variation.may_lack and (changed := varied(config, variation)) is not None:
            env = PolicyEvaluation(changed, checkpoint, options, make_env).make(num_envs=1)
            env.reset()
            env.close()
    rows: list[VariedRow] = []
    left_out: list[tuple[Variation, str]] = []
    facts: dict[str, Any] = {}
    for variation in (AS_TRAINED, *variations):
        try:
            changed = varied(config, variation) if variation.keys else config
            if changed is None:
                left_out.append((variation, "it would be as it was trained"))
                continue
            if progress:
                print(f"… {variation}", flush=True)
            evaluation = PolicyEvaluation(changed, checkpoint, options, make_env)
            episodes, row_facts = evaluation.run()
        except ValueError as error:
            if not variation.may_lack:
                raise
            left_out.append((variation, str(error)))
            continue
        facts = facts or row_facts
        estimates = summarise(episodes, row_facts["cost_limits"], options.cvar_alpha)
        rows.append(VariedRow(variation, estimates))
    _write(file, rows)
    return Varied(tuple(rows), tuple(left_out), facts, file)


def _write(path: Path, rows: Sequence[VariedRow]) -> None:
    """Write a row per variation: the changed keys, and every estimate with its interval.

    Fields are empty if the varied environment does not have a cost that another one has.
    """
    names = list(dict.fromkeys(name for row in rows for name in row.estimates))
    columns = [f"{name}{end}" for name in names for end in ("", "_low", "_high")]
    table: list[list[Any]] = [["variation", "row", "value", "keys", *columns]]
    for variation, estimates in rows:
        changes = " ".join(f"{key}={changed}" for key, changed in variation.keys.items())
        numbers = [number for name in names for number in estimates.get(name, ("", "", ""))]
        # a value of None becomes an empty field
        table.append([str(variation), variation.row, variation.value, changes, *numbers])
    replace_csv(path, table)
