"""Environments of TorchRL, and of users in its interface, with costs that a rule computes."""

from typing import TYPE_CHECKING

from safe_rl.extras import import_later

if TYPE_CHECKING:
    from safe_rl.envs.torchrl.torchrl_env import make_torchrl

__all__ = ["make_torchrl"]

__getattr__, __dir__ = import_later(__name__, {"torchrl_env": __all__})
