"""Each action is held for several steps of the environment."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, TensorSpec

from safe_rl.envs.transforms.base import ConstraintTransform
from safe_rl.naming import STEPS_TAKEN
from safe_rl.ranges import Range


class ActionRepeat(ConstraintTransform):
    """The policy decides at every k-th step, and its action is held for the steps between.

    Rewards and costs of the k steps are summed, so that returns and limits mean the same. A row
    whose episode ends inside a repeat takes no further steps: its sums, its last observation and
    its flags are those of the end. `steps_taken` says how many steps a decision took. It is on in
    evaluation too. It has to be the last transform: those before it act at every step.

    Args:
        k: Steps for which an action is held.

    Raises:
        ValueError: for fewer than one.

    Examples:
        >>> from safe_rl.envs import make_env
        >>> env = make_env("PointGoal1", seed=0, transforms={"repeat": ActionRepeat(4)})
        >>> env.steps_per_decision, env.rollout(250)["next", "steps_taken"].sum().item()
        (4, 1000)
    """

    def __init__(self, k: Annotated[int, Range(1, 1000)]) -> None:
        super().__init__()
        if k < 1:
            raise ValueError(f"k={k} must be at least 1.")
        self.steps_per_decision = k

    def _sums(self) -> Sequence[str]:
        """Entries of a step that are summed: rewards and costs."""
        return list(self.container.base_env.full_reward_spec.keys(True, True))

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return that no step was taken."""
        return {STEPS_TAKEN: torch.zeros_like(done, dtype=torch.int64)}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        env, keys, result = self.container.base_env, self._sums(), next_tensordict
        taken = torch.ones_like(result.get("done"), dtype=torch.int64)
        for _ in range(self.steps_per_decision - 1):
            goes_on = ~result.get("done")
            if not goes_on.any():
                break
            # what an environment without memory of its own reads stands in the last step
            state = tensordict.clone(False).update(result)
            if not goes_on.all():
                # an environment may refuse steps after an end; these ones are not counted
                state.update(env.reset(TensorDict(_reset=~goes_on, batch_size=env.batch_size)))
            after = env._step(state.set("action", tensordict.get("action")))
            after.update({key: result.get(key) + after.get(key) for key in keys})
            taken += goes_on
            result = after if goes_on.all() else _where(goes_on, after, result)
        self._rows = {STEPS_TAKEN: taken}
        return self._call(result)

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        return next_tensordict.set(STEPS_TAKEN, self._rows[STEPS_TAKEN])

    def transform_observation_spec(self, observation_spec: TensorSpec) -> TensorSpec:
        """Add the number of steps that were taken."""
        shape, device = (*observation_spec.shape, 1), observation_spec.device
        most = self.steps_per_decision
        observation_spec[STEPS_TAKEN] = Bounded(0, most, shape, device=device, dtype=torch.int64)
        return observation_spec

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """Say that sums of k steps may be k times as large."""
        for key in list(reward_spec.keys(True, True)):
            reward_spec[key] = _times(reward_spec[key], self.steps_per_decision)
        return reward_spec


def _where(mask: Tensor, one: TensorDictBase, other: TensorDictBase) -> TensorDictBase:
    """Rows [N, 1] of the one where the mask says so, else of the other."""
    rows = mask.reshape(one.batch_size)
    return torch.where(rows, one, other.select(*one.keys(True, True)))


def _times(spec: TensorSpec, factor: int) -> TensorSpec:
    """Bounds times a factor, where there are bounds."""
    if not isinstance(spec, Bounded):
        return spec
    most = torch.finfo(spec.dtype).max
    low, high = (torch.clamp(factor * bound, -most, most) for bound in (spec.low, spec.high))
    return Bounded(low, high, spec.shape, device=spec.device, dtype=spec.dtype)
