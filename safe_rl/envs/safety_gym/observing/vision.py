"""What the robot's own camera sees, as part of the observation."""

from __future__ import annotations

import torch
from torch import Tensor

from safe_rl.envs.errors import ConfigError
from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.safety_gym.records.scene import Scene
from safe_rl.envs.safety_gym.records.world import Block, World
from safe_rl.envs.safety_gym.rendering.display import Display
from safe_rl.envs.safety_gym.world.scenery import VISION


def vision_blocks(config: SafetyGymConfig, scene: Scene) -> list[Block]:
    """The component `vision`: RGB in [0, 1], lines from top to bottom, [height, width, 3].

    Raises:
        ConfigError: if the robot has no camera.
    """
    if not config.observe_vision:
        return []
    cameras = [scene.model.camera(i).name for i in range(scene.model.ncam)]
    if VISION not in cameras:
        others = f" Its cameras are {cameras}: give one that name." if cameras else ""
        raise ConfigError(
            f"'observe_vision': robot {config.robot_base!r} has no camera named '{VISION}'.{others}"
        )
    width, height = config.vision_size
    display = Display(config)

    def read(world: World) -> Tensor:
        pixels = torch.empty(len(world.step_count), height, width, 3, dtype=torch.uint8)
        # OpenGL draws one picture after the other.
        for row, picture in enumerate(pixels):
            display.pose(world, row)
            picture.copy_(torch.from_numpy(display.frame(VISION, width, height)))
        return pixels.flatten(1).to(torch.float64) / 255

    return [Block({"vision": (height, width, 3)}, read, (0.0, 1.0))]
