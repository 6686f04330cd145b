"""A constrained decision process that costs nothing to step: the fixture of the training tests.

A point on the plane is pushed towards the origin; a hazard lies on the way. It has what training
asks of an environment: cost keys below ``full_reward_spec``, a named observation layout, time-outs
as truncation, partial resets, and snapshots from which it continues exactly.
"""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Bounded, Categorical, Composite, Unbounded

from safe_rl.envs import ConstrainedEnv

HAZARD = torch.tensor([0.6, 0.0])
HAZARD_RADIUS = 0.3
NORTH = 0.3
ARENA = 2.0


class PointMass(ConstrainedEnv):
    """Observation: position and last displacement, shape [N, 4]; action: displacement, [N, 2].

    ``cost`` is 1 where ``cost_hazards`` (inside the hazard) or ``cost_north`` (beyond a border) is.
    """

    observation_layout = {"position": slice(0, 2), "velocity": slice(2, 4)}  # noqa: RUF012
    cost_keys = ["cost", "cost_hazards", "cost_north"]  # noqa: RUF012

    def __init__(self, num_envs: int = 4, num_steps: int = 20, seed: int = 0) -> None:
        super().__init__(batch_size=[num_envs])
        self.max_episode_steps = num_steps
        scalar = {"shape": (num_envs, 1)}
        self.observation_spec = Composite(observation=Unbounded((num_envs, 4)), shape=[num_envs])
        self.action_spec = Bounded(-1, 1, (num_envs, 2))
        rewards = {key: Unbounded(**scalar) for key in ("reward", *self.cost_keys)}
        self.full_reward_spec = Composite(**rewards, shape=[num_envs])
        flags = ("done", "terminated", "truncated")
        self.full_done_spec = Composite(
            **{key: Categorical(2, dtype=torch.bool, **scalar) for key in flags}, shape=[num_envs]
        )
        self._seed = torch.zeros(())
        self._episode = torch.zeros(num_envs, 1)
        self._position = torch.zeros(num_envs, 2)
        self._velocity = torch.zeros(num_envs, 2)
        self._step_count = torch.zeros(num_envs, 1, dtype=torch.long)
        self.set_seed(seed)

    def _set_seed(self, seed: int | None) -> None:
        self._seed = torch.tensor(float(seed))

    def _reset(self, tensordict: TensorDictBase | None, **kwargs) -> TensorDictBase:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None:
            mask = torch.ones(*self.batch_size, 1, dtype=torch.bool)
        self._episode = self._episode + mask
        start = torch.tensor([1.2, 0.0]) + 0.2 * self._draws()
        self._position = torch.where(mask, start, self._position)
        self._velocity = torch.where(mask, 0.0, self._velocity)
        self._step_count = torch.where(mask, 0, self._step_count)
        return self._observe()

    def _draws(self) -> Tensor:
        """Two numbers in [-1, 1] per row, a function of seed, row and episode alone."""
        row = torch.arange(self.batch_size[0]).unsqueeze(-1)
        phase = 12.9898 * row + 78.233 * self._episode + 37.719 * self._seed
        return torch.cat([torch.sin(phase), torch.cos(1.618 * phase)], -1)

    def _observe(self) -> TensorDict:
        off = torch.zeros(*self.batch_size, 1, dtype=torch.bool)
        return TensorDict(
            observation=torch.cat([self._position, self._velocity], -1),
            done=off, terminated=off.clone(), truncated=off.clone(),
            batch_size=self.batch_size,
        )  # fmt: skip

    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        before = self._position.norm(dim=-1, keepdim=True)
        start = self._position
        self._position = (start + 0.15 * tensordict["action"].clamp(-1, 1)).clamp(-ARENA, ARENA)
        self._velocity = self._position - start
        self._step_count = self._step_count + 1
        distance = self._position.norm(dim=-1, keepdim=True)
        step = self._observe()
        step["reward"] = before - distance
        hazards, north = self._costs(self._position)
        step["cost_hazards"], step["cost_north"] = hazards, north
        step["cost"] = torch.maximum(hazards, north)
        step["truncated"] = self._step_count >= self.max_episode_steps
        step["done"] = step["truncated"]
        return step

    @staticmethod
    def _costs(position: Tensor) -> tuple[Tensor, Tensor]:
        inside = (position - HAZARD).norm(dim=-1, keepdim=True) < HAZARD_RADIUS
        return inside.float(), (position[:, 1:] > NORTH).float()

    def get_state(self) -> TensorDict:
        return TensorDict(
            position=self._position.clone(),
            velocity=self._velocity.clone(),
            step_count=self._step_count.clone(),
            episode=self._episode.clone(),
            batch_size=self.batch_size,
        )

    def set_state(self, state: TensorDictBase) -> TensorDict:
        self._position, self._velocity = state["position"].clone(), state["velocity"].clone()
        self._step_count, self._episode = state["step_count"].clone(), state["episode"].clone()
        return self._observe()


class Forgetful(PointMass):
    """Its worlds cannot be stored."""

    def get_state(self) -> None:  # type: ignore[override]
        return None


class PricedPointMass(PointMass):
    """An episode has 20 steps, each of which costs at most 1."""

    def highest_cost(self, key):
        return 20.0
