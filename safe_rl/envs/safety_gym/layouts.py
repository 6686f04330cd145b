"""Areas where objects may be placed, and batched rejection sampling of layouts and new goals.

Many layouts are drawn at once: one object after the other, for all rows together. Lengths are in
metres.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

import torch
from torch import Tensor

from safe_rl.envs import rng
from safe_rl.envs.keys import ConfigError
from safe_rl.envs.physics import Physics
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.elements import BY_KIND, PLACEMENT_ORDER
from safe_rl.envs.safety_gym.tasks import TASKS
from safe_rl.envs.safety_gym.world import Scene

_Rectangle = tuple[float, float, float, float]  # xmin, ymin, xmax, ymax
PIN_TOLERANCE = 1e-9  # half side of the square from which a pinned location is drawn


@dataclass(frozen=True)
class PlacementPlan:
    """The objects to place, their order, and the areas where each may be placed.

    Attributes:
        names: Names of the P objects in order of placement.
        kinds: Kind of each.
        columns: Column of each in a layout [.., 1 + M, 2]: 0 for the robot, 1 + slot for an object.
        num_columns: 1 + M.
        rectangles: Areas of the centres, [P, R, 4] (xmin, ymin, xmax, ymax).
        thresholds: Cumulative probability of each object's rectangles, [P, R].
        clearance: Smallest allowed distance of every two objects, [P, P].
        goal: Index of the goal in `names`, -1 if there is none.
        goal_column: Column of the goal.
        beside_goal: Columns of the other objects, and their clearance from the goal, [P - 1].
    """

    names: tuple[str, ...]
    kinds: tuple[str, ...]
    columns: tuple[int, ...]
    num_columns: int
    rectangles: Tensor
    thresholds: Tensor
    clearance: Tensor
    goal: int
    goal_column: int
    beside_goal: tuple[Tensor, Tensor]


def plan_placements(scene: Scene, device: torch.device) -> PlacementPlan:
    """Build the plan of a scene.

    Raises:
        ConfigError: If a placement leaves no room for its object's keepout.
    """
    config, rows = scene.config, []
    for kind in PLACEMENT_ORDER:
        if kind == "robot":
            labels, first = ["robot"], 0
        elif kind not in scene.slots or (kind == "goal" and TASKS[config.task].goal_at_button):
            continue
        else:
            labels, first = BY_KIND[kind].names(config), 1 + scene.slots[kind].start
        for index, label in enumerate(labels):
            rows.append((label, kind, first + index, _rectangles(config, kind, label, index)))
    names, kinds, columns, areas = zip(*rows, strict=True)
    # padded to one tensor; of the padding, the probability is 0
    most = max(map(len, areas))
    padded = [group + [group[-1]] * (most - len(group)) for group in areas]
    rectangles = torch.tensor(padded, dtype=torch.float64)
    sizes = (rectangles[..., 2:] - rectangles[..., :2]).clamp(min=0.0).prod(-1)
    for row, group in enumerate(areas):
        sizes[row, len(group) :] = 0.0
        if sizes[row].sum() == 0.0:
            sizes[row, : len(group)] = 1.0
    keepout = torch.tensor(
        [getattr(config, f"{kind}_keepout") for kind in kinds], dtype=torch.float64, device=device
    )
    clearance = (keepout + keepout[:, None] + config.placements_margin).clamp(min=0.0)
    goal = names.index("goal") if "goal" in names else -1
    others = [item for item in range(len(names)) if item != goal]
    return PlacementPlan(
        names=names,
        kinds=kinds,
        columns=columns,
        num_columns=1 + len(scene.names),
        rectangles=rectangles.to(device),
        thresholds=(sizes.cumsum(-1) / sizes.sum(-1, keepdim=True)).to(device),
        clearance=clearance,
        goal=goal,
        goal_column=columns[goal],
        beside_goal=(torch.tensor(columns, device=device)[others], clearance[goal, others]),
    )


def _rectangles(config: SafetyGymConfig, kind: str, label: str, index: int) -> list[_Rectangle]:
    """Return rectangles for the centre of one object: its placements, reduced by its keepout."""
    locations = getattr(config, f"{kind}_locations")
    keepout = getattr(config, f"{kind}_keepout")
    if index < len(locations):
        (x, y), half = locations[index], PIN_TOLERANCE
        return [(x - half, y - half, x + half, y + half)]
    placements = getattr(config, f"{kind}_placements") or (config.placements_extents,)
    # If a side is twice the keepout, a point remains, and rounding may make its size negative.
    least = 2 * keepout - PIN_TOLERANCE
    shrunk = [
        (xmin + keepout, ymin + keepout, xmax - keepout, ymax - keepout)
        for xmin, ymin, xmax, ymax in placements
        if min(xmax - xmin, ymax - ymin) >= least
    ]
    if not shrunk:
        raise ConfigError(
            f"There is no room for '{label}': none of its placements {placements} is as large as "
            f"twice its keepout ({keepout}). Enlarge '{kind}_placements' or 'placements_extents', "
            f"or reduce '{kind}_keepout'."
        )
    return shrunk


TRIES_PER_OBJECT = 100
TRIES_PER_LAYOUT = 10_000
TRIES_PER_GOAL = 10_000
# If the host does not read results, it always tries this often; that nearly always suffices.
TRIES_UNSEEN = 200
_BLOCK = 10  # candidates for an object that are tested at once
_GOAL_BLOCK = 40  # the same for a new goal; they mostly suffice without a second round
_MAX_ROWS = 4096  # most layouts, or candidates for new goals, at once: a bound on memory
# Layouts of a batch that may fail before the first one is found. The lower number applies if
# layouts take long, which is measured by the compared pairs of objects.
_HOPELESS_LAYOUTS = (100, 10_000)
_HOPELESS_PAIRS = 1 << 26


class LayoutError(ValueError):
    """No layout was found; the message names the object that most often did not fit."""


def _draw(plan: PlacementPlan, item: int, key: Tensor) -> Tensor:
    """Draw a candidate position of an object per key: [...] -> [..., 2]."""
    rectangles, thresholds = plan.rectangles[item], plan.thresholds[item]
    uniform = rng.uniform(key.unsqueeze(-1), torch.arange(3, device=key.device))
    if len(rectangles) == 1:
        chosen = rectangles[0]
    else:
        which = torch.searchsorted(thresholds, uniform[..., 0].contiguous(), right=True)
        chosen = rectangles[which.clamp(max=len(rectangles) - 1)]
    low, high = chosen[..., :2], chosen[..., 2:]
    return low + (high - low) * uniform[..., 1:]


def _fits(candidates: Tensor, others: Tensor, clearance: Tensor) -> Tensor:
    """Whether candidates [B, C, 2] keep their clearance [K] from others [B, K, 2]: [B, C]."""
    (x, y), (other_x, other_y) = candidates.unbind(-1), others.unsqueeze(1).unbind(-1)
    dx, dy = x.unsqueeze(-1) - other_x, y.unsqueeze(-1) - other_y
    return (torch.addcmul(dx.square_(), dy, dy) >= clearance.square()).all(-1)


def _place(plan: PlacementPlan, item: int, key: Tensor, placed: Tensor) -> tuple[Tensor, Tensor]:
    """Place one object beside the K placed ones: keys [B], [B, K, 2] -> [B, 2], success [B]."""
    clearance = plan.clearance[item, :item]
    position = placed.new_zeros(len(key), 2)
    pending = torch.arange(len(key), device=key.device)
    for start in range(0, TRIES_PER_OBJECT, _BLOCK):
        numbers = torch.arange(start, start + _BLOCK, device=key.device)
        tries = rng.fold(key[pending, None], numbers)
        candidates = _draw(plan, item, tries)
        fits = _fits(candidates, placed[pending], clearance)
        is_placed, first = fits.any(-1), fits.to(torch.uint8).argmax(-1)
        rows = pending[is_placed]
        position[rows] = candidates[is_placed, first[is_placed]]
        pending = pending[~is_placed]
        if not len(pending):
            break
    return position, torch.ones_like(key, dtype=torch.bool).index_fill(0, pending, False)


def _try_layouts(plan: PlacementPlan, key: Tensor) -> tuple[Tensor, Tensor]:
    """Try one layout per key [B]: positions [B, P, 2], and the object without a place or -1 [B]."""
    positions = plan.clearance.new_zeros(len(key), len(plan.names), 2)
    misfit = torch.full_like(key, -1)
    alive = torch.arange(len(key), device=key.device)
    for item in range(len(plan.names)):
        placed = positions[alive, :item]
        positions[alive, item], ok = _place(plan, item, rng.fold(key[alive], item), placed)
        misfit[alive[~ok]] = item
        alive = alive[ok]
        if not len(alive):
            break
    return positions, misfit


def sample_layouts(plan: PlacementPlan, key: Tensor) -> Tensor:
    """Draw a layout for every key [B]: positions [B, 1 + M, 2], zero for objects not placed.

    Objects are placed one after the other, with 100 tries each. If one does not fit, the whole
    layout is drawn again, at most 10,000 times, or fewer if no layout is found for any row.

    Raises:
        LayoutError: If there is no layout; the message names the object that most often did not
            fit, and the keys that matter.
    """
    layouts = plan.clearance.new_zeros(len(key), plan.num_columns, 2)
    misfits = key.new_zeros(len(plan.names))
    columns = torch.tensor(plan.columns, device=key.device)
    pending = torch.arange(len(key), device=key.device)
    # growing ranges of attempts, so a few difficult rows need few rounds
    stop, size, most = 0, 1, max(1, _MAX_ROWS // max(1, len(key)))
    while stop < TRIES_PER_LAYOUT:
        start, stop = stop, min(stop + size, TRIES_PER_LAYOUT)
        size = min(4 * size, most)
        attempts = rng.fold(key[pending, None], torch.arange(start, stop, device=key.device))
        positions, misfit = _try_layouts(plan, attempts.flatten())
        misfits += torch.bincount(misfit[misfit >= 0], minlength=len(misfits))
        good = (misfit < 0).view(len(pending), stop - start)
        has_layout, first = good.any(-1), good.to(torch.uint8).argmax(-1)
        chosen = positions.view(*good.shape, len(plan.names), 2)[has_layout, first[has_layout]]
        layouts[pending[has_layout].unsqueeze(1), columns] = chosen
        pending = pending[~has_layout]
        if not len(pending):
            return layouts
        if len(pending) == len(key) and _is_hopeless(misfits):
            break
    raise _no_layout(plan, misfits)


def _is_hopeless(misfits: Tensor) -> bool:
    """Whether to give up, from the number of layouts that failed at each object, [P]."""
    failed = int(misfits.sum())
    numbers = torch.arange(1, 1 + len(misfits), device=misfits.device)
    pairs = int((misfits * numbers.square()).sum())
    return failed >= _HOPELESS_LAYOUTS[pairs < _HOPELESS_PAIRS]


def _no_layout(plan: PlacementPlan, misfits: Tensor) -> LayoutError:
    item = int(misfits.argmax())
    kind, (most, number) = plan.kinds[item], Counter(plan.kinds).most_common(1)[0]
    fewer = f"fewer objects ('{most}_num' is {number}), " if number > 1 else ""
    return LayoutError(
        f"No layout found in {misfits.sum():,} attempts: most often '{plan.names[item]}' did not "
        f"fit. Use {fewer}a smaller '{kind}_keepout' or 'placements_margin', or larger "
        f"'{kind}_placements' or 'placements_extents', and '{kind}_locations' further apart."
    )


def resample_goal(
    plan: PlacementPlan, physics: Physics, key: Tensor, layouts: Tensor, wanted: Tensor
) -> tuple[Tensor, Tensor]:
    """Draw a new goal position that keeps its distance from all other current positions.

    Args:
        plan: A plan with a goal.
        physics: The backend, which knows whether the host reads results.
        key: Random keys, int64 [B].
        layouts: Present positions [B, 1 + M, 2].
        wanted: Rows that get a new goal, bool [B].

    Returns:
        The positions [B, 2], and whether one was wanted and found, bool [B]: within 10,000 draws,
        or within 200 if the host does not read results.
    """
    item, (columns, clearance) = plan.goal, plan.beside_goal
    position = layouts.new_zeros(len(key), 2)
    missing, placed = wanted, layouts.index_select(1, columns)
    start, block = 0, _GOAL_BLOCK
    most = TRIES_UNSEEN if physics.waits else TRIES_PER_GOAL
    while start < most and physics.maybe_any(missing):
        rows = physics.rows(missing)
        at_once = block if physics.waits else max(1, _MAX_ROWS // len(rows))
        stop = min(start + block, start + at_once, most)
        tries = torch.arange(start, stop, device=key.device)
        candidates = _draw(plan, item, rng.fold(key[rows, None], tries))
        fits = _fits(candidates, placed[rows], clearance)
        first = fits.to(torch.uint8).argmax(-1)
        chosen = candidates.gather(1, first.view(-1, 1, 1).expand(-1, 1, 2))[:, 0]
        is_placed = fits.any(-1) & missing[rows]
        position[rows] = torch.where(is_placed.unsqueeze(-1), chosen.to(position), position[rows])
        missing = missing.index_put((rows,), missing[rows] & ~is_placed)
        start, block = stop, 4 * block
    return position, wanted & ~missing
