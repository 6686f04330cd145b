"""Off-policy algorithms: a replay buffer, and gradient steps on its minibatches."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Self

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.envs import EnvBase

from safe_rl.algorithms.algorithm_contract import Algorithm, Stateful, networks_of_target
from safe_rl.algorithms.constraints import Constraints, check_multiplier
from safe_rl.algorithms.dataset import fill_replay_buffer
from safe_rl.algorithms.replay_buffer import Memory
from safe_rl.algorithms.replay_update import ReplayUpdate
from safe_rl.collectors import EpisodeStatistics
from safe_rl.models import ExploringPolicy, QEnsemble
from safe_rl.models.build_networks import Codes, Observed, observed_by, observed_entries
from safe_rl.models.replay_networks import bounded_actions
from safe_rl.objectives import CostValues, MeanCosts, Multiplier
from safe_rl.resumable import Resumable
from safe_rl.trust import instantiate

_ON_POLICY_ONLY = ("memory", "normalise")


@dataclass
class OffPolicy(Resumable, Algorithm):
    """SAC, TD3 and similar algorithms.

    The multiplier follows the undiscounted costs of episodes, not the discounted critics. Learning
    begins when the replay buffer holds as many steps as the first, random ones.
    """

    state_names = ("steps", "constraints")

    policy: ExploringPolicy  # with the actor's parameters
    networks: Mapping[str, nn.Module]  # actor, critic and, with constraints, cost critic
    constraints: Constraints
    multiplier: Multiplier | None
    replay_buffer: Memory
    policy_update: ReplayUpdate  # trains all networks on minibatches
    random_steps: int  # environment steps with random actions, 0 if nothing is collected
    steps_per_decision: int = 1  # environment steps per transition
    collects: bool = True  # whether collected transitions go into the replay buffer
    learns_from: str = ""
    steps: int = 0  # environment steps so far

    def __post_init__(self) -> None:
        self.schedule = self.constraints.schedule
        self.cost_networks = [name for name in self.networks if name == "cost_critic"]
        self._choose_exploration()

    @classmethod
    def from_config(cls, config: DictConfig, env: EnvBase) -> Self:
        """Build networks, replay buffer, losses and updates.

        Raises:
            ValueError: If parts of the configuration do not fit together, the environment (whose
                actions must have bounds), or the dataset.
            FileNotFoundError: If there is no such dataset.
        """
        device, constraints = torch.device(config.device), Constraints.from_config(config, env)
        limits = constraints.measured_limits
        multiplier = instantiate(config.get("lagrangian"), cost_limits=limits)
        if multiplier is not None:
            multiplier.to(device)
        cost_values = instantiate(config.critics.get("cost_values"))
        read = config.model.get("critic_observes")
        networks = _build_networks(config, env, len(limits), device, cost_values, read)
        loss = instantiate(
            config.loss,
            {
                "qvalue_network": networks.get("critic"),
                "cost_qvalue_network": networks.get("cost_critic"),
                "action_spec": bounded_actions(env).to(device),
                "multiplier": multiplier,
                "cost_keys": constraints.keys,
                "cost_values": cost_values,
                "cost_limits": limits,
            },
            actor_network=networks["actor"],
        )
        if cls is OffPolicy:  # a class of the user's may use it elsewhere
            check_multiplier(multiplier, config.loss)
        update = instantiate(config.policy_update, loss=loss)
        buffer = instantiate(
            config.memory,
            in_keys=loss.in_keys,
            summed=["reward", *constraints.keys],
            gamma=config.loss.get("gamma", 1.0),
            device=device,
            example=env.fake_tensordict(),
        )
        learns_from, collects = fill_replay_buffer(config, buffer, env)
        random_steps = config.exploration.random_steps if collects else 0
        _check_room(buffer, random_steps // env.steps_per_decision, collects)
        policy = exploring_policy(networks["actor"], env, config.exploration.noise)
        if policy.noise and policy.samples:
            raise ValueError(
                f"exploration.noise={policy.noise}: the policy of algo={config.algo.name} samples "
                "its actions, so noise has no effect."
            )
        return cls(
            policy=policy,
            networks=networks,
            constraints=constraints,
            multiplier=multiplier,
            replay_buffer=buffer,
            policy_update=update,
            random_steps=random_steps,
            steps_per_decision=env.steps_per_decision,
            collects=collects,
            learns_from=learns_from,
        )

    @classmethod
    def build_policy(
        cls, config: DictConfig, env: EnvBase, device: torch.device
    ) -> tuple[TensorDictModuleBase, Mapping[str, nn.Module]]:
        """Build the policy for evaluation, without exploration noise."""
        actor = _build_networks(config, env, 0, device)["actor"]
        return exploring_policy(actor, env, 0.0), {"actor": actor}

    @property
    def lost_on_resume(self) -> str:
        """A sentence on the state that a checkpoint does not have; empty if it has all of it."""
        buffer = self.replay_buffer
        if buffer.keeps or not self.collects:
            return ""
        when = "with those of the dataset alone"
        if not len(buffer):
            when = f"when it holds {self.random_steps // self.steps_per_decision:,} new ones"
        return (
            "The transitions in its replay buffer are not stored (memory.keep=false): learning "
            f"resumes {when}, and differs from a run that was not interrupted."
        )

    def learn(self, batch: TensorDictBase, episodes: EpisodeStatistics) -> dict[str, float]:
        """Store a batch and take the gradient steps that are due; see `Algorithm.learn`."""
        constraints, multiplier = self.constraints, self.multiplier
        row: dict[str, float] = {}
        if constraints.keys:
            limits = constraints.update(batch, episodes)
            if multiplier is not None:
                multiplier.update(limits)
            self.policy_update.loss.prepare(batch, limits)
            row = constraints.columns(limits, multiplier)
        bias = self.policy_update.loss.cost_bias(batch)
        if self.collects:
            self.replay_buffer.extend(batch)
        steps = batch.numel() * self.steps_per_decision
        self.steps += steps
        self._choose_exploration()
        needed = max(self.random_steps // self.steps_per_decision, self.replay_buffer.batch_size)
        number = self.policy_update.due(steps) if len(self.replay_buffer) >= needed else 0
        row |= {} if bias is None else constraints.column("critic_bias", bias)
        for name, value in self.policy_update(self.replay_buffer, number).items():
            row |= constraints.column(f"policy_{name}", value)
        return row

    def networks_replaced(self) -> None:
        """Copy the networks, which got another run's weights, into the target networks."""
        self.policy_update.equate_targets()

    def forget_open_episodes(self) -> None:
        """End n-step sums: the next steps belong to new episodes."""
        self.replay_buffer.end_rows()

    def _choose_exploration(self) -> None:
        self.policy.is_random.fill_(self.steps < self.random_steps)

    def load_state_dict(self, state_dict: Mapping[str, Any]) -> None:
        """Continue from `state_dict`."""
        super().load_state_dict(state_dict)
        self._choose_exploration()  # it is not saved, because it follows from the steps

    def checkpoint_components(self) -> dict[str, Stateful]:
        """Parts with a state, by name; the replay buffer only with ``memory.keep``."""
        parts: dict[str, Stateful | None] = {
            **self.networks,
            "multiplier": self.multiplier,
            "policy_update": self.policy_update,
            "algorithm": self,
            "memory": self.replay_buffer if self.replay_buffer.keeps else None,
        }
        return {name: part for name, part in parts.items() if part is not None}


def _check_room(buffer: Memory, random_steps: int, collects: bool) -> None:
    """Refuse a replay buffer that is too small for learning to begin."""
    size = buffer.batch_size
    needed = f"a minibatch of {size} (memory.batch_size), or nothing is ever learned."
    if not collects and size > len(buffer):
        raise ValueError(
            f"dataset.alone=true: the replay buffer holds {len(buffer):,} transitions of the "
            f"dataset and gets no others. It must hold {needed}"
        )
    if max(random_steps, size) > buffer.capacity:
        raise ValueError(
            f"memory.capacity={buffer.capacity}: it must hold {random_steps} transitions, those "
            f"of exploration.random_steps, and {needed}"
        )


def exploring_policy(actor: TensorDictModuleBase, env: EnvBase, noise: float) -> ExploringPolicy:
    """The exploring policy of an actor, within the bounds of an environment's actions."""
    spec = bounded_actions(env)
    return ExploringPolicy(actor, spec.low, spec.high, noise=noise)


def _build_networks(
    config: DictConfig,
    env: EnvBase,
    num_costs: int,
    device: torch.device,
    cost_values: CostValues | None = None,
    critic_observes: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Build the actor and, unless their number in ``critics`` is 0, critics of reward and costs.

    Critics read the entries `critic_observes`, by default the observation; in evaluation the
    environment may not have others. Cost critics return what `cost_values` says, by default means.

    Raises:
        ValueError: If actions have no bounds, the model does not fit the observation or is for
            on-policy algorithms only, or the environment lacks an entry that critics read.
    """
    model, spec = config.model, bounded_actions(env)
    cost_values = MeanCosts() if cost_values is None else cost_values
    outputs = num_costs * cost_values.outputs
    if model.get("_target_") is not None:
        more = {"action_spec": spec, "cost_outputs": outputs}
        return networks_of_target(model, env, num_costs, device, **more)
    if others := [key for key in _ON_POLICY_ONLY if model.get(key)]:
        raise ValueError(
            f"algo={config.algo.name}: model.{others[0]} is for on-policy algorithms. Use "
            "model=mlp, model=cnn or model=dict without it."
        )
    common: dict[str, Any] = {"hidden_sizes": list(model.hidden_sizes), "device": device}
    layouts = {"observation": env.observation_layout, "privileged": env.privileged_layout}
    seen = observed_by(model, env.observation_spec, layouts)
    bounds = {"low": spec.low, "high": spec.high}
    networks = {"actor": instantiate(config.actor, **_inputs(seen, device), **bounds, **common)}
    common["action_size"] = len(spec.low)
    if critic_observes:
        seen = seen._replace(entries=observed_entries(env.observation_spec, critic_observes))
    if number := config.critics.rewards:
        inputs = _inputs(seen, device, "action")
        networks["critic"] = QEnsemble(num_networks=number, **inputs, **common)
    if num_costs and (number := config.critics.costs):
        networks["cost_critic"] = QEnsemble(
            num_networks=number * cost_values.networks,
            num_outputs=outputs,
            out_key="cost_state_action_value",
            **_inputs(seen, device, "action"),
            **common,
        )
    return networks


def _inputs(observed: Observed, device: torch.device, *further: str) -> dict[str, Any]:
    """Arguments of a network for observed entries, and keys of further ones, with a new encoder."""
    # an actor of the user's need not take keys that vectors do not need
    needs_keys = further or observed.encoders or observed.keys != ["observation"]
    keys = {"in_keys": [*observed.keys, *further]} if needs_keys else {}
    if observed.encoders is None:
        size = sum(entry.shape[0] for entry in observed.entries)
        return {"observation_size": size, "input_scale": observed.scales(), **keys}
    codes = Codes(observed, device)
    return {"observation_size": codes.size, "encoder": codes, **keys}
