"""TorchRL collectors with the settings that on-policy training on batched environments needs."""

from __future__ import annotations

from collections.abc import Callable

import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

__all__ = ["make_collector"]


def make_collector(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    frames_per_batch: int,
    device: torch.device | str | None = None,
) -> Collector:
    """Build an endless in-process collector of [N, T] batches.

    Trajectory identifiers are not tracked: they cost a tenth of the time of a small environment's
    step, and ``("next", "done")`` already marks where episodes end.

    Args:
        env: Batched environment, batch_size [N].
        policy: Module that writes what ``env`` and the losses need, for example a
            :class:`~safe_rl.models.BehaviourPolicy`.
        frames_per_batch: Steps of all environments together in one batch, N·T.
        device: Device of policy and batches. Defaults to that of the environment.

    Returns:
        A :class:`torchrl.collectors.Collector`. It has reset the environment, so seed that first.

    Raises:
        ValueError: If ``frames_per_batch`` is not a positive multiple of N.

    Examples:
        >>> from torchrl.envs import PendulumEnv, SerialEnv
        >>> from torchrl.modules import RandomPolicy
        >>> env = SerialEnv(4, PendulumEnv)
        >>> collector = make_collector(env, RandomPolicy(env.action_spec), frames_per_batch=40)
        >>> next(iter(collector)).shape
        torch.Size([4, 10])
    """
    num_envs = env.batch_size.numel()
    if frames_per_batch < 1 or frames_per_batch % num_envs:
        below = frames_per_batch // num_envs * num_envs
        nearest = [frames for frames in (below, below + num_envs) if frames > 0]
        raise ValueError(
            f"frames_per_batch={frames_per_batch} cannot be shared equally among {num_envs} "
            f"environments: use {' or '.join(map(str, nearest))}, or another number of "
            "environments."
        )
    device = env.device if device is None else torch.device(device)
    return Collector(
        env,
        policy,
        frames_per_batch=frames_per_batch,
        total_frames=-1,
        policy_device=device,
        env_device=env.device,
        storing_device=device,
        track_traj_ids=False,
        auto_register_policy_transforms=False,
    )
