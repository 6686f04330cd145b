"""The arguments of a function or class, read from its signature and its docstring."""

from __future__ import annotations

import inspect
import json
import re
from collections.abc import Callable, Iterator, Mapping
from functools import cache
from typing import Annotated, Any, NamedTuple

from safe_rl.checks import SettingError
from safe_rl.extras import require_extra
from safe_rl.ranges import NotNegative, Range, Values, Weight, is_described, values_of
from safe_rl.trust import locate


class Parameter(NamedTuple):
    """One argument of a function or class.

    Attributes:
        values: The values that it may have.
        meaning: Its description in the docstring, a sentence without its full stop.
        is_described: Whether its annotation describes a hyper-parameter, not only a type.
    """

    values: Values
    meaning: str
    is_described: bool = True

    def check(self, path: str, value: Any) -> None:
        """Refuse a value that the argument cannot have; ``path`` is the full key."""
        if not self.values.hold(value):
            meaning = f" ({self.meaning})" if self.meaning else ""
            raise SettingError(f"{path}={_shown(value)}: it must be {self.values.words}{meaning}.")


class Part(NamedTuple):
    """A class or function that a configuration names as ``_target_``.

    Attributes:
        rows: Its arguments by name; empty if its signature cannot be read.
        names: Names of all arguments; None if it takes any, or its signature cannot be read.
    """

    rows: Mapping[str, Parameter]
    names: list[str] | None

    @property
    def settings(self) -> dict[str, Parameter]:
        """Its hyper-parameters: all arguments but those that the program passes itself."""
        return {name: row for name, row in self.rows.items() if row.is_described}


# torch's own annotations have no ranges
_OF_OPTIMISERS: dict[str, tuple[Any, str]] = {
    "lr": (Annotated[float, Range(0, 1000, above=True)], "learning rate"),
    "betas": (tuple[Weight, Weight], "decay rates of the moments"),
    "eps": (NotNegative, "number added to denominators"),
    "weight_decay": (NotNegative, "decay of the weights"),
    "momentum": (Weight, "weight of past gradients"),
    "fused": (bool | None, "whether to step in one kernel"),
    "foreach": (bool | None, "whether to step all tensors together"),
    "amsgrad": (bool, "whether to keep the maximum of second moments"),
    "nesterov": (bool, "whether to use Nesterov momentum"),
}


def read_part(target: Any, path: str = "") -> Part:
    """Find the class or function that a node names as ``_target_``, and read its arguments.

    Args:
        target: The dotted name.
        path: Key of a node that is to be built; empty if the target is only to be read.

    Raises:
        TargetError: If the target may not be named, or does not exist.
        SettingError: If it is to be built and needs a package that is not installed.

    Examples:
        >>> part = read_part("safe_rl.objectives.ProjectedMultiplier")
        >>> list(part.settings), part.names
        (['init', 'lr', 'highest'], ['cost_limits', 'highest', 'init', 'lr'])
    """
    found = locate(target, f"{path}._target_" if path else "")
    if path and (needed := getattr(found, "needed_extra", None)):
        try:
            require_extra(*needed)
        except ModuleNotFoundError as error:
            raise SettingError(f"{path}: {error}") from None
    try:
        chain = constructors(found)
        # the package's constructors pass all of **kwargs on to a base; others may use them
        ours = all(function.__module__.startswith("safe_rl.") for function in chain)
        is_open = _takes_any(chain[-1] if ours else chain[0])
        return Part(parameters_of(found), None if is_open else sorted(accepted_names(found)))
    except (AttributeError, TypeError, ValueError):
        return Part({}, None)


def accepted_names(target: Callable[..., Any]) -> set[str]:
    """Names of the arguments that a function or a class takes.

    A constructor with ``**kwargs`` passes them on to its base, whose names count too.

    Examples:
        >>> class Base:
        ...     def __init__(self, actor_network, *, multiplier=None): ...
        >>> class Own(Base):
        ...     def __init__(self, *args, penalty, **kwargs): ...
        >>> sorted(accepted_names(Own))
        ['actor_network', 'multiplier', 'penalty']
    """
    return {name for name, *_ in _arguments(target)}


def required_names(target: Callable[..., Any]) -> set[str]:
    """Names of the arguments that a function or a class takes and that have no default."""
    own_last = reversed([*_arguments(target)])
    defaults = {name: parameter.default for name, parameter, _ in own_last}
    return {name for name, default in defaults.items() if default is inspect.Parameter.empty}


@cache
def parameters_of(target: Callable[..., Any]) -> Mapping[str, Parameter]:
    """Arguments of a function or class by name.

    As `accepted_names`, this follows ``**kwargs`` to the constructors of bases. An annotation that
    cannot be evaluated, such as a name imported for type checkers only, allows anything.
    """
    if target.__module__.startswith("torch.optim"):
        return {name: Parameter(values_of(k), text) for name, (k, text) in _OF_OPTIMISERS.items()}
    meanings = _meanings(target)
    found: dict[str, Parameter] = {}
    for name, parameter, names in _arguments(target):
        if name not in found:
            annotation = _evaluated(parameter.annotation, names)
            found[name] = Parameter(
                values_of(annotation), meanings.get(name, ""), is_described(annotation)
            )
    return found


def _arguments(target: Callable[..., Any]) -> Iterator[tuple[str, inspect.Parameter, Any]]:
    """Named arguments, the class's own first, each with the global names of its module."""
    for function in constructors(target):
        names = getattr(inspect.unwrap(function), "__globals__", {})
        for name, parameter in inspect.signature(function).parameters.items():
            if name != "self" and parameter.kind in (
                parameter.POSITIONAL_OR_KEYWORD,
                parameter.KEYWORD_ONLY,
            ):
                yield name, parameter, names


def constructors(target: Callable[..., Any]) -> list[Callable[..., Any]]:
    """A function, or a class's constructors as long as each passes ``**kwargs`` to the next."""
    functions = [target]
    if inspect.isclass(target):
        functions = [vars(base)["__init__"] for base in target.__mro__ if "__init__" in vars(base)]
    ends = (index for index, function in enumerate(functions, 1) if not _takes_any(function))
    return functions[: next(ends, len(functions))]


def _takes_any(function: Callable[..., Any]) -> bool:
    """Whether a function takes arguments that it does not name."""
    parameters = inspect.signature(function).parameters.values()
    return any(parameter.kind is parameter.VAR_KEYWORD for parameter in parameters)


def _evaluated(annotation: Any, names: dict[str, Any]) -> Any:
    """Evaluate an annotation that is a text, with the names of its module."""
    if annotation is inspect.Parameter.empty:
        return Any
    try:
        return eval(annotation, names) if isinstance(annotation, str) else annotation
    except (NameError, AttributeError, TypeError):
        return Any


def _meanings(target: Callable[..., Any]) -> dict[str, str]:
    """The first sentence about every argument, from a function, or a class and its bases."""
    meanings: dict[str, str] = {}
    for owner in getattr(target, "__mro__", (target,)):
        for names, text in _entries(owner.__doc__ or ""):
            for name in names.split(","):
                meanings.setdefault(name.strip(), _sentence(text))
    return meanings


def _entries(doc: str) -> list[tuple[str, str]]:
    """Names and texts in the sections ``Args`` and ``Attributes`` of a docstring."""
    lines = f"{inspect.cleandoc(doc)}\n"
    sections = re.findall(r"^(?:Args|Attributes):\n((?:(?: .*)?\n)*)", lines, re.M)
    return re.findall(r"^ {4}([\w, ]+): ((?:.*\n)(?: {5,}.*\n)*)", "".join(sections), re.M)


def _sentence(text: str) -> str:
    """The first sentence of a text, for a message: without capital, full stop and code marks."""
    plain = " ".join(text.replace("`", "").split())
    first = re.split(r"\.(?:\s|$)", plain, maxsplit=1)[0]
    return first[:1].lower() + first[1:] if first[1:2].islower() else first


def _shown(value: Any) -> str:
    """A value as a command line has it, cut if it is long."""
    is_word = value is None or isinstance(value, bool)
    shown = json.dumps(value) if is_word else " ".join(str(value).split())
    return shown if len(shown) <= 80 else f"{shown[:80]}…"
