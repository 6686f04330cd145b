"""Any environment of Gymnasium as a family: `env=gymnasium env.id=…`."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from typing import Any

import gymnasium
import torch

from safe_rl.envs.errors import ConfigError
from safe_rl.envs.gymnasium.conversion import GymnasiumEnv, from_gymnasium
from safe_rl.envs.gymnasium.nodes import complete_gymnasium, maker
from safe_rl.envs.rng import spread_seed


def make_gymnasium(
    config: Mapping[str, Any],
    *,
    num_envs: int,
    device: torch.device | str = "cpu",
    seed: int | None = None,
    num_threads: int = 0,
) -> GymnasiumEnv:
    """Make environments of a registered id.

    Args:
        config: `id` and any other of `safe_rl.envs.gymnasium.nodes.KEYS`.
        num_envs: number of environments, N.
        device: where the TensorDicts live.
        seed: determines every row; rows of different seeds have nothing in common.
        num_threads: taken as any family does; Gymnasium's environments have no use for it.

    Raises:
        ConfigError: for an unknown key or id, or an environment that the algorithms cannot use.

    Examples:
        >>> config = {"id": "Safexp-PointGoal1-v0", "num_steps": 100}
        >>> make_gymnasium(config, num_envs=2, seed=0).cost_keys
        ['cost', 'cost_hazards', 'cost_exception']
    """
    config = complete_gymnasium(config)
    make = maker(config)
    try:
        return from_gymnasium(
            make,
            num_envs=num_envs,
            cost_keys=_named_costs(config["cost_keys"], config["outside"] or {}),
            num_steps=config["num_steps"],
            seed=None if seed is None else spread_seed(seed),
            workers=config["workers"],
            flatten=config["flatten"],
            device=device,
            highest_costs=dict.fromkeys(config["outside"] or {}, 1.0),
        )
    except (gymnasium.error.Error, TypeError, ValueError) as error:
        raise ConfigError(f"env.id={config['id']}: {error}") from error


def _named_costs(reported: Sequence[str] | None, outside: Collection[str]) -> list[str] | None:
    """Names of all costs, those of leaving a range among them; None if they are to be found out."""
    return None if reported is None else [*dict.fromkeys([*reported, *outside])]
