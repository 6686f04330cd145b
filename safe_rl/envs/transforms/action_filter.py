"""Actions replaced by a function of the user's, and how often that was necessary."""

from __future__ import annotations

from collections.abc import Callable

from tensordict import TensorDictBase
from torch import Tensor
from torchrl.data import TensorSpec

from safe_rl.envs.transforms.base import ConstraintTransform, reward_like


class ActionFilter(ConstraintTransform):
    """A function replaces unsafe actions, and every step at which it does costs 1.

    A safety layer (Dalal et al. 2018, "Safe Exploration in Continuous Action Spaces"),
    shield or projection, "action replacement" and "action projection" of Krasowski et al. 2023,
    "Provably Safe Reinforcement Learning". What the algorithm learns from is the action that its
    policy chose, of which it knows the probability; the environment takes the replaced one. The
    cost can be limited: cost_limits='{cost: 25, cost_interventions: 10}'. It is on in evaluation
    too.

    Args:
        filter: gets a TensorDict [N] with `observation` and `action` [N, A], returns the actions to
            take [N, A]. Where it returns what it got, it did not intervene.
        cost_key: name of the cost.

    Raises:
        ValueError: at a step, if the function returns something else.

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

    def __init__(
        self,
        filter: Callable[[TensorDictBase], Tensor],
        *,
        cost_key: str = "cost_interventions",
    ) -> None:
        super().__init__()
        self._filter = filter
        self.added_costs = (cost_key,)
        self._intervened: Tensor | None = None

    def _inv_call(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = tensordict.get("action")
        # a copy: what changes actions in place would change the one that is learned from
        replaced = self._filter(tensordict.set("action", action.clone()))
        if not isinstance(replaced, Tensor) or replaced.shape != action.shape:
            got = tuple(replaced.shape) if isinstance(replaced, Tensor) else type(replaced).__name__
            raise ValueError(
                f"The action filter must return actions of shape {tuple(action.shape)}, got {got}."
            )
        differs = (replaced != action).reshape(*tensordict.batch_size, -1)
        self._intervened = differs.any(-1, keepdim=True)
        return tensordict.set("action", replaced)

    def _step(self, tensordict: TensorDictBase, next_tensordict: TensorDictBase) -> TensorDictBase:
        assert self._intervened is not None  # the action was given to the step before
        cost = self._intervened.to(next_tensordict.get("reward").dtype)
        return next_tensordict.set(self.added_costs[0], cost)

    def transform_reward_spec(self, reward_spec: TensorSpec) -> TensorSpec:
        """Add the cost."""
        reward_spec[self.added_costs[0]] = reward_like(reward_spec)
        return reward_spec
