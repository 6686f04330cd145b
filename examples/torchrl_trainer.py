"""Train with TorchRL's own trainers: its `PPOTrainer`, and a `Trainer` that takes CPO steps.

    python examples/torchrl_trainer.py --algo ppo_lagrangian --env PointGoal1 --frames 300_000
    python examples/torchrl_trainer.py --algo cpo

Loss, advantages, constraints and steps are from this package; loop, buffer, logging hooks and
checkpoints are from TorchRL. `train.py` does all of this, and more, from configurations.
"""

from __future__ import annotations

import safe_rl  # isort: skip  # noqa: F401, before torch, so that idle threads sleep

import argparse
import functools
import warnings
from collections.abc import Mapping

import torch
from tensordict import TensorDict, TensorDictBase
from torchrl.data import LazyTensorStorage, ReplayBuffer, SamplerWithoutReplacement
from torchrl.trainers import Trainer
from torchrl.trainers.algorithms import PPOTrainer
from torchrl.trainers.trainers import OptimizationStepper, ValueEstimatorHook

from safe_rl.algorithms import Constraints, CPOStep, MinibatchUpdate
from safe_rl.collectors import EpisodeAccounting, make_collector
from safe_rl.envs import ConstrainedEnv, make_env
from safe_rl.models import make_actor, make_critic
from safe_rl.objectives import (
    ActorCriticLoss,
    CostGAE,
    CPOLoss,
    CriticLoss,
    JointAdvantages,
    LagrangeMultiplier,
    PPOLagrangianLoss,
    VectorGAE,
)

DISCOUNT = {"gamma": 0.99, "lmbda": 0.97, "value_target": "lambda_return"}


class Parts:
    """What both trainers share, for an environment and limits by cost key."""

    def __init__(
        self, env: ConstrainedEnv, limits: Mapping[str, float], frames_per_batch: int
    ) -> None:
        size, keys = env.observation_spec["observation"].shape[-1], list(limits)
        layers = {"hidden_sizes": [64, 64], "device": env.device}
        self.actor = make_actor(size, env.action_spec.shape[-1], initial_log_std=-0.5, **layers)
        critic = make_critic(size, **layers)
        cost_critic = make_critic(size, num_outputs=len(keys), out_key="cost_value", **layers)
        self.critic_loss = CriticLoss(critic, cost_critic)
        self.advantages = JointAdvantages(
            VectorGAE(critic, **DISCOUNT), CostGAE(keys, cost_critic, **DISCOUNT)
        )
        self.accounting = EpisodeAccounting(env.batch_size.numel(), keys, device=env.device)
        self.collector = make_collector(env, self.actor, frames_per_batch=frames_per_batch)
        self.constraints = Constraints(limits, max_length=env.max_episode_steps)

    def add_limits(
        self,
        trainer: Trainer,
        multiplier: LagrangeMultiplier | None = None,
        loss: PPOLagrangianLoss | None = None,
    ) -> None:
        """Let a trainer update limits, multiplier and loss with every batch, and log them."""

        def update(batch: TensorDictBase) -> TensorDictBase:
            episodes = self.accounting.update(batch)
            self.limits = self.constraints.update(batch, episodes)
            if multiplier is not None and loss is not None:
                multiplier.update(self.limits)
                loss.prepare(batch, self.limits)
            self.row = episodes.scalars() | self.constraints.columns(self.limits, multiplier)
            return batch

        trainer.register_op("batch_process", update)
        trainer.register_op("pre_steps_log", lambda batch: self.row)


class CPOStepper(OptimizationStepper):
    """A CPO step, and a fit of the critics, on the whole batch of a trainer."""

    def __init__(self, parts: Parts, policy_update: CPOStep, critic_update: MinibatchUpdate):
        self.parts, self.policy_update, self.critic_update = parts, policy_update, critic_update

    def step(self, trainer: Trainer, sub_batch: TensorDictBase) -> TensorDict:
        """Improve the policy, then the critics."""
        row: dict[str, float] = {}
        for name, value in self.policy_update(sub_batch, self.parts.limits).items():
            row |= self.parts.constraints.column(name, torch.as_tensor(value))
        self.critic_update(sub_batch)
        return TensorDict({name: torch.as_tensor(value) for name, value in row.items()})


def ppo_lagrangian_trainer(
    env: ConstrainedEnv, limits: Mapping[str, float], frames: int, frames_per_batch: int
) -> PPOTrainer:
    """TorchRL's PPO trainer on the Lagrangian."""
    parts = Parts(env, limits, frames_per_batch)
    multiplier = LagrangeMultiplier(limits, init=1.0, lr=0.05)
    policy_loss = PPOLagrangianLoss(parts.actor, multiplier, clip_epsilon=0.2, entropy_coeff=0.0)
    loss = ActorCriticLoss(policy_loss, parts.critic_loss, critic_coeff=1.0)
    buffer = ReplayBuffer(
        storage=LazyTensorStorage(frames_per_batch),
        sampler=SamplerWithoutReplacement(),
        batch_size=frames_per_batch // 5,
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # TorchRL calls its trainers experimental
        trainer = PPOTrainer(
            collector=parts.collector,
            total_frames=frames,
            frame_skip=1,
            optim_steps_per_batch=None,  # passes of the whole buffer
            loss_module=loss,
            optimizer=torch.optim.Adam(loss.parameters(), lr=3e-4),
            replay_buffer=buffer,
            num_epochs=4,
            gae=parts.advantages,
            progress_bar=False,
        )
    parts.add_limits(trainer, multiplier, policy_loss)
    return trainer


def cpo_trainer(
    env: ConstrainedEnv, limits: Mapping[str, float], frames: int, frames_per_batch: int
) -> Trainer:
    """TorchRL's trainer with a CPO step in place of its optimiser."""
    parts = Parts(env, limits, frames_per_batch)
    policy_loss = CPOLoss(parts.actor, entropy_coeff=0.0)
    step = CPOStep(
        policy_loss,
        target_kl=0.01,
        damping=0.1,
        cg_iterations=10,
        backtrack_coeff=0.8,
        max_backtracks=10,
    )
    critic_update = MinibatchUpdate(
        parts.critic_loss,
        optimizer=functools.partial(torch.optim.Adam, lr=1e-3),
        num_passes=10,
        minibatch_size=frames_per_batch // 5,
    )
    trainer = Trainer(
        collector=parts.collector,
        total_frames=frames,
        frame_skip=1,
        optim_steps_per_batch=1,
        loss_module=ActorCriticLoss(policy_loss, parts.critic_loss, critic_coeff=1.0),
        optimization_stepper=CPOStepper(parts, step, critic_update),
        progress_bar=False,
    )
    parts.add_limits(trainer)
    ValueEstimatorHook(parts.advantages).register(trainer)
    return trainer


TRAINERS = {"ppo_lagrangian": ppo_lagrangian_trainer, "cpo": cpo_trainer}


def main(arguments: list[str] | None = None) -> Trainer:
    """Train, print a line per batch, and return the trainer."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--algo", choices=TRAINERS, default="ppo_lagrangian")
    parser.add_argument("--env", default="PointGoal1")
    parser.add_argument("--limit", type=float, default=25.0)
    parser.add_argument("--frames", type=int, default=200_000)
    parser.add_argument("--frames-per-batch", type=int, default=20_000)
    parser.add_argument("--num-envs", type=int, default=20)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(arguments)
    torch.manual_seed(args.seed)
    env = make_env(args.env, num_envs=args.num_envs, seed=args.seed)
    trainer = TRAINERS[args.algo](env, {"cost": args.limit}, args.frames, args.frames_per_batch)
    trainer.train()
    history = trainer._log_dict
    for row in zip(history["episode_return"], history["episode_cost"], strict=True):
        print("J_r {:.2f}, J_c {:.1f}".format(*row))
    return trainer


if __name__ == "__main__":
    main()
