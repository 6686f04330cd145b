"""From nodes of a configuration to the parts of a recipe.

Parts with a ``_target_`` (losses, multipliers, updates, advantage estimators) may be classes of
your own: each gets those live objects that its constructor names.
"""

from __future__ import annotations

from inspect import isclass
from typing import Any, TypeVar

from omegaconf import DictConfig

from safe_rl.algorithms.contract import Recipe
from safe_rl.targets import TargetError, accepted_names, build, locate

__all__ = ["build_part", "build_update", "find_recipe"]

Update = TypeVar("Update")

_DEFAULT_RECIPE = "safe_rl.algorithms.OnPolicy"


def find_recipe(config: DictConfig) -> type[Recipe]:
    """The recipe that a configuration names as ``algo._target_``; on-policy unless it says so.

    Raises:
        TargetError: If there is no such class, or it is no recipe.
    """
    target = config.algo.get("_target_", _DEFAULT_RECIPE)
    recipe = locate(target, "algo._target_")
    if not (isclass(recipe) and issubclass(recipe, Recipe)):
        raise TargetError(
            f"algo._target_={target} is no recipe: derive it from safe_rl.algorithms.Recipe."
        )
    return recipe


def build_part(node: DictConfig, **objects: Any) -> Any:
    """Build a node with those live objects that its constructor names; None is not passed.

    A node that says ``_partial_`` is a function to be called later.

    Raises:
        TargetError: If its target may not be built, or refuses; the message names the node.
    """
    if node.get("_partial_"):
        return build(node)
    names = accepted_names(locate(node.get("_target_"), f"{node._get_full_key(None)}._target_"))
    return build(node, **{k: v for k, v in objects.items() if v is not None and k in names})


def build_update(node: DictConfig, kind: type[Update], **objects: Any) -> Update:
    """Build, as `build_part` does, what improves networks.

    Raises:
        TargetError: As by `build_part`, or if it is no update of this kind.
    """
    update = build_part(node, **objects)
    if not isinstance(update, kind):
        raise TargetError(
            f"{node._get_full_key(None)}._target_={node._target_} is no update: derive it from "
            f"safe_rl.algorithms.{kind.__name__}."
        )
    return update
