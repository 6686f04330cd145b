"""What advantage estimators compute with: ends of trajectories, values, the estimate itself."""

from __future__ import annotations

from tensordict import NestedKey, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import Tensor
from torchrl.modules import set_recurrent_mode
from torchrl.objectives.value.functional import vec_generalized_advantage_estimate

from safe_rl.objectives.samples import FIRST


def trajectory_ends(done: Tensor, mask: Tensor | None) -> Tensor:
    """Where the trajectories of a rollout end, [..., T] bool.

    Args:
        done: [..., T, 1] bool.
        mask: [..., T] bool, False where the rollout is padded; None without padding.
    """
    ends = done.squeeze(-1).clone()
    ends[..., -1] = True
    return ends if mask is None else (ends | ~mask.roll(-1, -1)) & mask


def one_pass_values(
    tensordict: TensorDictBase, value_network: TensorDictModuleBase, key: NestedKey, ends: Tensor
) -> tuple[Tensor, Tensor]:
    """Value every observation of a rollout once.

    Inside a trajectory the next observation of step t is the root observation of step t + 1,
    so that only the observations at which trajectories end are valued in addition. A network with
    a memory reads the rollout as sequences, and those observations as sequences of one step, with
    what it remembered there.

    Args:
        tensordict: rollout [..., T] with the network's in_keys, also under ``"next"``.
        value_network: writes `key`, [..., T, F].
        key: the network's value key.
        ends: [..., T] bool, see `trajectory_ends`.

    Returns:
        Values of the root observations and of the next observations, both [..., T, F].
    """
    in_keys = value_network.in_keys
    last = tensordict.get("next").select(*in_keys)[ends]
    if FIRST in in_keys:
        last = last.unsqueeze(-1)
    with set_recurrent_mode(True):
        value = value_network(tensordict.select(*in_keys)).get(key)
        value_at_ends = value_network(last).get(key)
    next_value = value.roll(-1, dims=-2)
    next_value[ends] = value_at_ends.reshape(-1, value.shape[-1])
    return value, next_value


def gae(
    reward: Tensor,
    value: Tensor,
    next_value: Tensor,
    done: Tensor,
    terminated: Tensor,
    *,
    gamma: float,
    lmbda: float,
) -> Tensor:
    """Generalised advantage estimate (Schulman et al. 2016, equation 16).

    Args:
        reward: [..., T, F], F reward-like signals.
        value: [..., T, F], values of the observations.
        next_value: [..., T, F], values of the next observations.
        done: [..., T, 1] bool, trajectory ends.
        terminated: [..., T, 1] bool, ends without bootstrap.
        gamma: discount per step.
        lmbda: decay of the TD errors.

    Returns:
        Advantages, [..., T, F].
    """
    if gamma * lmbda == 0:
        # TorchRL's filter drops even the first TD error when the decay is 0.
        return reward + gamma * next_value * ~terminated - value
    flags = done.expand_as(reward), terminated.expand_as(reward)
    return vec_generalized_advantage_estimate(gamma, lmbda, value, next_value, reward, *flags)[0]
