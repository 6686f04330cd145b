"""Actions that take effect some steps after they were chosen."""

from __future__ import annotations

import torch
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, OneHot

from safe_rl.envs.transforms.base import ConstraintTransform

__all__ = ["ActionDelay"]


class ActionDelay(ConstraintTransform):
    """The environment takes the action of some steps before.

    The first steps of an episode have the action nearest to 0, or the first choice. What is
    pending is not observed, so a policy with a memory has the advantage. It is on in evaluation
    too.

    Args:
        steps: from an action to its effect.

    Raises:
        ValueError: for fewer than one.

    Examples:
        >>> import torch
        >>> from safe_rl.envs import make_env
        >>> env = make_env({"robot_base": "point"}, seed=0, transforms={"late": ActionDelay(2)})
        >>> rollout = env.rollout(4, lambda td: td.set("action", torch.tensor([[1.0, 0.0]])))
        >>> speed = rollout["next", "observation"][0, :, env.observation_layout["velocimeter"]]
        >>> (speed[:, 0] > 1e-3).tolist()
        [False, False, True, True]
    """

    def __init__(self, steps: int) -> None:
        super().__init__()
        if steps < 1:
            raise ValueError(f"steps={steps} must be at least 1.")
        self._steps = steps
        self._pending: Tensor | None = None

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return that nothing is to be done."""
        spec = self.container.action_spec
        nothing = spec.zero()
        if isinstance(spec, OneHot):
            nothing[..., 0] = 1
        elif isinstance(spec, Bounded):
            nothing = spec.project(nothing)
        flat = nothing.reshape(*done.shape[:-1], -1)
        return {"pending": flat.repeat(*[1] * (flat.ndim - 1), self._steps)}

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action, pending = tensordict.get("action"), self._rows["pending"]
        flat = action.reshape(*pending.shape[:-1], -1)
        due, left = pending.tensor_split([flat.shape[-1]], -1)
        self._pending = torch.cat([left, flat.to(pending.dtype)], -1)
        return tensordict.set("action", due.reshape(action.shape))

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        assert self._pending is not None  # the action was given to the step before
        self._rows = {"pending": self._pending}
        return next_tensordict
