"""SAC on the Lagrangian with TorchRL's own collector, replay buffer and target updates.

    python examples/replay_buffer.py --env PointGoal1 --frames 200_000

Only networks, loss, multiplier, limits and episode accounting are from this package. Multiplier and
loss get the state of the limits after every batch, so that λ has the same scale as in `train.py
algo=sac_lagrangian limits=null`. The complete algorithm also has pessimistic costs
(`loss.pessimism`), a limit that falls during training, checkpoints, evaluations and a table.
"""

from __future__ import annotations

import safe_rl  # isort: skip  # noqa: F401, before torch, so that idle threads sleep

import argparse

import torch
from torchrl.collectors import Collector
from torchrl.data import LazyTensorStorage, TensorDictReplayBuffer
from torchrl.objectives import SoftUpdate

from safe_rl.algorithms import Constraints
from safe_rl.collectors import EpisodeAccounting
from safe_rl.envs import SafetyGymEnv
from safe_rl.models import QEnsemble, make_squashed_actor
from safe_rl.objectives import PIMultiplier, SACLagrangianLoss


def make_loss(env: SafetyGymEnv, limit: float) -> tuple[SACLagrangianLoss, PIMultiplier]:
    """Networks, and the loss that trains them."""
    spec, size = env.action_spec_unbatched, env.observation_spec["observation"].shape[-1]
    layers, actions = {"hidden_sizes": [128, 128]}, spec.shape[-1]
    multiplier = PIMultiplier(
        {"cost": limit}, init=0.0, kp=0.1, ki=0.05, saturation=0.5, highest=5.0
    )
    loss = SACLagrangianLoss(
        make_squashed_actor(size, spec.low, spec.high, **layers),
        QEnsemble(size, actions, num_networks=2, **layers),
        QEnsemble(size, actions, num_networks=2, out_key="cost_value", **layers),
        multiplier=multiplier,
        cost_keys=["cost"],
        gamma=0.99,
        alpha_init=0.02,
        action_spec=spec,
    )
    return loss, multiplier


def main(arguments: list[str] | None = None) -> list[dict[str, float]]:
    """Train; print and return a row per batch."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--env", default="PointGoal1")
    parser.add_argument("--limit", type=float, default=25.0)
    parser.add_argument("--frames", type=int, default=200_000)
    parser.add_argument("--frames-per-batch", type=int, default=5_000)
    parser.add_argument("--updates-per-batch", type=int, default=250)
    parser.add_argument("--num-envs", type=int, default=50)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(arguments)
    torch.manual_seed(args.seed)
    env = SafetyGymEnv(args.env, num_envs=args.num_envs, seed=args.seed)
    loss, multiplier = make_loss(env, args.limit)
    constraints = Constraints({"cost": args.limit}, max_length=env.max_episode_steps)
    collector = Collector(
        env,
        loss.actor_network,
        frames_per_batch=args.frames_per_batch,
        total_frames=args.frames,
        init_random_frames=2 * args.frames_per_batch,
        auto_register_policy_transforms=False,
    )
    buffer = TensorDictReplayBuffer(storage=LazyTensorStorage(args.frames), batch_size=256)
    targets = SoftUpdate(loss, tau=0.01)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-3, fused=True)
    accounting = EpisodeAccounting(args.num_envs, ["cost"])
    rows = []
    for batch in collector:
        episodes = accounting.update(batch)
        limits = constraints.update(batch, episodes)
        multiplier.update(limits)
        loss.prepare(batch, limits)
        buffer.extend(batch.reshape(-1))
        for _ in range(args.updates_per_batch):
            losses = loss(buffer.sample())
            optimizer.zero_grad()
            sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
            optimizer.step()
            targets.step()
        row = episodes.scalars() | {"multiplier": multiplier.value.item()}
        row["loss_qvalue"] = losses["loss_qvalue"].item()
        print("J_r {episode_return:.2f}, J_c {episode_cost:.1f}, λ {multiplier:.2f}".format(**row))
        rows.append(row)
    collector.shutdown()
    return rows


if __name__ == "__main__":
    main()
