"""Gymnasium's environments in TorchRL, with their costs where the algorithms look for them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import partial
from inspect import signature
from multiprocessing import current_process
from typing import Any

import gymnasium
import numpy as np
import torch
from gymnasium.vector import AutoresetMode, SyncVectorEnv, VectorEnv
from tensordict import TensorDictBase
from torchrl.data import Bounded, Composite, TensorSpec
from torchrl.envs import GymWrapper, Transform, TransformedEnv

from safe_rl.envs.cost_specs import cost_spec
from safe_rl.envs.costs import COST, is_cost
from safe_rl.envs.errors import ConfigError, nearest, require_integer, require_names
from safe_rl.envs.gymnasium.adapting import adapt, check_workers, make_adapted
from safe_rl.envs.gymnasium.processes import ProcessVectorEnv
from safe_rl.envs.gymnasium.reading import CostReader, columns_of

MakeEnv = Callable[[], gymnasium.Env]
_NO_COSTS = {"observation", "action", "reward", "done", "terminated", "truncated"}


class CostsAsRewards(Transform):
    """Puts costs beside the reward instead of among the observations, and adds their sum.

    Args:
        cost_keys: costs that the environment writes; where `cost` is not one of them, it is added
            as the sum of all.
    """

    def __init__(self, cost_keys: Sequence[str]) -> None:
        super().__init__()
        self._cost_keys = list(cost_keys)
        self._sums = COST not in self._cost_keys

    def _call(self, next_tensordict: TensorDictBase) -> TensorDictBase:
        if self._sums:
            costs = torch.stack([next_tensordict[key] for key in self._cost_keys])
            next_tensordict[COST] = costs.sum(0)
        return next_tensordict

    def _reset(
        self, tensordict: TensorDictBase, tensordict_reset: TensorDictBase
    ) -> TensorDictBase:
        return tensordict_reset.exclude(*self._cost_keys)

    def transform_output_spec(self, output_spec: Composite) -> Composite:
        """Move the specs accordingly."""
        output_spec = super().transform_output_spec(output_spec)
        observations, rewards = (
            output_spec["full_observation_spec"],
            output_spec["full_reward_spec"],
        )
        for key in self._cost_keys:
            rewards[key] = observations[key]
            del observations[key]
        if self._sums:
            rewards[COST] = _spec_of_sum([rewards[key] for key in self._cost_keys])
        return output_spec


class GymnasiumEnv(TransformedEnv):
    """N environments of Gymnasium as one of TorchRL, made by `from_gymnasium`.

    Attributes:
        cost_keys: the aggregate `cost`, then one key per kind.
        observation_layout: one component, the whole observation; of a dictionary, its entries.
        max_episode_steps: the largest number of steps of an episode.
    """

    def __init__(self, base_env: GymWrapper, cost_keys: Sequence[str], num_steps: int) -> None:
        super().__init__(base_env, CostsAsRewards(cost_keys))
        self.cost_keys = [COST, *(key for key in cost_keys if key != COST)]
        self.observation_layout = columns_of(base_env.observation_spec["observation"])
        self.max_episode_steps = num_steps

    @property
    def seconds_per_step(self) -> float | None:
        """What a step takes in the environment's own time [s], if it says that."""
        rate = (getattr(self.base_env._env, "metadata", None) or {}).get("render_fps")
        return 1 / rate if rate else None

    def render(
        self,
        rows: int | Sequence[int] | None = None,
        *,
        camera: str = "free",
        width: int = 480,
        height: int = 360,
    ) -> np.ndarray:
        """Draw environments as they draw themselves, within a picture of the asked size.

        Args:
            rows: which of them; None is all.
            camera: "free"; others are arguments of the environment's own.
            width: of a frame [pixels].
            height: of a frame [pixels].

        Returns:
            RGB, uint8: one frame [height, width, 3] for an integer, else [R, height, width, 3].

        Raises:
            ValueError: for another camera, or if the environments were made without pictures.
        """
        if camera != "free":
            raise ValueError(
                f"There is no camera '{camera}': an environment of Gymnasium has its own, which "
                "its arguments may change (env.kwargs)."
            )
        frames = self.base_env._env.render()
        if frames is None or frames[0] is None:
            raise ValueError("It was made without pictures: env.render_mode=rgb_array.")
        chosen = range(len(frames)) if rows is None else [rows] if isinstance(rows, int) else rows
        drawn = np.stack([_fit(np.asarray(frames[row]), width, height) for row in chosen])
        return drawn[0] if isinstance(rows, int) else drawn


def from_gymnasium(
    env: str | MakeEnv,
    *,
    num_envs: int = 1,
    cost_keys: Sequence[str] | None = None,
    num_steps: int | None = None,
    seed: int | None = None,
    workers: int = 0,
    device: torch.device | str = "cpu",
    flatten: bool = True,
    highest_costs: Mapping[str, float] | None = None,
    **kwargs: Any,
) -> GymnasiumEnv:
    """Make a TorchRL environment of any Gymnasium environment that reports costs in `info`.

    Observations become one float32 vector each, continuous actions are clipped to [-1, 1] and
    stretched to the environment's bounds, so that the algorithms can be used as they are. Choices
    (Discrete, MultiDiscrete) are integers.

    Args:
        env: Gymnasium id, or a function that makes an environment.
        num_envs: number of environments, N.
        cost_keys: names of the costs in `info`; None finds those called `cost` or `cost_<kind>` by
            taking one step.
        num_steps: the largest number of steps of an episode; None takes what the id says.
        seed: of all environments; row k has this one plus k.
        workers: processes that step them; 0 steps them here, one after the other, as is done in a
            process that is itself a worker.
        device: where the TensorDicts live.
        flatten: make one vector of every observation; False leaves pictures and dictionaries of
            vectors and pictures as they are, and refuses other observations that are no arrays.
        highest_costs: cost key -> the most that a step can cost, where that is known; the specs
            say so then, and certificates use it.
        kwargs: for `gymnasium.make`, with an id.

    Returns:
        An environment [N], with the costs in its reward spec. Without a cost called `cost` it gets
        one, the sum of the others. A copy (`copy`, `pickle`) goes on as far as copies of what is
        within do; with workers it begins where its seed does.

    Raises:
        ValueError: if no costs are reported, the actions are neither continuous and bounded nor
            choices, the observations are no arrays and not to be flattened, the length of
            episodes is not known, or an argument is none.

    Examples:
        >>> env = from_gymnasium("Safexp-PointGoal1-v0", num_envs=2, num_steps=1000, seed=0)
        >>> env.rollout(3)["next", "cost_hazards"].shape
        torch.Size([2, 3, 1])
    """
    require_integer("num_envs", num_envs, lowest=1)
    require_integer("workers", workers, lowest=0)
    require_names("cost_keys", cost_keys)
    make = _maker(env, kwargs, num_steps)
    keys, length = describe(make, cost_keys, num_steps, flatten)
    _check_keys(keys, highest_costs or {})
    make_one = partial(make_adapted, make, length, flatten, keys)
    worlds: VectorEnv
    if workers and not current_process().daemon:
        if not flatten:
            check_workers(make)
        worlds = ProcessVectorEnv(make_one, num_envs, min(workers, num_envs), keys)
    else:
        worlds = SyncVectorEnv([make_one] * num_envs, autoreset_mode=AutoresetMode.DISABLED)
        worlds.env_fns = ()  # not asked again: functions of one's own might not be pickled
    return from_vector(worlds, keys, length, seed=seed, device=device, highest_costs=highest_costs)


def from_vector(
    worlds: VectorEnv,
    cost_keys: Sequence[str],
    num_steps: int,
    *,
    seed: int | None = None,
    device: torch.device | str = "cpu",
    highest_costs: Mapping[str, float] | None = None,
) -> GymnasiumEnv:
    """Make a TorchRL environment of a batch whose observations and actions suit networks.

    Args:
        worlds: N environments that are reset by a mask, and only then.
        cost_keys: names of the costs in `info`.
        num_steps: the largest number of steps of an episode.
        seed: of all environments.
        device: where the TensorDicts live.
        highest_costs: cost key -> the most that a step can cost, where that is known.
    """
    base = GymWrapper(worlds, device=torch.device(device), categorical_action_encoding=True)
    reader = CostReader(cost_keys, [worlds.num_envs], highest_costs, patience=num_steps)
    base.set_info_dict_reader(reader)
    batch = GymnasiumEnv(base, cost_keys, num_steps)
    batch.set_seed(int(torch.randint(2**31, ())) if seed is None else seed)
    return batch


def describe(
    make: MakeEnv, cost_keys: Sequence[str] | None, num_steps: int | None, flatten: bool
) -> tuple[list[str], int]:
    """Return the names of the costs and the length of episodes, found out where they are None.

    Raises:
        ValueError: if the environment does not tell, or cannot be used.
    """
    if num_steps is not None:
        require_integer("num_steps", num_steps, lowest=1)
    probe = make()
    if not isinstance(probe, gymnasium.Env):
        raise ConfigError(f"It makes no environment of Gymnasium (gymnasium.Env), but {probe!r}.")
    try:
        adapted = adapt(probe, flatten=flatten)
        keys = _find_costs(adapted) if cost_keys is None else [*dict.fromkeys(cost_keys)]
        return keys, _episode_length(adapted, num_steps)
    finally:
        probe.close()


def _spec_of_sum(specs: Sequence[TensorSpec]) -> TensorSpec:
    highest = [float(spec.high.max()) for spec in specs if isinstance(spec, Bounded)]
    is_known = len(highest) == len(specs)
    return cost_spec(sum(highest) if is_known else None, specs[0].shape, specs[0].device)


def _fit(picture: np.ndarray, width: int, height: int) -> np.ndarray:
    """Resize to the largest picture that keeps its form, in the corner of [height, width, 3]."""
    scale = min(width / picture.shape[1], height / picture.shape[0])
    lines, columns = (
        (np.arange(max(1, int(scale * size))) / scale).astype(int) for size in picture.shape[:2]
    )
    canvas = np.zeros((height, width, 3), dtype=np.uint8)
    canvas[: len(lines), : len(columns)] = picture[lines[:, None], columns]
    return canvas


def _maker(env: Any, kwargs: Mapping[str, Any], num_steps: int | None) -> MakeEnv:
    if isinstance(env, str):
        length = {} if num_steps is None else {"max_episode_steps": num_steps}
        # what is registered here goes with it to other processes
        return partial(gymnasium.make, gymnasium.registry.get(env, env), **{**length, **kwargs})
    if isinstance(env, gymnasium.Env) or not callable(env):
        raise ConfigError(f"Give an id, or a function that makes an environment; got {env!r}.")
    for key in kwargs:
        hint = nearest(key, signature(from_gymnasium).parameters)
        raise ConfigError(f"'{key}' is for gymnasium.make, and a function makes these.{hint}")
    return env


def _check_keys(keys: Sequence[str], highest_costs: Mapping[str, float]) -> None:
    if not keys:
        raise ValueError("'cost_keys' is empty: name costs in info, or leave it away (null).")
    for key in _NO_COSTS.intersection(keys):
        raise ValueError(f"'cost_keys' are names of numbers in info, and '{key}' is none of them.")
    for key in set(highest_costs).difference(keys):
        raise ValueError(f"'highest_costs' has '{key}', which is no cost.{nearest(key, keys)}")


def _find_costs(probe: gymnasium.Env) -> list[str]:
    probe.reset(seed=0)
    *_, info = probe.step(np.zeros(probe.action_space.shape, dtype=probe.action_space.dtype))
    keys = [key for key in info if is_cost(key)]
    if not keys:
        raise ValueError(
            f"{probe.unwrapped} reports no costs: there is no 'cost' or 'cost_<kind>' in its info, "
            f"which has {', '.join(sorted(info)) or 'nothing'}. If a cost is called otherwise, or "
            "is not reported at every step, name it in 'cost_keys'; 'outside' makes a cost of "
            "leaving a range: env.outside='{cost_position: [0, -0.5, 0.5]}'."
        )
    return keys


def _episode_length(probe: gymnasium.Env, num_steps: int | None) -> int:
    known = None if probe.spec is None else probe.spec.max_episode_steps
    length = known if num_steps is None else num_steps
    if length is None:
        raise ValueError(f"{probe} does not say how long episodes are: give 'num_steps'.")
    return length
