"""Build the physics on MuJoCo Warp: sizes of its buffers, and checks of what it supports."""

from __future__ import annotations

import copy
import functools
import math
from typing import Any

import mujoco
import torch

from safe_rl.envs.keys import ConfigError
from safe_rl.envs.physics import BatchPhysics, Physics
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.extras import require_extra

# Size of the trial that counts contacts.
TRIAL_WORLDS, TRIAL_STEPS = 32, 50
_FEWEST_CONTACTS, _FEWEST_CONSTRAINTS = 32, 128
_NEARLY = 1e-3  # margin of geoms in the trial [m], because contacts on the device differ a little


def make_warp_physics(
    config: SafetyGymConfig,
    model: mujoco.MjModel,
    num_envs: int,
    device: torch.device,
    env_class: Any,
) -> Physics:
    """Build the physics for the value "warp" of the key `physics`.

    Args:
        config: The configuration of the environment.
        model: Its compiled world.
        num_envs: Number of worlds, N.
        device: Device of the worlds.
        env_class: `SafetyGymEnv`, for a trial on the CPU.

    Raises:
        ConfigError: If MuJoCo Warp does not support the robot, or for an unsupported device.
        ModuleNotFoundError: If MuJoCo Warp is not installed.
    """
    if device.type not in ("cpu", "cuda"):
        raise ConfigError(f"'physics' warp runs on the devices cpu and cuda, got {device}.")
    require_extra("mujoco_warp", extra="gpu")
    from safe_rl.envs.physics.warp_physics import WarpPhysics

    most, scale = most_contacts(config, env_class), config.physics_buffers
    contacts = _power_of_two(max(scale * most[0], _FEWEST_CONTACTS))
    constraints = _power_of_two(max(scale * most[1], _FEWEST_CONSTRAINTS))
    try:
        return WarpPhysics(model, num_envs, device, contacts, constraints)
    except (NotImplementedError, ValueError) as error:
        raise ConfigError(
            f"'physics' warp does not support the robot {config.robot_base!r}: {error} Use "
            "'physics' cpu."
        ) from error


@functools.lru_cache(maxsize=64)
def most_contacts(config: SafetyGymConfig, env_class: Any) -> tuple[int, int]:
    """Return the most contacts and constraint rows of a world in a trial of random actions."""

    class Trial(env_class):
        def _make_physics(self, model: mujoco.MjModel, num_threads: int) -> Physics:
            outputs = ("xpos", "xmat", "sensordata", "subtree_com", "ncon", "nefc")
            model = copy.copy(model)
            model.geom_margin[:] += _NEARLY
            return BatchPhysics(model, self.batch_size[0], num_threads, outputs)

    env = Trial(config.replace(physics="cpu"), TRIAL_WORLDS, seed=0, sleep=False)
    env._begin(torch.ones(TRIAL_WORLDS, dtype=torch.bool))
    generator = torch.Generator().manual_seed(0)
    counts = [env._physics.outputs[name] for name in ("ncon", "nefc")]
    highest = [int(count.max()) for count in counts]
    for _ in range(TRIAL_STEPS):
        env._advance(2 * torch.rand(env.action_spec.shape, generator=generator) - 1)
        highest = [max(most, int(count.max())) for most, count in zip(highest, counts, strict=True)]
    return highest[0], highest[1]


def _power_of_two(number: float) -> int:
    """Round up to a power of two, because kernels are compiled once for each size."""
    return 1 << (math.ceil(number) - 1).bit_length()
