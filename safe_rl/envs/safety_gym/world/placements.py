"""Where objects may be placed: the plan that a configuration makes for drawing layouts.

Distances and lengths in metres.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import torch
from torch import Tensor

from safe_rl.envs.errors import ConfigError
from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.safety_gym.rules.elements import BY_KIND, PLACEMENT_ORDER
from safe_rl.envs.safety_gym.rules.tasks import goal_is_button

PIN_TOLERANCE = 1e-9  # half width of the square that a pinned location stands for


@dataclass(frozen=True)
class PlacementPlan:
    """What is placed, in which order, and where each object may stand.

    Attributes:
        names: the P objects in order of placement.
        kinds: the kind of each.
        columns: column of each in a layout [.., 1 + M, 2]: 0 the robot, 1 + slot an object.
        num_columns: 1 + M.
        rectangles: where the centres may be, [P, R, 4] (xmin, ymin, xmax, ymax).
        thresholds: cumulative probability of each object's rectangles, [P, R].
        keepouts: [P].
        margin: added to the sum of two keepouts.
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    columns: tuple[int, ...]
    num_columns: int
    rectangles: Tensor
    thresholds: Tensor
    keepouts: Tensor
    margin: float

    @property
    def goal_column(self) -> int:
        """The goal's column in a layout."""
        return self.columns[self.names.index("goal")]

    @cached_property
    def beside_goal(self) -> tuple[int, Tensor, Tensor]:
        """The goal's place in the order, the others' columns [P - 1], and clearances [P - 1]."""
        item = self.names.index("goal")
        others = [i for i in range(len(self.names)) if i != item]
        columns = torch.tensor([self.columns[i] for i in others])
        return item, columns, self.clearance(item, others)

    def clearance(self, item: int, others: slice | list[int]) -> Tensor:
        """Distances that an object keeps from others at least, [K]."""
        return (self.keepouts[others] + self.keepouts[item] + self.margin).clamp(min=0.0)


def plan_placements(
    config: SafetyGymConfig, slots: Mapping[str, slice], num_slots: int
) -> PlacementPlan:
    """Build the plan of a configuration.

    Args:
        config: the environment.
        slots: slots of each kind that has objects.
        num_slots: M.

    Raises:
        ConfigError: if a placement leaves no room for its object's keepout.
    """
    names, kinds, columns, keepouts, rectangles = [], [], [], [], []
    for kind in PLACEMENT_ORDER:
        if kind == "robot":
            labels, first = ["robot"], 0
        elif kind not in slots or (kind == "goal" and goal_is_button(config.task)):
            continue
        else:
            labels, first = BY_KIND[kind].names(config), 1 + slots[kind].start
        for index, label in enumerate(labels):
            names.append(label)
            kinds.append(kind)
            columns.append(first + index)
            keepouts.append(getattr(config, f"{kind}_keepout"))
            rectangles.append(_rectangles(config, kind, label, index))
    stacked, thresholds = _stack(rectangles)
    return PlacementPlan(
        names=tuple(names),
        kinds=tuple(kinds),
        columns=tuple(columns),
        num_columns=1 + num_slots,
        rectangles=stacked,
        thresholds=thresholds,
        keepouts=torch.tensor(keepouts, dtype=torch.float64),
        margin=config.placements_margin,
    )


def _rectangles(
    config: SafetyGymConfig, kind: str, label: str, index: int
) -> list[tuple[float, ...]]:
    """Rectangles for the centre of one object: its placements, less its keepout, that are left."""
    locations = getattr(config, f"{kind}_locations")
    keepout = getattr(config, f"{kind}_keepout")
    if index < len(locations):
        x, y = locations[index]
        tolerance = PIN_TOLERANCE
        return [(x - tolerance, y - tolerance, x + tolerance, y + tolerance)]
    placements = getattr(config, f"{kind}_placements") or (config.placements_extents,)
    # A rectangle of twice the keepout is a point, which rounding may turn inside out.
    least = 2 * keepout - PIN_TOLERANCE
    shrunk: list[tuple[float, ...]] = [
        (xmin + keepout, ymin + keepout, xmax - keepout, ymax - keepout)
        for xmin, ymin, xmax, ymax in placements
        if min(xmax - xmin, ymax - ymin) >= least
    ]
    if not shrunk:
        raise ConfigError(
            f"There is no room for '{label}': of its placements {placements} none is as large as "
            f"twice its keepout ({keepout}). Enlarge '{kind}_placements' or 'placements_extents', "
            f"or reduce '{kind}_keepout'."
        )
    return shrunk


def _stack(rectangles: list[list[tuple[float, ...]]]) -> tuple[Tensor, Tensor]:
    """Pad to one tensor; cumulative probabilities are in proportion to the areas."""
    most = max(len(group) for group in rectangles)
    padded = torch.tensor(
        [group + [group[-1]] * (most - len(group)) for group in rectangles], dtype=torch.float64
    )
    area = (padded[..., 2:] - padded[..., :2]).clamp(min=0.0).prod(-1)
    for row, group in enumerate(rectangles):
        area[row, len(group) :] = 0.0
        if area[row].sum() == 0.0:
            area[row, : len(group)] = 1.0
    return padded, area.cumsum(-1) / area.sum(-1, keepdim=True)
