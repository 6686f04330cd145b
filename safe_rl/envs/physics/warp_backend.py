"""Build the physics on MuJoCo Warp: sizes of its buffers, and checks of what it supports."""

from __future__ import annotations

import copy
import functools
import math
from collections.abc import Sequence
from typing import Any

import mujoco
import torch

from safe_rl.envs.keys import ConfigError
from safe_rl.envs.physics import OUTPUTS, BatchPhysics, Physics
from safe_rl.extras import require_extra

# Size of the trial that counts contacts.
TRIAL_WORLDS, TRIAL_STEPS = 32, 50
_FEWEST_CONTACTS, _FEWEST_CONSTRAINTS = 32, 128
_NEARLY = 1e-3  # margin of geoms in the trial [m], because contacts on the device differ a little


def make_warp_physics(env: Any, model: mujoco.MjModel, outputs: Sequence[str]) -> Physics:
    """Build the physics for the value "warp" of the key `physics`.

    Args:
        env: The environment; another one of its family makes a trial on the CPU.
        model: Its compiled world.
        outputs: Names of the fields of `MjData` that are read.

    Raises:
        ConfigError: If MuJoCo Warp does not support the robot, or for an unsupported device.
        ModuleNotFoundError: If MuJoCo Warp is not installed.
    """
    config, device, num_envs = env.config, env.device, env.batch_size[0]
    if device.type not in ("cpu", "cuda"):
        raise ConfigError(f"'physics' warp runs on the devices cpu and cuda, got {device}.")
    require_extra("mujoco_warp", extra="gpu")
    from safe_rl.envs.physics.warp_physics import WarpPhysics

    # a class of the user's may have another constructor
    family: Any = next(c for c in type(env).__mro__ if c.__module__.startswith("safe_rl."))
    most, scale = most_contacts(config, family), config.physics_buffers
    contacts = _power_of_two(max(scale * most[0], _FEWEST_CONTACTS))
    constraints = _power_of_two(max(scale * most[1], _FEWEST_CONSTRAINTS))
    try:
        return WarpPhysics(model, num_envs, device, contacts, constraints, outputs)
    except (NotImplementedError, ValueError) as error:
        raise ConfigError(
            f"'physics' warp does not support the robot of this environment: {error} Use "
            "'physics' cpu."
        ) from error


@functools.lru_cache(maxsize=64)
def most_contacts(config: Any, env_class: Any) -> tuple[int, int]:
    """Return the most contacts and constraint rows of a world in a trial of random actions."""

    class Trial(env_class):
        def _make_physics(
            self, model: mujoco.MjModel, bodies: slice, num_threads: int, outputs: Any = OUTPUTS
        ) -> Physics:
            model = copy.copy(model)
            model.opt.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
            model.geom_margin[:] += _NEARLY
            counted = (*outputs, "ncon", "nefc")
            return BatchPhysics(model, self.batch_size[0], num_threads, counted)

    env = Trial(config.replace(physics="cpu"), TRIAL_WORLDS, seed=0)
    env._begin(torch.ones(TRIAL_WORLDS, dtype=torch.bool))
    generator = torch.Generator().manual_seed(0)
    counts = [env._physics.outputs[name] for name in ("ncon", "nefc")]
    highest = [int(count.max()) for count in counts]
    low, high = env.action_spec.space.low, env.action_spec.space.high
    for _ in range(TRIAL_STEPS):
        env._advance(low + (high - low) * torch.rand(low.shape, generator=generator))
        highest = [max(most, int(count.max())) for most, count in zip(highest, counts, strict=True)]
    return highest[0], highest[1]


def _power_of_two(number: float) -> int:
    """Round up to a power of two, because kernels are compiled once for each size."""
    return 1 << (math.ceil(number) - 1).bit_length()
