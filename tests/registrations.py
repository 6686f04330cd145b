"""Rows to register, and registering without leaving anything behind for the tests that follow."""

from collections.abc import Iterator
from contextlib import contextmanager

import torch

from safe_rl.envs import store_configs
from safe_rl.envs.extending import (
    BOX,
    CYLINDER,
    Cost,
    Element,
    Geom,
    Motion,
    register_cost,
    register_element,
)
from safe_rl.envs.safety_gym.config import KEYS, ROBOTS
from safe_rl.envs.safety_gym.costs import COSTS
from safe_rl.envs.safety_gym.elements import BY_KIND, ELEMENTS, PLACEMENT_ORDER
from safe_rl.envs.safety_gym.observations import READINGS
from safe_rl.envs.safety_gym.tasks import TASKS

LISTS = (COSTS, ELEMENTS, PLACEMENT_ORDER, READINGS)
MAPPINGS = (BY_KIND, KEYS, ROBOTS, TASKS)


@contextmanager
def undone() -> Iterator[None]:
    """Undo every registration at the end."""
    lists, mappings = [list(table) for table in LISTS], [dict(table) for table in MAPPINGS]
    try:
        yield
    finally:
        for table, rows in zip(LISTS, lists, strict=True):
            table[:] = rows
        for table, rows in zip(MAPPINGS, mappings, strict=True):
            table.clear()
            table.update(rows)
        store_configs()  # the keys that Hydra knows


def cube(kind: str, label: str, motion: Motion, group: int = 2) -> Element:
    """A row of the simplest sort: cubes that stand on the floor."""
    return Element(
        kind=kind,
        label=label,
        motion=motion,
        height=lambda c: getattr(c, f"{kind}_size"),
        geoms=lambda c: (Geom(BOX, (getattr(c, f"{kind}_size"),) * 3),),
        rgb=(0.3, 0.3, 0.3),
        group=group,
    )


def disc(kind: str, label: str) -> Element:
    return Element(
        kind=kind,
        label=label,
        motion=Motion.VIRTUAL,
        height=lambda c: 0.01,
        geoms=lambda c: (Geom(CYLINDER, (getattr(c, f"{kind}_size"), 0.01)),),
        rgb=(1, 0, 0),
        group=3,
    )


def inside(config, world) -> torch.Tensor:
    """Number of mines that the robot's centre is in."""
    offset = world.at("mines")[..., :2] - world.robot_pos[:, None, :2]
    return config.mines_cost * (offset.norm(dim=-1) < config.mines_size).sum(-1)


def register_mines() -> None:
    register_element(disc("mines", "mine"), keys={"mines_size": 0.2, "mines_keepout": 0.3})
    cost = Cost("cost_mines", ("constrain_mines",), inside)
    register_cost(cost, keys={"constrain_mines": False, "mines_cost": 2.5})


POINT = {"robot_base": "point", "task": "none", "sensors_obs": ["gyro"]}
MINES = {"mines_num": 2, "observe_mines": True, "constrain_mines": True}
