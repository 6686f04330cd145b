"""From episodes to estimates, and how these are written."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from safe_rl.evaluation.episodes import Episodes
from safe_rl.files import check_no_links, check_place, replace_csv, replace_text
from safe_rl.scores.comparisons import Estimate, cvar, mean, share_over
from safe_rl.scores.measures import normalised_return, normalised_violation
from safe_rl.scores.published import Scores

__all__ = [
    *("check_places", "format_estimates", "format_unjudged", "summarise", "write_episodes"),
    "write_summary",
]


def check_places(places: Iterable[Path]) -> None:
    """Refuse files in a run's folder that cannot be written, before any episode.

    Raises:
        OSError: If one cannot be.
        ValueError: If the folder holds links.
    """
    places = list(places)
    for folder in {place.parent for place in places}:
        check_no_links(folder)
    for place in places:
        check_place(place, "A run's evaluations lie in its folder: evaluate a copy of that.")


def summarise(
    episodes: Episodes,
    cost_limits: Mapping[str, float],
    reference: Scores | None,
    cvar_alpha: float,
) -> dict[str, Estimate]:
    """Estimate everything that is reported of an evaluation.

    Args:
        episodes: What happened.
        cost_limits: Cost key -> d, undiscounted cost per episode.
        reference: Characteristic metrics of the environment, for normalised scores; or None.
        cvar_alpha: Share of the costliest episodes that the CVaR is the mean of.

    Returns:
        Estimates by name: ``episode_return``, ``episode_length``, ``episode_<key>`` for every cost
        key; for those with a limit (the first cost where none has) ``cvar_<key>`` and
        ``over_limit_<key>``; ``normalised_return`` and ``normalised_violation``.

    Examples:
        >>> import torch
        >>> two = torch.tensor([1.0, 3.0])
        >>> episodes = Episodes(two, two, {"cost": torch.tensor([10.0, 30.0])})
        >>> summary = summarise(episodes, {"cost": 25.0}, None, cvar_alpha=0.5)
        >>> [summary[name].value for name in ("episode_cost", "cvar_cost", "over_limit_cost")]
        [20.0, 30.0, 0.5]
    """
    estimates = {
        "episode_return": mean(episodes.returns),
        "episode_length": mean(episodes.lengths),
    }
    estimates |= {f"episode_{key}": mean(costs) for key, costs in episodes.costs.items()}
    for key in cost_limits or list(episodes.costs)[:1]:
        estimates[f"cvar_{key}"] = cvar(episodes.costs[key], cvar_alpha)
        if key in cost_limits:
            over = share_over(episodes.costs[key], cost_limits[key])
            estimates[f"over_limit_{key}"] = over
    if reference is not None:
        estimates["normalised_return"] = Estimate(
            *map(float, normalised_return(estimates["episode_return"], reference))
        )
    if reference is not None and "cost" in cost_limits:
        # monotone in J_c, so the interval's ends are those of J_c
        violation = normalised_violation(estimates["episode_cost"], cost_limits["cost"], reference)
        estimates["normalised_violation"] = Estimate(*map(float, violation))
    return estimates


def format_estimates(
    estimates: Mapping[str, Estimate], cost_limits: Mapping[str, float]
) -> list[str]:
    """Lines of a table for the terminal."""
    width = max(map(len, estimates))
    lines = [f"{'':{width}} {'estimate':>10}   95 % interval"]
    for name, estimate in estimates.items():
        key = name.removeprefix("episode_")
        limit = f"   limit {cost_limits[key]:g}" if key in cost_limits else ""
        interval = f"[{_number(estimate.low)}, {_number(estimate.high)}]"
        lines.append(f"{name:{width}} {_number(estimate.value):>10}   {interval}{limit}")
    return lines


def format_unjudged(limits: Mapping[str, float]) -> list[str]:
    """A line for each limit of the run on a cost that its changed environment does not have.

    Examples:
        >>> format_unjudged({"cost_hazards": 20.0})
        ["the run's limit 20 on cost_hazards is not judged: this environment has no such cost"]
    """
    return [
        f"the run's limit {limit:g} on {key} is not judged: this environment has no such cost"
        for key, limit in limits.items()
    ]


def _number(value: float) -> str:
    return "—" if math.isnan(value) else f"{value:.4g}"


def write_summary(path: Path, facts: Mapping[str, Any], estimates: Mapping[str, Estimate]) -> None:
    """Write facts and estimates as JSON, in one go; what is not a number becomes null."""
    content = {
        **facts,
        "estimates": {
            name: {
                part: value if math.isfinite(value) else None
                for part, value in estimate._asdict().items()
            }
            for name, estimate in estimates.items()
        },
    }
    text = json.dumps(content, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    replace_text(path, text)


def write_episodes(path: Path, episodes: Episodes) -> None:
    """Write one row per episode as CSV, in one go."""
    columns = {"return": episodes.returns, "length": episodes.lengths, **episodes.costs}
    rows = zip(*(column.tolist() for column in columns.values()), strict=True)
    replace_csv(path, [columns, *rows])
