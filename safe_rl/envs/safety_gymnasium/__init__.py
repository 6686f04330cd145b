"""Environments whose step returns six values, as Safety-Gymnasium's do: the cost stands by itself.

They come from the package where it can be imported, or from another Python in which it is
installed: its release 1.0 wants a Gymnasium and a MuJoCo that are years older than ours.
"""

from typing import TYPE_CHECKING

from safe_rl.lazy import import_later

if TYPE_CHECKING:
    from safe_rl.envs.safety_gymnasium.family import from_six_values, make_safety_gymnasium

__all__ = ["from_six_values", "make_safety_gymnasium"]

__getattr__, __dir__ = import_later(
    __name__, dict.fromkeys(__all__, "safe_rl.envs.safety_gymnasium.family")
)
