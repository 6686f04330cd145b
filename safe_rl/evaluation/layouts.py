"""Whether an evaluation shows a policy layouts that it was trained on."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["default_seed", "has_fixed_layout", "shared_layouts"]

# Far from any seed that a person counts up from a run's own.
_OFFSET = 1_000_000_007
# where a configuration does not say, or its environments have no layouts: every episode is new
_UNLIMITED = {"randomize_layout": True, "layout_seeds": None, "layout_seeds_first": 0}


def has_fixed_layout(env: Mapping[str, Any]) -> bool:
    """Whether all episodes of a world have one layout, which is drawn from the seed."""
    return not (_UNLIMITED | {**env})["randomize_layout"]


def default_seed(env: Mapping[str, Any], training_seed: int) -> int:
    """Seed of an evaluation: another than training's, so that neither layouts nor noise repeat.

    Where the layout is fixed it is drawn from the seed, and belongs to what was learned; then it
    is training's.
    """
    return training_seed + (0 if has_fixed_layout(env) else _OFFSET)


def shared_layouts(
    trained: Mapping[str, Any], evaluated: Mapping[str, Any], *, same_seed: bool
) -> float:
    """Share of the evaluation's layouts that training could have met, in [0, 1].

    Args:
        trained: Environment of the training: `randomize_layout`, `layout_seeds` and
            `layout_seeds_first` count here.
        evaluated: That of the evaluation.
        same_seed: Whether both draw from the same seed.

    Examples:
        >>> finite = {"randomize_layout": True, "layout_seeds": 10, "layout_seeds_first": 0}
        >>> shared_layouts(finite, {**finite, "layout_seeds_first": 8}, same_seed=False)
        0.2
        >>> shared_layouts(finite, {**finite, "layout_seeds": None}, same_seed=False)
        0.0
    """
    envs = [_UNLIMITED | {**env} for env in (trained, evaluated)]
    sizes = [env["layout_seeds"] if env["randomize_layout"] else None for env in envs]
    if None in sizes:
        randomised = {env["randomize_layout"] for env in envs}
        return float(sizes[0] is sizes[1] and len(randomised) == 1 and same_seed)
    ranges = [
        range(env["layout_seeds_first"], env["layout_seeds_first"] + size)
        for env, size in zip(envs, sizes, strict=True)
    ]
    common = min(r.stop for r in ranges) - max(r.start for r in ranges)
    return max(0, common) / len(ranges[1])
