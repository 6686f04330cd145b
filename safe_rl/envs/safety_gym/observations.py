"""The observation: its components, their sizes, order and values.

Components that are computed together are a block. The components of the observation are in the
alphabetical order of their names (paper section 4.1.4).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from safe_rl.envs.contract import add_columns
from safe_rl.envs.errors import ConfigError
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.lidar import lidar_blocks
from safe_rl.envs.safety_gym.readings import Reading, active_readings, sensor_blocks
from safe_rl.envs.safety_gym.renderer import vision_block
from safe_rl.envs.safety_gym.world import Block, Bounds, Scene, Shapes, World


def _read(row: Reading, size: int, world: World) -> Tensor:
    """Return the values of a reading [N, size]; ConfigError if their shape is wrong."""
    return world.require(f"The observation '{row.name}'", row.read(world), size)


class Observer(NamedTuple):
    """Computes the observations of the worlds of one scene.

    Attributes:
        shapes: Shape of every component, in the order of the flat observation.
        columns: Columns of every component in the flat observation.
        read: World -> flat observation [N, n], float32.
        bounds: Lowest and highest value of every component.
    """

    shapes: Shapes
    columns: dict[str, slice]
    read: Callable[[World], Tensor]
    bounds: dict[str, Bounds]

    def split(self, flat: Tensor) -> dict[str, Tensor]:
        """Return views of a flat observation [N, n] by component, each [N, *shape]."""
        return {
            name: flat[:, self.columns[name]].unflatten(1, shape)
            for name, shape in self.shapes.items()
        }


def make_observer(scene: Scene, device: torch.device) -> Observer:
    """Build the observer of a scene; ConfigError if a component cannot be observed."""
    config = scene.config
    blocks = [*sensor_blocks(scene, device), *lidar_blocks(scene, device)]
    for row in active_readings(config):
        size = row.size(config, scene)
        blocks.append(Block({row.name: (size,)}, partial(_read, row, size), row.bounds))
    if config.observe_vision:
        blocks.append(vision_block(scene))
    names = [name for block in blocks for name in block.shapes]
    if not names:
        raise ConfigError("Nothing is observed: set at least one 'observe_*' key.")
    for name in names:
        if names.count(name) > 1:
            raise ConfigError(
                f"Two observations are called '{name}': rename the robot's sensor, or the "
                "observation that was registered."
            )
    unordered: Shapes = {name: shape for block in blocks for name, shape in block.shapes.items()}
    shapes = {name: unordered[name] for name in sorted(unordered)}
    read_at, columns = (
        add_columns({}, {name: math.prod(shape) for name, shape in each.items()})
        for each in (unordered, shapes)
    )
    order = [i for name in shapes for i in range(read_at[name].start, read_at[name].stop)]
    permutation = torch.tensor(order, device=device)

    def read(world: World) -> Tensor:
        values = torch.cat([block.read(world) for block in blocks], -1)
        return values.to(torch.float32).index_select(1, permutation)

    bounds = {name: block.bounds for block in blocks for name in block.shapes}
    return Observer(shapes, columns, read, bounds)


def observation_spec(
    config: SafetyGymConfig, observer: Observer, num_envs: int, device: torch.device | None
) -> TensorSpec:
    """Return the spec of one flat vector, or of every component in its shape, with bounds."""
    kind: dict[str, Any] = {"dtype": torch.float32, "device": device}
    bounds = {name: torch.tensor(observer.bounds[name]) for name in observer.shapes}
    if config.observation_flatten:
        widths = torch.tensor([math.prod(shape) for shape in observer.shapes.values()])
        flat = torch.stack(list(bounds.values()), 1).repeat_interleave(widths, dim=1)
        return _within(flat, (num_envs, flat.shape[1]), kind)
    components = {
        name: _within(bounds[name], (num_envs, *shape), kind)
        for name, shape in observer.shapes.items()
    }
    return Composite(components, shape=(num_envs,))


def _within(bounds: Tensor, shape: tuple[int, ...], kind: dict[str, Any]) -> TensorSpec:
    """Return the spec of numbers within (low, high); an infinite bound gets a very large one."""
    if bounds.isinf().all():
        return Unbounded(shape=shape, **kind)
    # half of the largest number, so that the width of the range is finite
    far = torch.finfo(kind["dtype"]).max / 2
    low, high = (bound.clamp(-far, far).expand(shape).clone() for bound in bounds)
    return Bounded(low, high, shape=shape, **kind)
