"""On-policy algorithms: for every batch advantages, constraints, policy update, critic update."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any, Self

import torch
from omegaconf import DictConfig
from tensordict import TensorDictBase
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.envs import EnvBase

from safe_rl.algorithms.algorithm_contract import (
    Algorithm,
    PolicyUpdate,
    Stateful,
    networks_of_target,
)
from safe_rl.algorithms.constraints import Constraints, check_multiplier
from safe_rl.algorithms.losses import LossState
from safe_rl.algorithms.processor_use import in_parallel
from safe_rl.collectors import EpisodeStatistics
from safe_rl.models import build_networks, make_behaviour, update_running_scales
from safe_rl.objectives import (
    CostGAE,
    CriticLoss,
    JointAdvantages,
    LimitState,
    Multiplier,
    VectorGAE,
)
from safe_rl.objectives.critics import critic_bias
from safe_rl.trust import instantiate


@dataclass
class OnPolicy(Algorithm):
    """PPO, TRPO, CPO and similar algorithms."""

    actor: ProbabilisticTensorDictSequential
    critic: TensorDictModule  # writes ``state_value``, [..., 1]
    cost_critic: TensorDictModule | None  # writes ``cost_value``, [..., k]; or None
    constraints: Constraints
    multiplier: Multiplier | None
    advantage: VectorGAE  # with the critic
    cost_advantage: CostGAE | None  # with the cost critic
    policy_update: PolicyUpdate
    critic_update: PolicyUpdate

    def __post_init__(self) -> None:
        self.schedule = self.constraints.schedule
        self.policy = make_behaviour(self.actor)
        self.networks = {"actor": self.actor, "critic": self.critic}
        if self.cost_critic is not None:
            self.networks["cost_critic"] = self.cost_critic
            self.cost_networks = ["cost_critic"]

    @classmethod
    def from_config(cls, config: DictConfig, env: EnvBase) -> Self:
        """Build networks, estimators, losses and updates.

        Raises:
            ValueError: If a cost limit names a cost that the environment does not have, or a
                constrained algorithm gets no limit.
        """
        device, constraints = torch.device(config.device), Constraints.from_config(config, env)
        multiplier = instantiate(config.get("lagrangian"), cost_limits=constraints.measured_limits)
        if multiplier is not None:
            multiplier.to(device)
        num_costs = len(constraints.keys)
        networks = _build_networks(config, env, num_costs, device, config.model)
        critic, cost_critic = networks["critic"], networks.get("cost_critic")
        optional = {  # what a part may take as well, also one of the user's
            "critic_network": critic,
            "multiplier": multiplier,
            "cost_keys": constraints.keys,
            "cost_limits": constraints.measured_limits,
        }
        cost_advantage = None
        if num_costs:
            node = config.get("cost_advantage")
            if node is None:
                raise ValueError(
                    f"algo={config.algo.name} is constrained and has no cost_advantage."
                )
            cost_advantage = instantiate(node, optional, value_network=cost_critic)
        loss = instantiate(config.loss, optional, actor_network=networks["actor"])
        update = instantiate(config.policy_update, optional, loss=loss)
        if cls is OnPolicy and num_costs:  # a class of the user's may use it elsewhere
            check_multiplier(multiplier, config.loss, config.policy_update, config.cost_advantage)
        return cls(
            **{"cost_critic": None, **networks},
            constraints=constraints,
            multiplier=multiplier,
            advantage=instantiate(config.advantage, value_network=critic),
            cost_advantage=cost_advantage,
            policy_update=update,
            critic_update=instantiate(config.critic_update, loss=CriticLoss(critic, cost_critic)),
        )

    @classmethod
    def build_policy(
        cls, config: DictConfig, env: EnvBase, device: torch.device
    ) -> tuple[TensorDictModuleBase, Mapping[str, nn.Module]]:
        """Build the policy, and the networks that it consists of."""
        # the environment may not have what critics read
        model = {**config.model, "critic_observes": None}
        actor = _build_networks(config, env, 0, device, model)["actor"]
        return make_behaviour(actor), {"actor": actor}

    def learn(self, batch: TensorDictBase, episodes: EpisodeStatistics) -> dict[str, float]:
        """Train on one batch, into which advantages are written; see `Algorithm.learn`."""
        constraints, multiplier = self.constraints, self.multiplier
        limits = constraints.update(batch, episodes)
        if multiplier is not None:
            multiplier.update(limits)
        JointAdvantages(self.advantage, self.cost_advantage)(batch)
        bias = self._critic_bias(batch)
        metrics = self._update(batch, limits)
        constraints.record_prediction(limits, metrics["policy"])
        update_running_scales(self.networks.values(), batch)
        row = constraints.columns(limits, multiplier) | bias
        for network, values in metrics.items():
            for name, value in values.items():
                row |= constraints.column(f"{network}_{name}", torch.as_tensor(value))
        return row

    def _critic_bias(self, batch: TensorDictBase) -> dict[str, float]:
        """Bias of the cost critic: predictions minus the discounted costs that then occurred."""
        if self.cost_advantage is None:
            return {}
        estimator, following = self.cost_advantage, batch["next"]
        keys = estimator.tensor_keys
        costs = torch.cat([following[key] for key in estimator.reward_keys], -1)
        ends = following[keys.done], following[keys.terminated]
        bias = critic_bias(batch[keys.value], costs, *ends, estimator.gamma)
        return self.constraints.column("critic_bias", bias)

    def _update(self, batch: TensorDictBase, limits: LimitState) -> dict[str, Mapping[str, Tensor]]:
        """Improve the policy and fit the critics, in parallel where they are independent."""
        improve = partial(self.policy_update, batch, limits)
        fit = partial(self.critic_update, batch)
        fitting = self.critic_update.loss_modules().values()
        fitted = {p.data_ptr() for module in fitting for p in module.parameters()}
        moved = [self.actor, *self.policy_update.loss_modules().values()]
        # a policy loss may also train a critic
        shares = any(p.data_ptr() in fitted for module in moved for p in module.parameters())
        both = (improve(), fit()) if shares else in_parallel(improve, fit)
        return {"policy": both[0], "critic": both[1]}

    def checkpoint_components(self) -> dict[str, Stateful]:
        """Parts with a state, by name."""
        multiplier = self.multiplier
        kept = [*self.networks.values(), *([] if multiplier is None else [multiplier])]
        losses = LossState(self.policy_update.loss_modules(), saved_elsewhere=kept)
        parts: dict[str, Stateful | None] = {
            **self.networks,
            "multiplier": multiplier,
            # those of this package have no state of their own
            "losses": losses if losses.tensors else None,
            "policy_update": self.policy_update,
            "critic_update": self.critic_update,
            "algorithm": self.constraints,
        }
        return {name: part for name, part in parts.items() if part is not None}


def _build_networks(
    config: DictConfig, env: EnvBase, num_costs: int, device: torch.device, model: Mapping[str, Any]
) -> dict[str, Any]:
    """Networks of the node ``model``, by name; a ``_target_`` builds networks of the user's own."""
    if config.model.get("_target_") is not None:
        return networks_of_target(config.model, env, num_costs, device)
    return build_networks(
        model,
        env.observation_spec,
        env.action_spec,
        env.observation_layout,
        num_costs=num_costs,
        device=device,
        privileged_layout=env.privileged_layout,
    )
