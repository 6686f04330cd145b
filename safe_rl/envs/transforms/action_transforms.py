"""Transforms that replace actions by a filter, delay them, or hold them for several steps."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from inspect import signature
from typing import Annotated, Any

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, OneHot, TensorSpec

from safe_rl.checks import Text
from safe_rl.envs.keys import ConfigError
from safe_rl.envs.transforms.environment import ConstraintTransform
from safe_rl.naming import STEPS_TAKEN


def _parameters(function: Callable[..., Any]) -> set[str]:
    """Names of parameters; empty for a function without a signature, such as `torch.clamp`.

    TypeError if an argument that it already has (`functools.partial`) is none of them.
    """
    try:
        if isinstance(function, partial):
            signature(function.func).bind_partial(*function.args, **function.keywords)
        return set(signature(function).parameters)
    except ValueError:
        return set()


class ActionFilter(ConstraintTransform):
    """A function replaces unsafe actions; every step with a replaced action costs 1.

    The function can be a safety layer (Dalal et al. 2018, "Safe Exploration in Continuous Action
    Spaces"), a shield or a projection ("action replacement" and "action projection" of Krasowski et
    al. 2023, "Provably Safe Reinforcement Learning"). It is also used in evaluation. The algorithm
    learns from the action that its policy chose; the environment takes the replaced one. The cost
    can be limited:
    cost_limits='{cost: 25, cost_interventions: 10}'.

    Args:
        filter: Function that gets a TensorDict [N] with `observation` and `action` [N, A], and
            returns the actions to take [N, A]. A row whose action it returns unchanged is no
            intervention. If the function has a parameter `positions`, it also gets the positions
            before the step (`get_positions` of the environment). If it has a parameter `layout`, it
            gets the columns of the observation (`observation_layout`).
        cost_key: Name of the cost of interventions.

    Raises:
        TypeError: If the function does not take an argument that it was given beforehand.
        ConfigError: At a step, if the function returns another shape or type, or has a parameter
            `positions` and the environment has no positions.

    Examples:
        >>> import torch
        >>> from torchrl.envs import TransformedEnv
        >>> from safe_rl.envs import SafetyGymEnv
        >>> env = SafetyGymEnv("PointGoal1", num_envs=2, seed=0)
        >>> slow = ActionFilter(lambda step: step["action"].clamp(-0.5, 0.5))
        >>> env = TransformedEnv(env, slow)
        >>> full_speed = torch.tensor([[0.4, 0.0], [1.0, 0.0]])
        >>> env.step(env.reset().set("action", full_speed))["next", "cost_interventions"]
        tensor([[0.],
                [1.]])
    """

    _intervened: Tensor

    def __init__(
        self,
        filter: Callable[..., Tensor],
        *,
        cost_key: Text = "cost_interventions",
    ) -> None:
        super().__init__()
        self._filter = filter
        self._asks_for = {"positions", "layout"} & _parameters(filter)
        self.added_costs = (cost_key,)

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        # a copy, because the algorithm learns from the original and a filter may work in place
        replaced = self._filter(tensordict.clone(), **self._asked())
        if not isinstance(replaced, Tensor) or replaced.shape != action.shape:
            got = tuple(replaced.shape) if isinstance(replaced, Tensor) else type(replaced).__name__
            raise ConfigError(
                f"The action filter must return actions of shape {tuple(action.shape)}, got {got}."
            )
        differs = (replaced != action).reshape(*tensordict.batch_size, -1)
        self._intervened = differs.any(-1, keepdim=True)
        return tensordict.set("action", replaced)

    def _asked(self) -> dict[str, Any]:
        """The additional arguments of the filter, by the names of its parameters."""
        positions = self.container.get_positions() if "positions" in self._asks_for else None
        if positions is not None and positions.is_empty():
            raise ConfigError(
                "The action filter has a parameter 'positions', but this environment has no "
                "positions (get_positions): use the observation and its 'layout'."
            )
        known = {"positions": positions, "layout": self.container.observation_layout}
        return {name: known[name] for name in self._asks_for}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        cost = self._intervened.to(next_tensordict.get("reward").dtype)
        return next_tensordict.set(self.added_costs[0], cost)

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """Add the cost."""
        like = reward_spec["reward"]
        cost = Bounded(0.0, 1.0, like.shape, device=like.device, dtype=like.dtype)
        reward_spec[self.added_costs[0]] = cost
        return reward_spec


class ActionDelay(ConstraintTransform):
    """Actions take effect some steps later, also in evaluation.

    In the first steps of an episode the environment gets the action nearest to 0, in the units in
    which policies choose actions, or the first discrete action. Pending actions are not observed,
    so recurrent policies have an advantage.

    Args:
        steps: Steps from an action to its effect.

    Examples:
        >>> from safe_rl.envs import make_env
        >>> env = make_env({"robot_base": "point"}, seed=0, transforms={"late": ActionDelay(2)})
        >>> env.rollout(4).shape
        torch.Size([1, 4])
    """

    def __init__(self, steps: Annotated[int, Interval(ge=1, le=1000)]) -> None:
        super().__init__()
        self._steps = steps

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return `steps` neutral actions."""
        spec = self.parent.action_spec  # of the environment with the transforms before this one
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
        self._rows = {"pending": torch.cat([left, flat.to(pending.dtype)], -1)}
        return tensordict.set("action", due.reshape(action.shape))


class ActionRepeat(ConstraintTransform):
    """The policy acts at every k-th step, and its action is held for the steps between.

    Rewards and costs of the k steps are summed, so that returns and limits keep their meaning, and
    `goal_met` is True if a goal was met in any of them. A row whose episode ends between two
    decisions takes no further steps; `steps_taken` is the number of steps of a decision. The
    transform is also used in evaluation. It must be the last transform; the others act at every
    step.

    Args:
        k: Steps for which an action is held.

    Raises:
        ValueError: At a reset, if it shares TorchRL's `Compose` with others of these transforms.

    Examples:
        >>> from safe_rl.envs import make_env
        >>> env = make_env("PointGoal1", seed=0, transforms={"repeat": ActionRepeat(4)})
        >>> env.steps_per_decision, env.rollout(250)["next", "steps_taken"].sum().item()
        (4, 1000)
    """

    def __init__(self, k: Annotated[int, Interval(ge=1, le=1000)]) -> None:
        super().__init__()
        self.steps_per_decision = k

    def start(self, done: Tensor) -> dict[str, Tensor]:
        """Return 0 as the number of steps that were taken."""
        beside = getattr(self.container.transform, "transforms", ())
        others = [t for t in beside if isinstance(t, ConstraintTransform) and t is not self]
        if others and self.steps_per_decision > 1:
            raise ValueError(
                f"{type(others[0]).__name__} must act at every step, but together with "
                "ActionRepeat it would act at every decision: make the environment by "
                "make_env(…, transforms={…}) or transform_env instead of TransformedEnv."
            )
        return {STEPS_TAKEN: torch.zeros_like(done, dtype=torch.int64)}

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        env, result = self.container.base_env, next_tensordict
        rewards_and_costs = list(env.full_reward_spec.keys(True, True))
        events = getattr(env, "events", ())
        taken = torch.ones_like(result.get("done"), dtype=torch.int64)
        for _ in range(self.steps_per_decision - 1):
            active = ~result.get("done")
            if not active.any():
                break
            # A stateless environment reads its state from the last step.
            state = tensordict.clone(False).update(result)
            if not getattr(env, "steps_after_end", False):
                # it may refuse such steps: rows that have ended begin episodes that do not count
                state = env.maybe_reset(state)
            after = env._step(state.set("action", tensordict.get("action")))
            after.update({key: result.get(key) + after.get(key) for key in rewards_and_costs})
            after.update({key: result.get(key) | after.get(key) for key in events})
            taken += active
            if not active.all():
                before = result.select(*after.keys(True, True))
                after = torch.where(active.reshape(after.batch_size), after, before)
            result = after
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
        """Widen the bounds to those of k steps; the last decision of an episode may have fewer."""
        for key in list(reward_spec.keys(True, True)):
            reward_spec[key] = _of_steps(reward_spec[key], self.steps_per_decision)
        return reward_spec


def _of_steps(spec: TensorSpec, most: int) -> TensorSpec:
    """The spec of a sum over 1 to `most` steps; one without bounds is returned unchanged."""
    if not isinstance(spec, Bounded):
        return spec
    highest = torch.finfo(spec.dtype).max
    low = torch.minimum(spec.low, most * spec.low).clamp(min=-highest)
    high = torch.maximum(spec.high, most * spec.high).clamp(max=highest)
    return Bounded(low, high, spec.shape, device=spec.device, dtype=spec.dtype)
