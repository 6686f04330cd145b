"""Ensembles of Q functions, for off-policy algorithms."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import torch
from tensordict import NestedKey, TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torch.func import functional_call

from safe_rl.models.input_scales import InputScale

Layers = Sequence[tuple[Tensor, Tensor]]


class EnsembleMLP(nn.Module):
    """E ReLU perceptrons that are evaluated together by one batched matrix product per layer.

    Its overhead is a fraction of that of `torch.func.vmap` over modules.

    Args:
        num_networks: E.
        sizes: Numbers of inputs, of units of every hidden layer, and of outputs.
        device: Device of the parameters.

    Examples:
        >>> EnsembleMLP(2, [3, 8, 1])(torch.zeros(5, 3)).shape
        torch.Size([2, 5, 1])
    """

    def __init__(
        self, num_networks: int, sizes: Sequence[int], device: torch.device | None = None
    ) -> None:
        super().__init__()
        self.num_networks = num_networks
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for fan_in, fan_out in pairwise(sizes):
            # the initial weights of torch.nn.Linear
            bound = fan_in**-0.5
            for rows, parameters in ((fan_in, self.weights), (1, self.biases)):
                values = torch.empty(num_networks, rows, fan_out, device=device)
                parameters.append(nn.Parameter(values.uniform_(-bound, bound)))

    def forward(self, inputs: Tensor, layers: Layers | None = None) -> Tensor:
        """Return outputs [E, …, n] of all networks for inputs […, m].

        Args:
            inputs: The same for every network.
            layers: Parameters to use instead of the own ones, as `layers` returns them.
        """
        hidden = inputs.reshape(-1, inputs.shape[-1]).expand(self.num_networks, -1, -1)
        for number, (weight, bias) in enumerate(self.layers() if layers is None else layers):
            # in place, because the backward pass of a ReLU needs only its output
            hidden = torch.baddbmm(bias, hidden.relu_() if number else hidden, weight)
        return hidden.reshape(self.num_networks, *inputs.shape[:-1], hidden.shape[-1])

    def layers(self, params: TensorDictBase | None = None) -> Layers:
        """Return weights [E, m, n] and biases [E, 1, n] of every layer.

        Args:
            params: Parameters with the same names as the own ones; None takes these.
        """
        if params is None:
            return list(zip(self.weights, self.biases, strict=True))
        names = map(str, range(len(self.weights)))
        return [(params["weights", name], params["biases", name]) for name in names]


class QEnsemble(TensorDictModuleBase):
    """E Q functions of observation and action as one module, without vmap.

    Args:
        observation_size: Length of the flat observation, or of all entries before the action
            together.
        action_size: Length of the action.
        hidden_sizes: Width of every hidden layer.
        num_networks: E.
        num_outputs: Values per network: 1 for the reward, K for K costs.
        input_scale: Fixed factors of these entries, or None.
        device: Device of the parameters.
        encoder: Module from these entries to the `observation_size` inputs of all networks, which
            share it; None: the entries side by side.
        in_keys: Keys of the observation (and of further entries that critics read) and the action.
        out_key: Key of the values.

    Examples:
        >>> q = QEnsemble(3, 2, hidden_sizes=[8], num_networks=2)
        >>> steps = TensorDict(observation=torch.zeros(5, 3), action=torch.zeros(5, 2))
        >>> q(steps.auto_batch_size_(1))["state_action_value"].shape
        torch.Size([2, 5, 1])
    """

    def __init__(
        self,
        observation_size: int,
        action_size: int,
        *,
        hidden_sizes: Sequence[int],
        num_networks: int,
        num_outputs: int = 1,
        input_scale: Tensor | None = None,
        device: torch.device | None = None,
        encoder: nn.Module | None = None,
        in_keys: Sequence[NestedKey] = ("observation", "action"),
        out_key: NestedKey = "state_action_value",
    ) -> None:
        super().__init__()
        self.in_keys, self.out_keys = list(in_keys), [out_key]
        self.num_networks, self.encoder = num_networks, encoder
        self.scale = nn.Identity() if input_scale is None else InputScale(input_scale.to(device))
        sizes = [observation_size + action_size, *hidden_sizes, num_outputs]
        self.network = EnsembleMLP(num_networks, sizes, device)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Return values [E, …, n] in a new TensorDict of shape [E, …], for steps […]."""
        *entries, action = (tensordict[key] for key in self.in_keys)
        values = self.values(entries, action)
        return TensorDict({self.out_keys[0]: values}, batch_size=values.shape[:-1])

    def values(
        self, entries: Sequence[Tensor], action: Tensor, layers: tuple[Any, Layers] | None = None
    ) -> Tensor:
        """Return values [E, …, n]: `forward` without TensorDicts, with own or given parameters."""
        encoding, own = (None, None) if layers is None else layers
        if self.encoder is None:
            inputs = self.scale(entries[0] if len(entries) == 1 else torch.cat([*entries], -1))
        elif encoding is None:
            inputs = self.encoder(*entries)
        else:
            inputs = functional_call(self.encoder, encoding, tuple(entries))
        return self.network(torch.cat([inputs, action], -1), own)

    def layers(self, params: TensorDictBase) -> tuple[Any, Layers]:
        """Convert parameters with the same names as the own ones to the argument of `values`."""
        encoding = None
        if self.encoder is not None:
            flat = params["encoder"].flatten_keys(".")
            encoding = {str(name): value for name, value in flat.items()}
        return encoding, self.network.layers(params["network"])
