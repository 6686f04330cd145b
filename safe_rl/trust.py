"""What configurations may build: from a ``_target_`` to an object, the only place that does it.

A configuration may come with a run of another person. It can therefore name only what runs are
built of: parts of this package, torch's optimisers, and what modules define that the user has
named by ``import=``. A configuration lists these modules, but they are imported only if the command
names them: opening another person's run does not run their code.
"""

from __future__ import annotations

import inspect
import re
import sys
import traceback
from collections.abc import Callable, Mapping, Sequence
from importlib import import_module
from pathlib import Path
from pkgutil import resolve_name
from shlex import join, quote
from typing import Any, cast

import hydra.utils
from hydra.errors import InstantiationException
from omegaconf import DictConfig, ListConfig, OmegaConf

from safe_rl.checks import SettingError, parameters_of
from safe_rl.naming import did_you_mean, join_keys

# Packages and modules with parts of a run, and those of the user. Names are listed where other
# classes and functions start programs, import modules, or write and remove files; None: all may be
# named.
_ROOMS: dict[str, tuple[str, ...] | None] = {
    "safe_rl.algorithms": None,
    "safe_rl.collectors": ("make_process_collector", "make_ray_collector"),
    "safe_rl.envs.gymnasium": ("make_gymnasium", "make_safety_gymnasium"),
    "safe_rl.envs.torchrl": ("make_torchrl",),
    "safe_rl.envs.transforms": None,
    "safe_rl.envs.velocity": ("VelocityEnv",),
    "safe_rl.models": None,
    "safe_rl.objectives": None,
    "safe_rl.runs.loggers": ("MLflowLogger", "TensorboardLogger", "WandbLogger"),
    "torch.optim": None,
    "torchrl.envs.transforms": ("RewardScaling",),
}


_PACKAGED = frozenset(_ROOMS)


class TargetError(SettingError):
    """A ``_target_`` that a configuration may not name, or that does not exist."""


def allow(module: str) -> None:
    """Let configurations name what a module, or package, of the user's defines.

    Examples:
        >>> allow("fractions")
        >>> instantiate({"_target_": "fractions.Fraction", "numerator": 3}, denominator=4)
        Fraction(3, 4)
    """
    _ROOMS[module] = None


def allowed() -> list[str]:
    """The user's modules that configurations may name, for other processes to import."""
    return [name for name in _ROOMS if name not in _PACKAGED]


def import_modules(modules: str | Sequence[str] | None) -> None:
    """Import modules, and let configurations name what they define.

    Args:
        modules: One, several or None: dotted names, also of modules in the current directory, or
            paths of files.

    Raises:
        ValueError: If a module does not exist or cannot be imported, or if Python finds
            another module of the same name.
    """
    for module in [modules] if isinstance(modules, str) else modules or ():
        name, path = module, Path(f"{module.replace('.', '/')}.py")
        if module.endswith(".py"):
            path = Path(module).expanduser()
            name = path.stem
            if not path.is_file():
                raise ValueError(f"import={module}: there is no such file.")
        # the folder is added to the path: other processes import the module by its name
        folder = str(Path.cwd() if name == module else path.resolve().parent)
        if folder not in sys.path:
            sys.path.append(folder)
        loaded_from = _import(name, module)
        if path.is_file() and Path(loaded_from).resolve() != path.resolve():
            raise ValueError(
                f"import={module}: Python has another module of that name, "
                f"{loaded_from}. Rename yours."
            )
        allow(name)


def _import(name: str, given: str) -> str:
    """Import a module; return its file, or "" if it has none."""
    try:
        return import_module(name).__file__ or ""
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and error.name == name.partition(".")[0]:
            raise ValueError(
                f"import={given}: there is no module '{error.name}' here or among the installed "
                f"ones. A file is named by its path: import=folder/{error.name}.py."
            ) from None
        frames = traceback.extract_tb(error.__traceback__)
        # the user's own line, not one of Python's import or of this package that refuses arguments
        inner = str(Path(__file__).parent)
        users = [
            f for f in frames if not f.filename.startswith(inner) and "importlib" not in f.filename
        ]
        place = f" ({users[-1].filename}, line {users[-1].lineno})" if users else ""
        raise ValueError(f"import={given}: {type(error).__name__}: {error}{place}.") from error


def check_imports(config: Mapping[Any, Any], given: str | Sequence[str] | None, run: Path) -> None:
    """Refuse to open a run that has used modules of its own, unless ``import=`` is given."""
    noted = config.get("import") or []
    if given is None and noted:
        words = join(f"import={module}" for module in noted)
        raise ValueError(
            f"{run} was trained with {words}: add that to the command if you trust this code, or "
            f"'import=[]' to go without. In Python: safe_rl.load(…, imports=[…])."
        )


def instantiate(
    node: DictConfig | Mapping[str, Any] | None,
    /,
    optional: Mapping[str, Any] | None = None,
    **objects: Any,
) -> Any:
    """Build what a node's ``_target_`` names, as `hydra.utils.instantiate` does.

    Args:
        node: The node. Those within it that have a ``_target_`` are built first; one with
            ``_partial_: true`` becomes a function that takes the remaining arguments later.
        optional: Arguments that the target gets if its signature has them and they are not None.
        objects: Further arguments of the target, passed on without a copy.

    Returns:
        The object; None if the node or its ``_target_`` is null.

    Raises:
        TargetError: If a target may not be named or does not exist.
        SettingError: If a target refuses its arguments; the message names the full key.

    Examples:
        >>> node = {"_target_": "safe_rl.objectives.LagrangeMultiplier", "init": 1.0, "lr": 0.05}
        >>> instantiate(node, cost_limits={"cost": 25.0}).value
        tensor([1.])
    """
    key, plain = "", cast(Any, node)
    if isinstance(node, DictConfig):
        key, plain = node._get_full_key(None), OmegaConf.to_container(node, resolve=True)
    if plain is None:
        return None
    if not isinstance(plain, Mapping) or "_target_" not in plain:
        raise TargetError(f"{join_keys(key, '_target_')} is missing: it names the class to build.")
    if plain["_target_"] is None:
        return None
    trusted = _trusted(plain, key)
    known = parameters_of(locate(plain["_target_"])) if optional else {}
    objects |= {k: v for k, v in (optional or {}).items() if k in known and v is not None}
    try:
        part = hydra.utils.instantiate(trusted, _partial_=True)
        return part if plain.get("_partial_") and not objects else part(**objects)
    except InstantiationException as error:
        inner = str(error).partition("full_key: ")[2]
        place, cause = join_keys(key, inner) if inner else key, error.__cause__ or error
        at = OmegaConf.create({"at": plain}, flags={"allow_objects": True})
        # Hydra's key of an item of a list cannot be found again
        built = OmegaConf.select(at, join_keys("at", inner) if inner else "at") or {}
        raise _in_words(cause, place, built) from error
    except (TypeError, ValueError, ModuleNotFoundError) as error:
        raise _in_words(error, key, plain) from error


def _in_words(error: BaseException, key: str, node: Mapping[str, Any]) -> SettingError:
    """An error of a constructor, with the full key of its node or of the wrong setting."""
    unknown = re.search(r"unexpected keyword argument '(\w+)'", str(error))
    if isinstance(error, SettingError):
        return SettingError(join_keys(key, str(error)))
    if isinstance(error, TypeError) and unknown and unknown[1] in node:
        target, name = locate(node["_target_"]), join_keys(key, unknown[1])
        known = parameters_of(target)
        if unknown[1] not in known:  # else the mistake is in the code of the constructor
            hint = did_you_mean(unknown[1], known) or f" Leave it out with '~{name}'."
            return SettingError(f"{name}: {target.__name__} has no such argument.{hint}")
    words = " ".join(str(error).split())
    return SettingError(f"{key}: {words}" if key else words)


def locate(target: Any, key: str = "") -> Callable[..., Any]:
    """Return the class or function of a dotted name, if a configuration may name it.

    Raises:
        TargetError: If it may not be named, or does not exist.

    Examples:
        >>> locate("safe_rl.algorithms.MinibatchUpdate").__name__
        'MinibatchUpdate'
        >>> locate("torch.load", key="loss._target_")
        Traceback (most recent call last):
        ...
        safe_rl.trust.TargetError: loss._target_=torch.load: configurations reach only parts of safe_rl, torch.optim and modules of yours. If you trust 'torch', add import=torch to the command (in Python: imports='torch', or safe_rl.trust.import_modules('torch')).
    """  # noqa: E501
    name = " ".join(str(target).split())  # in one line, as messages show it
    shown = f"{key}={name}" if key else name
    if name == "???":  # OmegaConf's mark of a value that has no default
        raise TargetError(f"{key} has to be given: {key}=…")
    # the user's modules come first: they may contain a room with fewer names
    root = next((room for room in reversed(_ROOMS) if name.startswith(f"{room}.")), None)
    if root is None:
        module = name.rpartition(".")[0] or name
        raise TargetError(
            f"{shown}: configurations reach only parts of safe_rl, torch.optim and modules of "
            f"yours. If you trust '{module}', add {quote(f'import={module}')} to the command (in "
            f"Python: imports='{module}', or safe_rl.trust.import_modules('{module}'))."
        )
    known, part = _ROOMS[root], name.removeprefix(f"{root}.")
    if known is not None and part not in known:
        raise TargetError(
            f"{shown}: of '{root}' configurations reach only {', '.join(known)}."
            f"{did_you_mean(part, known)}"
        )
    if any(word.startswith("_") for word in part.split(".")):
        raise TargetError(f"{shown}: what begins with _ is private.")
    try:
        target = resolve_name(name)
    except AttributeError as error:
        raise TargetError(
            f"{shown}: {error}.{did_you_mean(error.name or '', dir(error.obj))}"
        ) from None
    except ValueError:
        raise TargetError(f"{shown} is no dotted name.") from None
    if not (inspect.isclass(target) or inspect.isroutine(target)):
        raise TargetError(f"{shown} is neither a class nor a function.")
    # a module may import, and a class inherit, what configurations must not name
    home = getattr(target, "__module__", None) or ""
    homes = (room for room, names in _ROOMS.items() if room == root or names is None)
    if not any(f"{home}.".startswith(f"{room}.") for room in homes):
        raise TargetError(
            f"{shown}: it is defined in '{home}', which configurations do not reach, not in "
            f"'{root}'. If you trust '{home}', add {quote(f'import={home}')} to the command and "
            f"write _target_={home}.{target.__qualname__}."
        )
    return target


def _trusted(node: Any, key: str) -> Any:
    """Copy plain containers after checking that every target in them is allowed."""
    if isinstance(node, list | tuple | ListConfig):
        return [_trusted(item, f"{key}[{index}]") for index, item in enumerate(node)]
    if not isinstance(node, Mapping):
        return node
    copied = {name: _trusted(value, join_keys(key, name)) for name, value in node.items()}
    if "_target_" in copied:
        locate(copied["_target_"], join_keys(key, "_target_"))
    return copied
