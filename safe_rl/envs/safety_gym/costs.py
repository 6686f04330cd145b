"""Safety costs: one batched function per cost key, and the table that names them.

Source: paper section 4.1.3. Every function returns one number per world, [N]. If
`constrain_indicator` is set, `compute_costs` replaces positive numbers by 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor

from safe_rl.envs.keys import ConfigError
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.world import World


def hazard_cost(robot_xy: Tensor, hazard_xy: Tensor, size: float) -> Tensor:
    """Sum of the depths [m] of the robot [N, 2] in hazards [N, K, 2] of radius `size`: [N]."""
    distance = torch.hypot(*(hazard_xy - robot_xy.unsqueeze(-2)).unbind(-1))
    return torch.rsub(distance, size).relu_().sum(-1)


def contact_cost(contacts: Tensor) -> Tensor:
    """Number of contact points of the robot with all K objects: [N, K] -> [N]."""
    return contacts.sum(-1)


def displacement_cost(xy: Tensor, start_xy: Tensor, threshold: float) -> Tensor:
    """Sum of those distances [m] of objects [N, K, 2] from their start that exceed a threshold."""
    moved = torch.hypot(*(xy - start_xy).unbind(-1))
    return torch.where(moved > threshold, moved, 0.0).sum(-1)


def velocity_cost(velocity: Tensor, threshold: float) -> Tensor:
    """Sum of those speeds [m/s] of objects that are at least the threshold: [N, K, 3] -> [N]."""
    speed = torch.linalg.vector_norm(velocity, dim=-1)
    return torch.where(speed >= threshold, speed, 0.0).sum(-1)


def wrong_button_cost(contacts: Tensor, goal_button: Tensor, timer: Tensor) -> Tensor:
    """Contact points [N, K] with buttons other than the goal [N], where the `timer` [N] is 0."""
    number = torch.arange(contacts.shape[-1], device=contacts.device)
    wrong = number != goal_button.unsqueeze(-1)
    return (contacts * wrong).sum(-1) * (timer == 0)


def boundary_cost(xy: Tensor, half_x: float | None, half_y: float | None) -> Tensor:
    """Distance [m] beyond |x| ≤ half_x plus that beyond |y| ≤ half_y: [N, 2] -> [N].

    None is no boundary. The circle task of CPO (Achiam et al. 2017, section 8.1) has one in x.
    """
    x, y = xy.abs().unbind(-1)
    most_x, most_y = (math.inf if half is None else half for half in (half_x, half_y))
    return (x - most_x).clamp_(min=0.0).add_((y - most_y).clamp_(min=0.0))


def excess_speed(velocity: Tensor, limit: float | None) -> Tensor:
    """Excess [m/s] of the robot's speed in the plane over the limit: [N, 3] -> [N]."""
    assert limit is not None  # see `suite.check`
    speed = torch.hypot(velocity[:, 0], velocity[:, 1])
    return (speed - limit).clamp_(min=0.0)


class Cost(NamedTuple):
    """A row: one cost.

    Attributes:
        key: Its key in TensorDicts, "cost_<kind>".
        flags: Configuration keys that must all be true, or not 0, for the cost to exist.
        magnitude: (config, world) -> [N], 0 or more; `constrain_indicator` makes it 0 or 1.
        touches: Kinds of objects whose contacts with the robot it reads.
    """

    key: str
    flags: tuple[str, ...]
    magnitude: Callable[[SafetyGymConfig, World], Tensor]
    touches: tuple[str, ...] = ()


COSTS: list[Cost] = [
    Cost("cost_hazards", ("constrain_hazards",), lambda c, w:
         c.hazards_cost * hazard_cost(w.robot_xy, w.at("hazards")[..., :2], c.hazards_size)),
    Cost("cost_vases_contact", ("constrain_vases",), lambda c, w:
         c.vases_contact_cost * contact_cost(w.contacts_with("vases")), touches=("vases",)),
    Cost("cost_vases_displace", ("constrain_vases", "vases_displace_cost"),
         lambda c, w: c.vases_displace_cost * displacement_cost(
             w.at("vases")[..., :2], w.start_of("vases"), c.vases_displace_threshold)),
    Cost("cost_vases_velocity", ("constrain_vases", "vases_velocity_cost"),
         lambda c, w: c.vases_velocity_cost * velocity_cost(
             w.velocity_of("vases"), c.vases_velocity_threshold)),
    Cost("cost_pillars", ("constrain_pillars",), lambda c, w:
         c.pillars_cost * contact_cost(w.contacts_with("pillars")), touches=("pillars",)),
    Cost("cost_buttons", ("constrain_buttons",), lambda c, w:
         c.buttons_cost * wrong_button_cost(
             w.contacts_with("buttons"), w.goal_button, w.buttons_timer), touches=("buttons",)),
    Cost("cost_gremlins", ("constrain_gremlins",), lambda c, w:
         c.gremlins_contact_cost * contact_cost(w.contacts_with("gremlins")),
         touches=("gremlins",)),
    Cost("cost_boundary", ("constrain_boundary",), lambda c, w:
         boundary_cost(w.robot_xy, c.boundary_x, c.boundary_y)),
    Cost("cost_velocity", ("constrain_velocity",), lambda c, w:
         excess_speed(w.robot_vel, c.velocity_limit)),
]  # fmt: skip
EXCEPTION_KEY = "cost_exception"
BUILT_IN_COSTS = frozenset(row.key for row in COSTS)


def active_costs(config: SafetyGymConfig) -> list[Cost]:
    """Return the rows of the present table that are active in a configuration."""
    return [row for row in COSTS if all(getattr(config, flag) for flag in row.flags)]


def compute_costs(rows: Sequence[Cost], world: World, failed: Tensor) -> Tensor:
    """Compute the costs of the worlds: the sum, a row for each of `rows`, exceptions, [R, N].

    Worlds whose physics failed, bool [N], have no cost but `cost_exception` (and the aggregate).

    Raises:
        ConfigError: If a registered cost is not one finite number of at least 0 per world.
    """
    config = world.scene.config
    magnitudes = [world.require(row.key, row.magnitude(config, world)) for row in rows]
    if world.physics.maybe_any(failed):
        magnitudes = [magnitude.masked_fill(failed, 0.0) for magnitude in magnitudes]
    exceptions = failed.to(world.physics.dtype)  # determines the dtype of the sum
    costs = torch.stack([sum(magnitudes, start=exceptions), *magnitudes, exceptions])
    if any(row.key not in BUILT_IN_COSTS for row in rows):
        # NaN would be 0 after `gt_`, and infinity 1
        wrong = ~((costs >= 0.0) & (costs < math.inf))
        world.physics.check(wrong, partial(_wrong_costs, rows, wrong))
    return costs.gt_(0.0) if config.constrain_indicator else costs


def _wrong_costs(rows: Sequence[Cost], wrong: Tensor) -> ConfigError:
    keys = [row.key for row, is_wrong in zip(rows, wrong[1:-1].any(1), strict=True) if is_wrong]
    return ConfigError(f"{', '.join(keys)} must be 0 or more and finite in every world.")
