"""Starting a run from the networks of another one (Ray, Achiam, Amodei 2019, section 6)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor, nn
from torchrl.checkpoint import CheckpointError

from safe_rl.algorithms.contract import Algorithm
from safe_rl.runs.archive import read_states
from safe_rl.runs.files import read_config
from safe_rl.runs.folder import RunFolder, run_of

__all__ = ["begin_from", "initialise_networks"]


def begin_from(algorithm: Algorithm, source: Path) -> list[str]:
    """Let an algorithm begin with the networks of a run; see `initialise_networks`."""
    taken = initialise_networks(algorithm.networks, source, list(algorithm.cost_keys))
    follow = getattr(algorithm, "networks_were_given", None)
    if follow is not None:
        follow()
    return taken


def initialise_networks(
    networks: Mapping[str, nn.Module], source: Path, cost_keys: Sequence[str]
) -> list[str]:
    """Give networks the weights that a run has learned.

    Optimisers, multipliers and counters start anew. Networks whose names begin with ``cost_`` are
    taken over if the run constrained the same costs.

    Args:
        networks: The new run's by name, changed in place.
        source: Folder of the run, of which the newest checkpoint is read, or a checkpoint.
        cost_keys: Keys of the new run's constrained costs.

    Returns:
        Names of the networks that were taken over.

    Raises:
        CheckpointError: If there is no checkpoint, or its networks have other sizes; nothing has
            been changed then.
    """
    if not source.exists():
        raise CheckpointError(f"init_from={source}: there is no such folder or file.")
    checkpoint = _newest(source) if source.is_dir() else source
    same_costs = _constrained_costs(checkpoint) == list(cost_keys)
    taken = {
        name: network
        for name, network in networks.items()
        if same_costs or not name.startswith("cost_")
    }
    weights = read_states(checkpoint, taken)
    for name, network in taken.items():
        _check_sizes(name, network.state_dict(), weights[name], checkpoint)
    for name, network in taken.items():
        network.load_state_dict(weights[name])
    return list(taken)


def _newest(directory: Path) -> Path:
    newest = RunFolder(directory).newest_checkpoint()
    if newest is None:
        raise CheckpointError(
            f"init_from={directory}: there is no checkpoint. Give the folder of a run, or a file "
            "in its folder 'checkpoints'."
        )
    return newest


def _constrained_costs(checkpoint: Path) -> list[str]:
    """Costs that the cost critic of a checkpoint's run is for; none if that is not known."""
    run = RunFolder(run_of(checkpoint)[0])
    config = read_config(run.config) if run.is_run else {}
    is_constrained = config.get("cost_advantage") or config.get("limits") is not None
    return list(config.get("cost_limits", {})) if is_constrained else []


def _check_sizes(
    name: str, own: Mapping[str, Any], given: Mapping[str, Any], checkpoint: Path
) -> None:
    sizes = [_layer_sizes(weights) for weights in (own, given)]
    if sizes[0] != sizes[1]:
        raise CheckpointError(
            f"The {name} of {checkpoint} has layers of {_arrows(sizes[1])} numbers, this run's has "
            f"{_arrows(sizes[0])}: the first is the observation, the last the output. Observations "
            "and actions must be those of the other run; for the others set model.hidden_sizes."
        )
    if set(own) != set(given):
        raise CheckpointError(
            f"The {name} of {checkpoint} scales its inputs and this run's does not, or the other "
            "way round: set model.input_scale as in the other run's config.yaml."
        )


def _layer_sizes(weights: Mapping[str, Any]) -> list[int]:
    """Numbers that go into a perceptron and come out of each of its layers."""
    matrices = [
        value for value in weights.values() if isinstance(value, Tensor) and value.ndim == 2
    ]
    return [matrices[0].shape[1], *(matrix.shape[0] for matrix in matrices)] if matrices else []


def _arrows(sizes: list[int]) -> str:
    return " → ".join(map(str, sizes))
