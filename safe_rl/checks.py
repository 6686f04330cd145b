"""Checks of settings by pydantic: types with ranges, and constructors that refuse other values.

A constructor annotates its settings with the types of ``pydantic`` and ``annotated_types``, such as
``lr: PositiveFloat`` or ``size: Annotated[int, Interval(ge=1, le=100)]``. Other arguments, such as
networks and tensors, are not checked.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable, Mapping
from dataclasses import field
from functools import cache, wraps
from inspect import Parameter, Signature, isclass, signature
from typing import Annotated, Any, Literal, TypeVar, get_args, get_origin, get_type_hints

from annotated_types import Interval
from omegaconf import OmegaConf
from pydantic import AfterValidator, ConfigDict, TypeAdapter, ValidationError

Function = TypeVar("Function", bound=Callable[..., Any])
UNEXPECTED = "This happened during training. If you have parts of your own, look there first."
"""Note of an error whose traceback users have to see."""
_PLAIN = (int, float, str, list, tuple, Mapping, type(None))  # not networks, tensors, ...


class SettingError(ValueError):
    """A setting that cannot be used; the message is one line and begins with its name."""


def is_number(value: Any) -> bool:
    """Whether a value is a number that a float can hold, and finite; True and False are not."""
    is_real = isinstance(value, int | float) and not isinstance(value, bool)
    return is_real and abs(value) <= sys.float_info.max


def rule(holds: Callable[[Any], bool], words: str) -> AfterValidator:
    """Metadata of `Annotated`: values for which `holds` is true; `words` follow "it must be"."""

    def validate(value: Any) -> Any:
        if not holds(value):
            raise ValueError(f"it must be {words}")
        return value

    return AfterValidator(validate)


Share = Annotated[float, Interval(ge=0, le=1)]
Fraction = Annotated[float, Interval(gt=0, le=1)]
"""A share above 0."""
Weight = Annotated[float, Interval(ge=0, lt=1)]
"""A share below 1, such as the weight of the past in a moving average."""
Text = Annotated[
    str, rule(lambda text: bool(text.strip()) and text.isprintable(), "a text of one line")
]


def is_device(value: Any) -> bool:
    """Whether torch finds this device here."""
    import torch  # here, because help and configurations are shown without it

    try:
        device = torch.device(value)
    except (RuntimeError, TypeError):
        return False
    here = {"cpu": 1, "cuda": torch.cuda.device_count()}
    return (device.index or 0) < here.get(device.type, 0)


Device = Annotated[
    str, rule(is_device, "cpu; or cuda or cuda:<number>, if torch finds this GPU here")
]


def option(default: Any, help: str) -> Any:
    """A field of a command's options; `default` may be a function that makes the default."""
    kind = "default_factory" if callable(default) else "default"
    return field(metadata={"help": help}, **{kind: default})


def check_value(name: str, annotation: Any, value: Any) -> Any:
    """Return a value if an annotation, or the `adapter` of one, allows it.

    A boolean is no number, a text is no number, and numbers are finite. Where whole numbers are
    meant, 3e5, which YAML reads as a float, is returned as one.

    Raises:
        SettingError: If the annotation does not allow it.

    Examples:
        >>> check_value("gamma", Share, 1.0)
        1.0
        >>> check_value("gamma", Share, 2)
        Traceback (most recent call last):
        ...
        safe_rl.checks.SettingError: gamma=2: it must be less than or equal to 1.
    """
    check = annotation if isinstance(annotation, TypeAdapter) else adapter(annotation)
    try:
        check.validate_python(value)
    except ValidationError as error:
        if isinstance(value, float) and value.is_integer():
            return check_value(name, check, int(value))
        raise SettingError(f"{name}={_shown(value)}: {_words(error)}.") from None
    return value


class CheckedOptions:
    """Base of dataclasses whose fields are checked, by their annotations, when one is made."""

    def __post_init__(self) -> None:
        for name, kind in get_type_hints(type(self), include_extras=True).items():
            setattr(self, name, check_value(name, kind, getattr(self, name)))


def adapter(annotation: Any) -> TypeAdapter[Any]:
    """Pydantic's check of a type, as strict as `check_value` describes."""
    config = ConfigDict(strict=True, allow_inf_nan=False, arbitrary_types_allowed=True)
    return TypeAdapter(annotation, config=config)


def _shown(value: Any) -> str:
    """A value as a command line has it, cut if it is long."""
    is_word = value is None or isinstance(value, bool)
    shown = json.dumps(value) if is_word else " ".join(str(value).split())
    if isinstance(value, str) and shown.replace(".", "", 1).isdigit():
        shown = repr(shown)  # a text is refused that looks like a number
    return shown if len(shown) <= 80 else f"{shown[:80]}…"


def _words(error: ValidationError) -> str:
    messages = [fault["msg"].removeprefix("Value error, ") for fault in error.errors()]
    # a union has a message for each of its types
    words = ", or ".join(dict.fromkeys(messages)).replace("Input should be", "it must be")
    words = words.replace("Field required", "an entry is missing")
    words = words.replace("a valid dictionary", "a dictionary, such as '{key: value}'")
    return words.replace(", or it must be", ", or")


def is_setting(annotation: Any) -> bool:
    """Whether an annotation is that of a setting: it has a range or choices, or is bool.

    Examples:
        >>> is_setting(Share | None), is_setting(bool), is_setting(float)
        (True, True, False)
    """
    if annotation is bool or get_origin(annotation) in (Annotated, Literal):
        return True
    return any(map(is_setting, get_args(annotation)))


def parameters_of(target: Callable[..., Any]) -> dict[str, Parameter]:
    """Named parameters of a function or of a class, whose own come first.

    A constructor with ``**kwargs`` passes them on to its base, whose parameters count too.

    Examples:
        >>> class Base:
        ...     def __init__(self, actor_network, *, multiplier=None): ...
        >>> class Derived(Base):
        ...     def __init__(self, *args, penalty: Share, **kwargs): ...
        >>> list(parameters_of(Derived))
        ['penalty', 'actor_network', 'multiplier']
    """
    functions = [target]
    if isclass(target):
        functions = [vars(base)["__init__"] for base in target.__mro__ if "__init__" in vars(base)]
    known: dict[str, Parameter] = {}
    for function in functions:
        parameters = _signature(function).parameters
        for name, parameter in parameters.items():
            if name != "self" and parameter.kind in (
                Parameter.POSITIONAL_OR_KEYWORD,
                Parameter.KEYWORD_ONLY,
            ):
                known.setdefault(name, parameter)
        if all(parameter.kind is not Parameter.VAR_KEYWORD for parameter in parameters.values()):
            break
    return known


def _signature(function: Callable[..., Any]) -> Signature:
    """A signature with evaluated annotations; as it is, if they have a name for type checkers."""
    try:
        return signature(function, eval_str=True)
    except NameError:
        return signature(function)


def checked(function: Function) -> Function:
    """Let a function, or a class, refuse settings that its annotations do not allow.

    Examples:
        >>> @checked
        ... def discounted(cost: float, *, gamma: Share): ...
        >>> discounted(3.0, gamma=True)
        Traceback (most recent call last):
        ...
        safe_rl.checks.SettingError: gamma=true: it must be a valid number.
    """
    if isclass(function):
        function.__init__ = checked(function.__init__)  # type: ignore[method-assign]
        return function

    @cache
    def checks() -> dict[str, TypeAdapter[Any]]:
        parameters = _signature(function).parameters.values()
        return {p.name: adapter(p.annotation) for p in parameters if is_setting(p.annotation)}

    @wraps(function)
    def checking(*args: Any, **kwargs: Any) -> Any:
        given = dict(zip(signature(function).parameters, args, strict=False)) | kwargs
        for name, check in checks().items():
            value = given.get(name, ...)
            # a list of a configuration, as Hydra passes it, is no list for pydantic
            plain = OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
            # 3e5 is passed on as 300000, but a list of a configuration as it is
            if isinstance(plain, _PLAIN):
                checked_value = check_value(name, check, plain)
                kwargs |= {name: checked_value} if name in kwargs and plain is value else {}
        return function(*args, **kwargs)

    return checking  # type: ignore[return-value]


class Checked:
    """Base of classes whose constructors, and those of derived classes, are `checked`."""

    def __init_subclass__(cls, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        if "__init__" in vars(cls):
            checked(cls)
