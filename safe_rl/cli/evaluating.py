"""Carry out what ``python -m safe_rl.evaluate`` is asked for: evaluate, certify, vary."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import yaml

from safe_rl.cli.certificates import certify_run
from safe_rl.cli.grammar import CommandLineError
from safe_rl.cli.report import suite
from safe_rl.cli.run_folders import maker_of
from safe_rl.cli.session import SETTING_ERRORS
from safe_rl.cli.user_code import check_imports, import_modules
from safe_rl.envs import LayoutError, OpenGLError
from safe_rl.evaluation import Evaluation, EvaluationOptions, evaluate
from safe_rl.evaluation.loading import load_config
from safe_rl.evaluation.measuring import format_unjudged
from safe_rl.evaluation.policies import find_run, writable_copy
from safe_rl.evaluation.variations import Variation, Varied, evaluate_variations, expand
from safe_rl.files import CONF
from safe_rl.naming import did_you_mean
from safe_rl.reporting.figures import draw_variations
from safe_rl.runs.folder import RunFolder

__all__ = ["carry_out", "evaluate_run", "evaluate_varied", "read_variations"]

_SETS = CONF / "variations"
_ERRORS: tuple[type[Exception], ...] = (*SETTING_ERRORS, LayoutError, OpenGLError)


def evaluate_run(
    directory: Path, options: EvaluationOptions, *, progress: bool = False
) -> Evaluation:
    """:func:`safe_rl.evaluation.evaluate` with this package's environments and benchmark.

    Raises:
        ValueError: If the options ask for something else than an evaluation.
    """
    directory = writable_copy(directory)
    if options.certify or options.variations is not None:
        raise ValueError("evaluate: certificates are made by certify(), variations by vary(…).")
    return evaluate(
        directory, options, make_env=maker_of(directory), suite=suite(), progress=progress
    )


def carry_out(
    directory: str | Path, options: EvaluationOptions, modules: Sequence[str] | None = None
) -> int:
    """Evaluate, certify or vary a run, and print what was found.

    Args:
        directory: Folder of the run.
        options: What to do.
        modules: The user's modules to import; None if ``import=`` was not given.

    Returns:
        Exit status of the command.
    """
    try:
        directory = find_run(directory)
        check_imports(load_config(directory), modules, directory)
        import_modules(modules or ())
        if options.certify:
            return _certify(directory, options)
        if options.variations is not None:
            found, picture = evaluate_varied(directory, options, progress=True)
            print(_table_of(found), f"wrote {found.file}", f"wrote {picture}", sep="\n")
        else:
            print(evaluate_run(directory, options, progress=True))
    except _ERRORS as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _certify(directory: Path, options: EvaluationOptions) -> int:
    """Certify a run's own problem, to which other options would make no difference."""
    own, plain = ("certify", "certificate", "num_threads"), EvaluationOptions()
    for name in (field.name for field in fields(options) if field.name not in own):
        if getattr(options, name) != getattr(plain, name):
            raise CommandLineError(
                f"{name}: it is ignored by certify=true. A certificate is of the run's own "
                "environment, and takes certificate.episodes=… and the like, and num_threads=…"
            )
    certificate = certify_run(
        directory, num_threads=options.num_threads, changes=options.certificate
    )
    print(certificate or "Nothing to certify: the run has no limits, or no checkpoints.")
    return 0 if certificate is not None and certificate.checkpoint is not None else 1


def evaluate_varied(
    directory: Path, options: EvaluationOptions, *, progress: bool = False
) -> tuple[Varied, Path]:
    """Run a policy under ``options.variations``, and write the table and the picture.

    Args:
        directory: Folder of the run.
        options: Of the evaluation.
        progress: Whether to say what is next.

    Returns:
        What was found, and the picture.

    Raises:
        ValueError: For variations that there are not, or that the environment cannot have.
    """
    directory = writable_copy(directory)
    named, own = read_variations(options.variations)
    found = evaluate_variations(
        directory,
        options,
        [*named, *own],
        make_env=maker_of(directory),
        transform_node=_transform_node,
        refusals=(LayoutError,),
        may_lack=lambda variation: variation in named,
        progress=progress,
    )
    picture = RunFolder(directory).variations(options.name, "png")
    draw_variations(found.rows, found.cost_limits, picture)
    return found, picture


def read_variations(given: Any) -> tuple[list[Variation], list[Variation]]:
    """Variations that ``variations=…`` asks for.

    Args:
        given: Name of a set in ``conf/variations``, path of a YAML of that form, keys by name, or
            a list of all these.

    Returns:
        Those of sets, of which environments may lack some, and one's own.

    Raises:
        ValueError: For a name that there is not, or what is no set.

    Examples:
        >>> named, own = read_variations(["sensing", {"heavy": {"env.mass_scale": 2.0}}])
        >>> len(named), [str(variation) for variation in own]
        (8, ['heavy'])
    """
    named: list[Variation] = []
    own: list[Variation] = []
    for part in given if isinstance(given, list) else [given]:
        if isinstance(part, Mapping):
            own += expand(part)
        elif str(part) in _names():
            named += expand(_read(_SETS / f"{part}.yaml"))
        elif str(part).endswith((".yaml", ".yml")):
            own += expand(_read(Path(str(part)).expanduser()))
        else:
            raise ValueError(
                f"variations={part}: there is no such set.{did_you_mean(str(part), _names())} Sets "
                f"are {', '.join(_names())}; a file ends in .yaml; one of your own is "
                "variations='{heavy: {env.mass_scale: 1.5}}'."
            )
    return named, own


def _table_of(found: Varied) -> str:
    """Return and costs under every variation, for the terminal."""
    keys = list(found.cost_limits) or ["cost"]
    heads = ["", "return", *keys, *(f"over {d:g}" for d in found.cost_limits.values())]
    names = ["episode_return", *(f"episode_{key}" for key in keys)]
    names += [f"over_limit_{key}" for key in found.cost_limits]
    lines = [[str(v), *(str(e.get(name, "—")) for name in names)] for v, e in found.rows]
    widths = [max(map(len, column)) for column in zip(heads, *lines, strict=True)]
    facts = found.facts
    steps = "" if facts["steps"] is None else f" at {facts['steps']:,} steps"
    text = [
        f"{facts['algorithm']} on {facts['environment']}{steps}: {facts['episodes']} episodes "
        "each, means with 95 % intervals"
    ]
    text += [
        "  ".join(cell.ljust(width) for cell, width in zip(line, widths, strict=True)).rstrip()
        for line in (heads, *lines)
    ]
    text += format_unjudged(facts["limits_without_cost"])
    reasons: dict[str, list[str]] = {}
    for variation, reason in found.left_out:
        reasons.setdefault(reason, []).append(str(variation))
    text += [f"left out: {', '.join(which)}: {reason}" for reason, which in reasons.items()]
    return "\n".join(text)


def _names() -> list[str]:
    return sorted(path.stem for path in _SETS.glob("*.yaml"))


def _read(path: Path) -> Mapping[str, Any]:
    try:
        content = yaml.safe_load(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise ValueError(f"variations={path}: {error.strerror}.") from error
    except yaml.YAMLError as error:
        raise ValueError(f"variations={path}: {' '.join(str(error).split())}") from error
    if not isinstance(content, Mapping):
        raise ValueError(f"variations={path}: it must have rows, as conf/variations has them.")
    return content


def _transform_node(name: str) -> Mapping[str, Any]:
    """A transform as ``transforms=[name]`` has it."""
    path = CONF / "transforms" / f"{name}.yaml"
    known = sorted(path.stem for path in path.parent.glob("*.yaml"))
    if name not in known:
        raise ValueError(
            f"variations: there is no transform '{name}'.{did_you_mean(name, known)} There are "
            f"{', '.join(known)}."
        )
    return _read(path)[name]
