"""The entry `privileged` of Safety Gym's environments, which critics may read and actors never do.

Critics exist only in training. So they may know what no sensor shows: what steps cost, where all
objects are and how they move (Pinto et al. 2018, "Asymmetric Actor Critic for Image-Based Robot
Learning").
"""

from __future__ import annotations

import torch
from torch import Tensor

from safe_rl.envs.contract import add_columns
from safe_rl.envs.safety_gym.world import World

TRACE_DECAY = 0.95
"""Weight of the past in a trace of costs: a mean over about the last 20 steps."""


class Privileged:
    """Computes the entry for N worlds; positions and velocities are in the robot's frame.

    Its components are `last_costs` and `cost_traces` (a column per cost key), `<kind>_position`
    and, of bodies that can be pushed, `<kind>_velocity` (x, y, z of every object; m, m/s),
    `buttons_timer` (steps until buttons have an effect again, as a share of those after a goal) and
    `since_goal` (steps since the goal changed, as a share of the longest episode).

    Args:
        world: The worlds.
        num_costs: Number of cost keys, K.

    Attributes:
        columns: Columns of every component.
        memory: What it remembers: `last_costs` and `cost_traces` [N, K], `since_goal` int64 [N].
    """

    def __init__(self, world: World, num_costs: int) -> None:
        scene, num_envs = world.scene, len(world.step_count)
        sizes = {"last_costs": num_costs, "cost_traces": num_costs}
        for kind, span in scene.slots.items():
            sizes[f"{kind}_position"] = 3 * (span.stop - span.start)
        for kind, span in scene.slots.items():
            if span.stop <= scene.num_free:
                sizes[f"{kind}_velocity"] = 3 * (span.stop - span.start)
        self.columns = add_columns({}, sizes | {"buttons_timer": 1, "since_goal": 1})
        self._world = world
        self.memory = {
            "last_costs": world.com.new_zeros(num_envs, num_costs),
            "cost_traces": world.com.new_zeros(num_envs, num_costs),
            "since_goal": torch.zeros_like(world.step_count),
        }

    def begin(self, mask: Tensor) -> None:
        """Forget what was before the episodes that begin in the worlds of a mask, bool [N]."""
        for tensor in self.memory.values():
            tensor.masked_fill_(mask.view(-1, *[1] * (tensor.ndim - 1)), 0)

    def update(self, costs: Tensor, met: Tensor) -> None:
        """Remember the costs of a step [K, N], and which worlds got a new goal, bool [N]."""
        last, traces, since_goal = self.memory.values()
        last.copy_(costs.T)
        traces.lerp_(last, 1 - TRACE_DECAY)
        since_goal.add_(1).masked_fill_(met, 0)

    def read(self) -> Tensor:
        """Return the entry for the present state, float32 [N, m]."""
        world = self._world
        last, traces, since_goal = self.memory.values()
        positions = (world.positions - world.robot_pos.unsqueeze(1)) @ world.robot_mat
        velocities = world.velocities @ world.robot_mat
        config = world.scene.config
        timer = world.buttons_timer / max(1, config.buttons_resampling_delay)
        counts = [timer, since_goal / config.num_steps]
        values = [last, traces, positions.flatten(1), velocities.flatten(1)]
        return torch.cat([*values, *(count.unsqueeze(1) for count in counts)], 1).float()
