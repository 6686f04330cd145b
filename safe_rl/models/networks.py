"""A Gaussian actor, and the reward and cost critics.

All of them are separate multilayer perceptrons on a flat observation that share no weights
(Ray, Achiam, Amodei 2019, section 5.1).
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from tensordict import NestedKey
from tensordict.nn import (
    AddStateIndependentNormalScale,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
)
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType
from torchrl.modules import MLP, IndependentNormal

from safe_rl.models.scaling import InputScale

__all__ = ["make_actor", "make_critic"]

# The scale of a policy is exp(log std) and must follow it over the whole range in use: the floor
# only keeps a collapsed policy from dividing by zero.
_SCALE_FLOOR = 1e-6


def _mlp(
    in_features: int,
    out_features: int,
    hidden_sizes: Sequence[int],
    input_scale: Tensor | None,
    device: torch.device | None,
) -> nn.Sequential:
    """Tanh perceptron with Glorot-uniform weights, zero biases and a linear output."""
    perceptron = MLP(
        in_features, out_features, num_cells=list(hidden_sizes), activation_class=nn.Tanh,
        device=device,
    )  # fmt: skip
    for layer in perceptron:
        if isinstance(layer, nn.Linear):
            nn.init.xavier_uniform_(layer.weight)
            nn.init.zeros_(layer.bias)
    scaling = [] if input_scale is None else [InputScale(input_scale.to(device))]
    return nn.Sequential(*scaling, *perceptron)


def make_actor(
    observation_size: int,
    action_size: int,
    *,
    hidden_sizes: Sequence[int],
    initial_log_std: float,
    input_scale: Tensor | None = None,
    device: torch.device | None = None,
    in_key: NestedKey = "observation",
    action_key: NestedKey = "action",
    log_prob_key: NestedKey = "action_log_prob",
) -> ProbabilisticTensorDictSequential:
    """Build a diagonal Gaussian policy with a state-independent standard deviation.

    Actions are not squashed: the environment clips them.

    Args:
        observation_size: Length of the flat observation.
        action_size: Length of the action.
        hidden_sizes: Width of every hidden layer.
        initial_log_std: Initial logarithm of the standard deviation.
        input_scale: Fixed factors, shape [observation_size], or None.
        device: Device of the parameters.
        in_key: Key of the observation.
        action_key: Key of the action.
        log_prob_key: Key of the action's log-probability, shape [...] without a trailing 1.

    Returns:
        A module with ``get_dist`` that writes ``loc``, ``scale``, the action and its
        log-probability.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> actor = make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5)
        >>> sample = actor(TensorDict({"observation": torch.zeros(5, 3)}, [5]))
        >>> sample["action"].shape, sample["action_log_prob"].shape
        (torch.Size([5, 2]), torch.Size([5]))
    """
    parameters = nn.Sequential(
        _mlp(observation_size, action_size, hidden_sizes, input_scale, device),
        AddStateIndependentNormalScale(
            action_size, init_value=initial_log_std, scale_lb=_SCALE_FLOOR, device=device
        ),
    )
    return ProbabilisticTensorDictSequential(
        TensorDictModule(parameters, in_keys=[in_key], out_keys=["loc", "scale"]),
        ProbabilisticTensorDictModule(
            in_keys=["loc", "scale"],
            out_keys=[action_key],
            distribution_class=IndependentNormal,
            return_log_prob=True,
            log_prob_key=log_prob_key,
            default_interaction_type=ExplorationType.RANDOM,
        ),
    )


def make_critic(
    observation_size: int,
    *,
    hidden_sizes: Sequence[int],
    input_scale: Tensor | None = None,
    device: torch.device | None = None,
    in_key: NestedKey = "observation",
    out_key: NestedKey = "state_value",
    num_outputs: int = 1,
) -> TensorDictModule:
    """Build a state-value network that writes ``out_key``, shape [..., num_outputs].

    Args:
        observation_size: Length of the flat observation.
        hidden_sizes: Width of every hidden layer.
        input_scale: Fixed factors, shape [observation_size], or None.
        device: Device of the parameters.
        in_key: Key of the observation.
        out_key: Key of the value.
        num_outputs: Number of values: 1 for the reward, the number of constrained costs for them.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> critic = make_critic(3, hidden_sizes=[8], out_key="cost_value", num_outputs=2)
        >>> critic(TensorDict({"observation": torch.zeros(5, 3)}, [5]))["cost_value"].shape
        torch.Size([5, 2])
    """
    network = _mlp(observation_size, num_outputs, hidden_sizes, input_scale, device)
    return TensorDictModule(network, in_keys=[in_key], out_keys=[out_key])
