"""A trained policy as ONNX: a function from observations to actions for other programs."""

from __future__ import annotations

import logging
import warnings
from pathlib import Path

import torch
from omegaconf import DictConfig
from tensordict import TensorDict
from tensordict.nn import TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs import EnvBase

from safe_rl.evaluation.episodes import exploration
from safe_rl.evaluation.loading import load_policy
from safe_rl.extras import import_extra
from safe_rl.files import replacing

__all__ = ["export_onnx"]


class _MeanAction(nn.Module):
    """Observations [N, D] to actions within the environment's bounds, [N, A]."""

    _low: Tensor
    _high: Tensor

    def __init__(self, policy: TensorDictModuleBase, low: Tensor, high: Tensor) -> None:
        super().__init__()
        self._policy = policy
        self.register_buffer("_low", low)
        self.register_buffer("_high", high)

    def forward(self, observation: Tensor) -> Tensor:
        given = TensorDict({"observation": observation}, batch_size=observation.shape[:1])
        action: Tensor = self._policy(given)["action"]
        return torch.minimum(torch.maximum(action, self._low), self._high)


def export_onnx(config: DictConfig, env: EnvBase, checkpoint: Path, file: Path) -> None:
    """Write a policy's mean action as a function of the observation, scaling of inputs included.

    The input ``observation`` is float32 [N, D] for any N, the output ``action`` [N, A].

    Args:
        config: Of the run.
        env: An environment like the run's, whose observations and actions are the policy's.
        checkpoint: The file with the weights.
        file: What is written.

    Raises:
        ModuleNotFoundError: If the extra ``onnx`` is not installed.
        ValueError: If observations are no vectors, or actions no numbers within bounds, or the
            policy remembers earlier observations.
        CheckpointError: If the checkpoint does not fit the environment.
    """
    import_extra("onnx", "onnx")
    observation, action = env.observation_spec["observation"], env.action_spec
    if len(observation.shape) != 2 or not isinstance(action, Bounded):
        raise ValueError(
            "Only policies with a vector as observation and bounded numbers as action can be "
            "exported."
        )
    policy = load_policy(config, env, checkpoint, torch.device("cpu"))
    if len(policy.in_keys) != 1:
        raise ValueError(f"Policies that read {policy.in_keys} cannot be exported, only vectors.")
    low, high = action.space.low[0], action.space.high[0]
    example = torch.zeros(2, observation.shape[-1])
    with (
        exploration(deterministic=True),
        torch.no_grad(),
        warnings.catch_warnings(),
        replacing(file) as unfinished,
    ):
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        torch.onnx.export(
            _MeanAction(policy, low, high).eval(),
            (example,),
            str(unfinished),
            input_names=["observation"],
            output_names=["action"],
            dynamic_axes={"observation": {0: "N"}, "action": {0: "N"}},
            dynamo=False,
        )
