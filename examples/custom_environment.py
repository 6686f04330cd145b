"""An environment of your own: a new kind of object, a cost and an observation.

Mines lie between the robot and its goal. Their cost rises towards the centre, and the robot has a
lidar for them. The package does not change: everything is in this file. `import=` adds it to the
built-in objects, for the same commands:

    python train.py import=examples/custom_environment.py env=PointMines \
        cost_limits='{cost_mines: 10}' frames=400_000
    python train.py resume=RUN_DIR import=examples/custom_environment.py frames=2_000_000
    safe-rl evaluate RUN_DIR import=examples/custom_environment.py

The first takes about a minute on two cores.
"""

import torch

from safe_rl.envs import store_config
from safe_rl.envs.extending import (
    CYLINDER,
    Cost,
    Element,
    Geom,
    Motion,
    Reading,
    register_cost,
    register_element,
    register_observation,
)

MINES = Element(
    kind="mines",  # its keys are mines_num, mines_size, mines_keepout, …, and observe_mines
    label="mine",
    motion=Motion.VIRTUAL,
    height=lambda c: 0.02,
    geoms=lambda c: (Geom(CYLINDER, (c.mines_size, 0.01)),),
    rgb=(1.0, 0.0, 0.0),
    group=3,
)


def danger(robot_xy: torch.Tensor, mines_xy: torch.Tensor, size: float) -> torch.Tensor:
    """From 0 at the rim of the nearest mine to 1 at its centre: [N, 2], [N, K, 2] -> [N]."""
    distance = torch.linalg.vector_norm(mines_xy - robot_xy.unsqueeze(1), dim=-1)
    return (1.0 - distance / size).clamp(min=0.0).amax(-1)


COST = Cost(
    key="cost_mines",
    flags=("constrain_mines", "mines_num"),
    magnitude=lambda c, w: (
        c.mines_cost * danger(w.robot_pos[:, :2], w.at("mines")[..., :2], c.mines_size)
    ),
)

SPEED = Reading(
    name="speed",
    flags=("observe_speed",),
    size=lambda c, scene: 1,
    read=lambda w: torch.linalg.vector_norm(w.robot_vel, dim=-1, keepdim=True),
)

POINT_MINES = {
    "robot_base": "point",
    "placements_extents": [-1.5, -1.5, 1.5, 1.5],
    "observe_goal_lidar": True,
    "lidar_max_dist": 3.0,
    "lidar_num_bins": 16,
    "mines_num": 5,
    "observe_mines": True,
    "constrain_mines": True,
    "constrain_indicator": False,  # the cost is how deep the robot is in a mine, not whether
    "observe_speed": True,
}

register_element(MINES, keys={"mines_size": 0.25, "mines_keepout": 0.2})
register_cost(COST, keys={"constrain_mines": False, "mines_cost": 1.0})
register_observation(SPEED, keys={"observe_speed": False})
store_config("PointMines", POINT_MINES)
