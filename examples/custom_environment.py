"""An environment of your own: a new kind of object, a cost and an observation, and a run on it.

Mines lie between the robot and its goal. Their cost rises towards the centre, and the robot's
lidar sees them. Nothing in the package changes: every row stands in this file.

    python examples/custom_environment.py                        # about a minute on two cores
    python examples/custom_environment.py frames=2_000_000 seed=1 env.mines_num=8
"""

import sys
import time
from pathlib import Path

import torch
from hydra import compose, initialize_config_dir
from omegaconf import OmegaConf

from safe_rl.envs import make_env, store_config
from safe_rl.envs.safety_gym.extending import (
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
from safe_rl.training.trainer import build_trainer, seed_everything

CONF = Path(__file__).resolve().parents[1] / "conf"

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
    active=lambda c: c.constrain_mines and c.mines_num > 0,
    magnitude=lambda c, w: (
        c.mines_cost * danger(w.robot_pos[:, :2], w.at("mines")[..., :2], c.mines_size)
    ),
)

SPEED = Reading(
    name="speed",
    present=lambda c: c.observe_speed,
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
RUN = ["env=PointMines", "cost_limits={cost_mines: 10}", "frames=400_000"]


def register() -> None:
    """Make the new rows and the configuration known to the package."""
    register_element(MINES, keys={"mines_size": 0.25, "mines_keepout": 0.2})
    register_cost(COST, keys={"constrain_mines": False, "mines_cost": 1.0})
    register_observation(SPEED, keys={"observe_speed": False})
    store_config("PointMines", POINT_MINES)


def main(overrides: list[str], directory: Path) -> str:
    """Train PPO-Lagrangian; returns a line on the outcome."""
    register()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        config = compose("config", overrides=[*RUN, *overrides])
    seed_everything(config.seed, config.num_threads)
    env = make_env(
        OmegaConf.to_container(config.env, resolve=True),
        num_envs=config.num_envs,
        seed=config.seed,
        num_threads=config.num_threads or 0,
    )
    return build_trainer(config, env, directory).run()


if __name__ == "__main__":
    print(main(sys.argv[1:], Path("runs/PointMines") / time.strftime("%Y-%m-%d_%H-%M-%S")))
