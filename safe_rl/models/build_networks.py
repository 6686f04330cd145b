"""Build networks from a configuration's node ``model`` and an environment's specs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import torch
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModule, TensorDictModuleBase
from torch import nn
from torchrl.data import Composite, TensorSpec

from safe_rl.models.encoders import (
    FEATURES,
    RECURRENT,
    Body,
    Observed,
    RecurrentLayer,
    observed_by,
    observed_entries,
)
from safe_rl.models.heads import AUTO, Head, make_head
from safe_rl.models.networks import Chain, RunningScale, Tanh, assemble_actor, perceptron

_AS_IT_IS: Mapping[str, Any] = {"vector": []}


def build_networks(
    model: Mapping[str, Any],
    observation_spec: Composite,
    action_spec: TensorSpec,
    layout: Mapping[str, slice],
    *,
    num_costs: int,
    device: torch.device,
    privileged_layout: Mapping[str, slice] | None = None,
) -> dict[str, Any]:
    """Build an actor, a reward critic and, for ``num_costs`` > 0, a cost critic.

    They share no weights. Critics are not recurrent; with a recurrent actor, its state is one of
    their inputs.

    Args:
        model: Node ``model`` of a configuration as composed from ``conf/``.
        observation_spec: That of N environments.
        action_spec: That of N environments.
        layout: Component -> columns of the flat observation.
        num_costs: Outputs of the cost critic.
        device: Device of all parameters.
        privileged_layout: Component -> columns of the entry ``privileged``.

    Raises:
        ValueError: If the configuration does not fit the environment.
    """
    layouts = {"observation": layout, "privileged": privileged_layout or {}}
    observed = observed_by(model, observation_spec, layouts)
    read = model.get("critic_observes") or ["observation"]
    seen = observed._replace(entries=observed_entries(observation_spec, read))
    widths = list(model["hidden_sizes"])
    recurrent_size = model["memory"]["size"] if model.get("memory") else 0
    if recurrent_size and RECURRENT not in observation_spec.keys():  # noqa: SIM118, a spec is no mapping
        raise ValueError(
            "A recurrent policy needs the transform that keeps its state between steps: choose "
            "model=gru instead of setting model.memory alone."
        )
    kind, log_std = model.get("head") or AUTO, model["initial_log_std"]
    head = make_head(kind, action_spec, initial_log_std=log_std, device=device)
    actor = _actor(observed, head, widths, recurrent_size, device)

    def critic(num_outputs: int, out_key: str) -> TensorDictModule:
        body = _body(seen, num_outputs, widths, recurrent_size, device)
        in_keys = [*seen.keys, RECURRENT] if recurrent_size else seen.keys
        return TensorDictModule(body, in_keys=in_keys, out_keys=[out_key])

    networks: dict[str, Any] = {"actor": actor, "critic": critic(1, "state_value")}
    if num_costs:
        networks["cost_critic"] = critic(num_costs, "cost_value")
    return networks


def _actor(
    observed: Observed, head: Head, widths: Sequence[int], recurrent_size: int, device: torch.device
) -> ProbabilisticTensorDictSequential:
    """Hidden layers and a head; a recurrent layer between them if ``recurrent_size`` is not 0."""
    if not recurrent_size:
        body = _body(observed, head.num_outputs, widths, 0, device)
        return assemble_actor(body, head, in_keys=observed.keys)
    if not widths:
        raise ValueError(
            "model.hidden_sizes=[]: a recurrent policy needs at least one hidden layer."
        )
    encoder = Chain(_body(observed, widths[-1], widths[:-1], 0, device), Tanh())
    before: list[TensorDictModuleBase] = [
        TensorDictModule(encoder, in_keys=observed.keys, out_keys=[FEATURES]),
        RecurrentLayer(widths[-1], recurrent_size, device=device),
    ]
    body = perceptron(recurrent_size, head.num_outputs, [], None, device)
    return assemble_actor(body, head, in_keys=[FEATURES], before=before)


def _body(
    observed: Observed,
    num_outputs: int,
    widths: Sequence[int],
    recurrent_size: int,
    device: torch.device,
) -> nn.Module:
    """From observations and the recurrent state to outputs; a plain perceptron where possible."""
    first = observed.entries[0]
    if observed.encoders is not None or recurrent_size or len(observed.entries) > 1:
        plain = observed._replace(encoders=observed.encoders or _AS_IT_IS)
        return Body(plain, num_outputs, widths, extra=recurrent_size, device=device)
    size = first.shape[0]
    if observed.clip is None:
        return perceptron(size, num_outputs, widths, observed.scale(first), device)
    running = RunningScale(size, key=first.key, clip=observed.clip, device=device)
    return nn.Sequential(running, *perceptron(size, num_outputs, widths, None, device))
