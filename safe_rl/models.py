"""Networks: a Gaussian actor, its fast behaviour policy, and the reward and cost critics.

All of them are separate multilayer perceptrons on a flat observation that share no weights
(Ray, Achiam, Amodei 2019, section 5.1).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import torch
from tensordict import NestedKey, TensorDictBase
from tensordict.nn import (
    AddStateIndependentNormalScale,
    ProbabilisticTensorDictModule,
    ProbabilisticTensorDictSequential,
    TensorDictModule,
    TensorDictModuleBase,
)
from torch import Tensor, nn
from torchrl.envs.utils import ExplorationType, exploration_type
from torchrl.modules import MLP, IndependentNormal

__all__ = [
    "BehaviourPolicy",
    "InputScale",
    "input_scale_vector",
    "make_actor",
    "make_critic",
]

# The scale of a policy is exp(log std) and must follow it over the whole range in use: the floor
# only keeps a collapsed policy from dividing by zero.
_SCALE_FLOOR = 1e-6


class InputScale(nn.Module):
    """Multiply the input by a fixed vector, so that all its components have similar ranges.

    Args:
        scale: Factors, shape [n], one per input component.

    Examples:
        >>> import torch
        >>> InputScale(torch.tensor([0.1, 1.0]))(torch.tensor([[20.0, 3.0]]))
        tensor([[2., 3.]])
    """

    scale: Tensor

    def __init__(self, scale: Tensor) -> None:
        super().__init__()
        self.register_buffer("scale", scale.detach().clone())

    def forward(self, inputs: Tensor) -> Tensor:
        """Scale ``inputs``, shape [..., n]."""
        return inputs * self.scale


def input_scale_vector(
    factors: Mapping[str, float], layout: Mapping[str, slice], device: torch.device | None = None
) -> Tensor | None:
    """Turn factors per observation component into one factor per column.

    Args:
        factors: Component name -> factor. Components not named keep the factor 1.
        layout: Component name -> columns of the flat observation.
        device: Device of the result.

    Returns:
        Factors, shape [n] with n the number of columns, or None if none of the named components is
        observed. A name that is absent from ``layout`` is skipped, because one configuration serves
        robots with different sensors.

    Raises:
        ValueError: If a factor is not a positive finite number.

    Examples:
        >>> input_scale_vector({"gyro": 0.5}, {"gyro": slice(0, 2), "lidar": slice(2, 3)})
        tensor([0.5000, 0.5000, 1.0000])
    """
    for name, factor in factors.items():
        if not (math.isfinite(factor) and factor > 0):
            raise ValueError(
                f"The input scale of '{name}' is {factor}: it must be positive and finite. "
                "Remove the entry to leave the component as it is."
            )
    observed = {name: factor for name, factor in factors.items() if name in layout}
    if not observed:
        return None
    scale = torch.ones(max(columns.stop for columns in layout.values()), device=device)
    for name, factor in observed.items():
        scale[layout[name]] = factor
    return scale


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


class BehaviourPolicy(TensorDictModuleBase):
    """Sample a Gaussian actor in one module, without distribution objects.

    It shares the actor's parameters and writes what the actor writes: ``loc``, ``scale``, the
    action and its log-probability. While an environment is stepped with small batches, most of the
    actor's time goes into building distributions and nesting modules, which this class leaves out.
    Under ``set_exploration_type(ExplorationType.DETERMINISTIC)`` the action is ``loc``.

    Args:
        actor: Policy made by :func:`make_actor`, or any ``ProbabilisticTensorDictSequential``
            whose first module maps one key to ``loc`` and ``scale`` and whose distribution is a
            diagonal Gaussian.

    Raises:
        TypeError: If the actor's distribution is not ``IndependentNormal``.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> policy = BehaviourPolicy(make_actor(3, 2, hidden_sizes=[8], initial_log_std=-0.5))
        >>> policy(TensorDict({"observation": torch.zeros(5, 3)}, [5]))["scale"][0]
        tensor([0.6065, 0.6065], grad_fn=<SelectBackward0>)
    """

    def __init__(self, actor: ProbabilisticTensorDictSequential) -> None:
        super().__init__()
        parameters, sampler = actor.module[0], actor.module[-1]
        if len(actor.module) != 2 or sampler.distribution_class is not IndependentNormal:
            raise TypeError(
                "BehaviourPolicy samples a network followed by an IndependentNormal, got "
                f"{len(actor.module)} modules and {sampler.distribution_class.__name__}. Hand the "
                "actor itself to the collector instead."
            )
        self.network = parameters.module
        self.in_keys = list(parameters.in_keys)
        self.out_keys = [*parameters.out_keys, *sampler.out_keys]

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Write the distribution's parameters, the action and its log-probability."""
        loc, scale = self.network(tensordict.get(self.in_keys[0]))
        if exploration_type() is ExplorationType.DETERMINISTIC:
            noise = torch.zeros_like(loc)
        else:
            noise = torch.randn_like(loc)
        # log N(loc + scale * noise; loc, scale) in terms of the noise alone
        log_prob = -0.5 * noise.square().sum(-1) - scale.log().sum(-1)
        log_prob = log_prob - 0.5 * math.log(2 * math.pi) * loc.shape[-1]
        outputs = (loc, scale, torch.addcmul(loc, scale, noise), log_prob)
        for key, value in zip(self.out_keys, outputs, strict=True):
            tensordict.set(key, value)
        return tensordict
