"""Functions that build collectors: in this process, in processes of its machine, on a cluster."""

from __future__ import annotations

import sys
from collections.abc import Callable
from typing import Annotated, Any

import torch
from annotated_types import Interval
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.collectors import Collector, MultiSyncCollector
from torchrl.collectors.distributed import RayCollector
from torchrl.envs import EnvBase

from safe_rl.checks import checked
from safe_rl.collectors.workers import MakeEnv, Makers, WorkerCollector, starting_processes
from safe_rl.extras import import_extra


def check_batch(frames_per_batch: int, num_envs: int, steps_at_a_time: int = 1) -> None:
    """Refuse batches, in steps of all environments, that these cannot share equally.

    Raises:
        ValueError: If the steps are not a positive multiple of those taken together.
    """
    together = num_envs * steps_at_a_time
    if frames_per_batch < 1 or frames_per_batch % together:
        below = frames_per_batch // together * together
        nearest = [str(frames) for frames in (below, below + together) if frames > 0]
        steps = f" that take {steps_at_a_time} steps at a time" if steps_at_a_time > 1 else ""
        raise ValueError(
            f"frames_per_batch={frames_per_batch} cannot be shared equally among {num_envs} "
            f"environments{steps}: use {' or '.join(nearest)}, or another number of environments."
        )


def make_collector(
    env: EnvBase,
    policy: Callable[[TensorDictBase], TensorDictBase],
    *,
    frames_per_batch: int,
    device: torch.device | str | None = None,
) -> Collector:
    """Build an endless collector of [N, T] batches in this process; seed the environment before.

    Args:
        env: Batched environment, batch_size [N].
        policy: Module that writes the actions, and all other entries that the losses need.
        frames_per_batch: Steps of all environments together in one batch, N·T.
        device: Device of policy and batches. Defaults to that of the environment.

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
    check_batch(frames_per_batch, env.batch_size.numel())
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


@checked
def make_process_collector(  # noqa: D417
    env: EnvBase,
    make_env: MakeEnv,
    policy: TensorDictModuleBase,
    *,
    frames_per_batch: int,
    num_collectors: Annotated[int, Interval(ge=1, le=1024)],
    device: torch.device | str,
) -> WorkerCollector:
    """Collect in processes of this machine; for other arguments see `WorkerCollector`.

    Args:
        policy: Policy, whose weights are sent to the workers.
        num_collectors: Number of processes W, which divides N.
    """
    check_batch(frames_per_batch, env.batch_size.numel())

    def start(makers: Makers) -> MultiSyncCollector:
        with starting_processes():
            return MultiSyncCollector(
                makers,
                policy,
                frames_per_batch=frames_per_batch,
                total_frames=-1,
                policy_device="cpu",
                env_device="cpu",
                storing_device="cpu",
                cat_results=0,
                use_buffers=True,
                auto_register_policy_transforms=False,
            )

    return WorkerCollector(start, env, make_env, num_collectors, device)


@checked
def make_ray_collector(  # noqa: D417
    env: EnvBase,
    make_env: MakeEnv,
    policy: TensorDictModuleBase,
    *,
    frames_per_batch: int,
    num_collectors: Annotated[int, Interval(ge=1, le=1024)],
    device: torch.device | str,
    ray_init: dict[str, Any],
    resources: dict[str, Any],
) -> WorkerCollector:
    """Collect in actors of a Ray cluster; for other arguments see `WorkerCollector`.

    Args:
        num_collectors: Number of actors W, which divides N.
        ray_init: Arguments of ``ray.init``, such as ``address``; not used if Ray runs already in
            this process. With ``log_to_driver: true``, actors also print here, not only to files.
        resources: Resources of every actor: ``num_cpus``, ``num_gpus``, ``memory``.
    """
    ray = import_extra("ray", "ray")
    check_batch(frames_per_batch, env.batch_size.numel())

    def start(makers: Makers) -> RayCollector:
        collector = RayCollector(
            makers,
            policy,
            frames_per_batch=frames_per_batch,
            total_frames=sys.maxsize,
            sync=True,
            collector_kwargs={"auto_register_policy_transforms": False},
            remote_configs=resources,
            num_collectors=num_collectors,
        )
        collector.update_policy_weights_()  # TorchRL warns if it has not been called
        return collector

    workers = WorkerCollector(start, env, make_env, num_collectors, device)
    # not in start(): the processes of Ray end with the thread that has started them
    if not ray.is_initialized():
        ray.init(**{"log_to_driver": False, **ray_init})
    return workers
