"""What is observed: components, their sizes, order and values, and the entry `privileged`.

Components that are computed together are a block: the robot's sensors, the lidars (`lidar`), the
camera's picture (`renderer`), and each row of the table `READINGS`. The components of the
observation are in the alphabetical order of their names (paper sections 4.1.1 and 4.1.4).
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import mujoco
import torch
from torch import Tensor
from torchrl.data import Bounded, Composite, TensorSpec, Unbounded

from safe_rl.envs.contract import add_columns
from safe_rl.envs.keys import ConfigError
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.lidar import lidar_blocks
from safe_rl.envs.safety_gym.tasks import TASKS, goal_distance
from safe_rl.envs.safety_gym.world import UNBOUNDED, Block, Bounds, Scene, Shapes, World
from safe_rl.naming import did_you_mean


class Reading(NamedTuple):
    """A row: one component of the observation.

    Attributes:
        name: Name of the component.
        flags: Configuration keys that must all be true, or not 0, for the component to exist.
        size: Number of values.
        read: World -> [N, size].
        touches: Kinds of objects whose contacts with the robot it reads.
        bounds: Lowest and highest value.
        kind: Kind of object that the task must have; "" for none.
    """

    name: str
    flags: tuple[str, ...]
    size: Callable[[SafetyGymConfig, Scene], int]
    read: Callable[[World], Tensor]
    touches: tuple[str, ...] = ()
    bounds: Bounds = UNBOUNDED
    kind: str = ""


def _compass(world: World, kind: str) -> Tensor:
    """Return nearly unit vectors to a kind's objects in the robot's frame, flattened [N, D]."""
    ego = (world.at(kind) - world.robot_pos.unsqueeze(-2)) @ world.robot_mat
    vector = ego[..., : world.scene.config.compass_shape]
    length = torch.linalg.vector_norm(vector, dim=-1, keepdim=True)
    return (vector / (length + 1e-3)).flatten(1)


def _freejoint_size(config: SafetyGymConfig, scene: Scene) -> int:
    if scene.planar:
        raise ConfigError(
            f"'observe_freejoint': robot '{config.robot_base}' has no free joint. Use "
            "'observe_qpos' instead."
        )
    return 7


def _from_start(world: World, vector: Tensor, moved: bool) -> Tensor:
    """Return a planar robot's coordinates in the frame of its start; others are unchanged.

    With `moved`, the pose of the start is subtracted first. Velocities are only rotated.
    """
    if not world.scene.planar:
        return vector
    start = world.start_pose if moved else torch.zeros_like(world.start_pose)
    (dx, dy, dyaw) = (vector[:, :3] - start).unbind(-1)
    cos, sin = torch.cos(world.start_pose[:, 2]), torch.sin(world.start_pose[:, 2])
    local = torch.stack([cos * dx + sin * dy, cos * dy - sin * dx, dyaw], -1)
    return torch.cat([local, vector[:, 3:]], -1)


READINGS: list[Reading] = [
    Reading("goal_compass", ("observe_goal_comp",), lambda c, s: c.compass_shape,
            lambda w: _compass(w, "goal"), bounds=(-1.0, 1.0), kind="goal"),
    Reading("box_compass", ("observe_box_comp",), lambda c, s: c.compass_shape,
            lambda w: _compass(w, "box"), bounds=(-1.0, 1.0), kind="box"),
    Reading("goal_dist", ("observe_goal_dist",), lambda c, s: 1,
            lambda w: torch.exp(-goal_distance(w)), bounds=(0.0, 1.0), kind="goal"),
    Reading("remaining", ("observe_remaining",), lambda c, s: 1,
            lambda w: (w.step_count / w.scene.config.num_steps).unsqueeze(-1)),
    Reading("com", ("observe_com",), lambda c, s: 3, lambda w: w.com),
    Reading("ctrl", ("observe_ctrl",), lambda c, s: s.model.nu, lambda w: w.ctrl),
    Reading("freejoint", ("observe_freejoint",), _freejoint_size, lambda w: w.qpos[:, :7]),
    Reading("qpos", ("observe_qpos",), lambda c, s: s.model.nq,
            lambda w: _from_start(w, w.qpos, moved=True)),
    Reading("qvel", ("observe_qvel",), lambda c, s: s.model.nv,
            lambda w: _from_start(w, w.qvel, moved=False)),
]  # fmt: skip


def active_readings(config: SafetyGymConfig) -> list[Reading]:
    """Return the rows of the present table that a configuration has."""
    task = TASKS[config.task]
    kinds = ("", *task.elements, *task.at_origin)
    flagged = (row for row in READINGS if all(getattr(config, flag) for flag in row.flags))
    return [row for row in flagged if row.kind in kinds]


def sensor_blocks(scene: Scene, device: torch.device) -> list[Block]:
    """Return the robot's sensors: raw values, hinges as (sin, cos), balls as rotation matrices."""
    config = scene.config
    if not config.observe_sensors:
        return []
    model, sensor, joint = scene.model, mujoco.mjtSensor, mujoco.mjtJoint
    known = {model.sensor(i).name: i for i in range(scene.robot_sensors)}
    on_joint: dict[tuple[int, int], list[int]] = defaultdict(list)
    for i in range(scene.robot_sensors):
        if model.sensor_objtype[i] == mujoco.mjtObj.mjOBJ_JOINT:
            on_joint[model.sensor_type[i], model.jnt_type[model.sensor_objid[i]]].append(i)
    for kind in (sensor.mjSENS_JOINTPOS, sensor.mjSENS_JOINTVEL):
        for i in on_joint[kind, joint.mjJNT_SLIDE]:
            raise ConfigError(
                f"'robot_base': {config.robot_base} has the sensor '{model.sensor(i).name}' "
                "on a slide joint, but observations must not depend on the world's origin: remove "
                "the sensor, or set 'observe_sensors' to False."
            )
    for name in config.sensors_obs:
        if name not in known:
            raise ConfigError(
                f"'sensors_obs': robot '{config.robot_base}' has no sensor '{name}'."
                f"{did_you_mean(name, known)} It has {', '.join(known) or 'none'}: add the sensor "
                "to the robot's file, or list only those it has."
            )
    raw, angles, quaternions = [known[name] for name in config.sensors_obs], [], []
    if config.sensors_hinge_joints:
        raw += on_joint[sensor.mjSENS_JOINTVEL, joint.mjJNT_HINGE]
        angles += on_joint[sensor.mjSENS_JOINTPOS, joint.mjJNT_HINGE]
    if config.sensors_ball_joints:
        raw += on_joint[sensor.mjSENS_BALLANGVEL, joint.mjJNT_BALL]
        quaternions += on_joint[sensor.mjSENS_BALLQUAT, joint.mjJNT_BALL]
    # as in 2019, a listed sensor that measures a joint is observed once, as one of a joint
    raw = [i for i in dict.fromkeys(raw) if i not in (*angles, *quaternions)]
    if not config.sensors_angle_components:
        raw, angles, quaternions = raw + angles + quaternions, [], []
    groups = (
        (raw, None, torch.clone),
        (angles, (2,), lambda angle: torch.stack([torch.sin(angle), torch.cos(angle)], -1)),
        (quaternions, (3, 3), lambda q: rotation_matrix(q.unflatten(1, (-1, 4)))),
    )
    return [
        _sensor_block(model, sensors, shape, convert, device)
        for sensors, shape, convert in groups
        if sensors
    ]


def _sensor_block(
    model: mujoco.MjModel,
    sensors: list[int],
    shape: tuple[int, ...] | None,
    convert: Callable[[Tensor], Tensor],
    device: torch.device,
) -> Block:
    """Return the block of some sensors; shape None keeps the size that a sensor has in MuJoCo."""
    shapes: Shapes = {model.sensor(i).name: shape or (int(model.sensor_dim[i]),) for i in sensors}
    numbers = [model.sensor_adr[i] + part for i in sensors for part in range(model.sensor_dim[i])]
    columns = torch.tensor(numbers, dtype=torch.int64, device=device)
    return Block(shapes, lambda w: convert(w.sensordata.index_select(1, columns)).flatten(1))


def rotation_matrix(quaternion: Tensor) -> Tensor:
    """Convert unit quaternions (w, x, y, z) [..., 4] to rotation matrices [..., 3, 3]."""
    w, x, y, z = quaternion.unbind(-1)
    rows = (
        *(w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)),
        *(2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)),
        *(2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z),
    )
    return torch.stack(rows, -1).unflatten(-1, (3, 3))


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


def make_observer(scene: Scene, device: torch.device, others: Sequence[Block] = ()) -> Observer:
    """Build the observer of a scene, with other blocks; ConfigError if one cannot be observed."""
    config = scene.config
    blocks = [*sensor_blocks(scene, device), *lidar_blocks(scene, device)]
    for row in active_readings(config):
        size = row.size(config, scene)
        blocks.append(Block({row.name: (size,)}, partial(_read, row, size), row.bounds))
    blocks += others
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
    shapes = dict(sorted(unordered.items()))
    read_at, columns = (
        add_columns({}, {name: math.prod(shape) for name, shape in each.items()})
        for each in (unordered, shapes)
    )
    order = [i for name in shapes for i in range(read_at[name].start, read_at[name].stop)]
    permutation = torch.tensor(order, device=device)

    def read(world: World) -> Tensor:
        values = torch.cat([block.read(world) for block in blocks], -1)
        return values.to(torch.float32).index_select(1, permutation)

    return Observer(
        shapes, columns, read, {n: block.bounds for block in blocks for n in block.shapes}
    )


def observation_spec(
    config: SafetyGymConfig, observer: Observer, num_envs: int, device: torch.device | None
) -> TensorSpec:
    """Return the spec of one flat vector, or of every component in its shape, with bounds."""
    bounds = {name: torch.tensor(observer.bounds[name]) for name in observer.shapes}
    if config.observation_flatten:
        widths = torch.tensor([math.prod(shape) for shape in observer.shapes.values()])
        flat = torch.stack(list(bounds.values()), 1).repeat_interleave(widths, dim=1)
        return _within(flat, (num_envs, flat.shape[1]), device)
    components = {
        name: _within(bounds[name], (num_envs, *shape), device)
        for name, shape in observer.shapes.items()
    }
    return Composite(components, shape=(num_envs,))


def _within(bounds: Tensor, shape: tuple[int, ...], device: torch.device | None) -> TensorSpec:
    """Return the spec of numbers within (low, high); an infinite bound gets a very large one."""
    if bounds.isinf().all():
        return Unbounded(shape=shape, dtype=torch.float32, device=device)
    # half of the largest number, so that the width of the range is finite
    far = torch.finfo(torch.float32).max / 2
    low, high = (bound.clamp(-far, far).expand(shape).clone() for bound in bounds)
    return Bounded(low, high, shape=shape, dtype=torch.float32, device=device)


TRACE_DECAY = 0.95
"""Weight of the past in a trace of costs: a mean over about the last 20 steps."""


class Privileged:
    """Computes the entry `privileged` of N worlds, which critics may read and actors never do.

    Critics exist only in training, so they may know what no sensor shows (Pinto et al. 2018,
    "Asymmetric Actor Critic for Image-Based Robot Learning"). Vectors are in the robot's frame.

    Its components are `last_costs` and `cost_traces` (a column per cost key), `<kind>_position`
    and, of bodies that can be pushed, `<kind>_velocity` (x, y, z of every object; m, m/s),
    `buttons_timer` (steps until buttons have an effect again, as a share of those after a goal) and
    `since_goal` (steps since the goal changed, as a share of the longest episode).

    Args:
        world: The worlds.
        num_costs: Number of cost keys, K.

    Attributes:
        columns: Columns of every component.
        past: What it remembers: `last_costs` and `cost_traces` [N, K], `since_goal` int64 [N].
    """

    def __init__(self, world: World, num_costs: int) -> None:
        scene, num_envs = world.scene, len(world.step_count)
        numbers = {kind: 3 * (span.stop - span.start) for kind, span in scene.slots.items()}
        free = {kind: n for kind, n in numbers.items() if scene.slots[kind].stop <= scene.num_free}
        sizes = {
            **{"last_costs": num_costs, "cost_traces": num_costs},
            **{f"{kind}_position": number for kind, number in numbers.items()},
            **{f"{kind}_velocity": number for kind, number in free.items()},
            **{"buttons_timer": 1, "since_goal": 1},
        }
        asked = scene.config.observe_privileged
        chosen = tuple(sizes) if isinstance(asked, bool) else asked
        for name in (name for name in chosen if name not in sizes):
            raise ConfigError(
                f"'observe_privileged': there is no component '{name}'."
                f"{did_you_mean(name, sizes)} Here there are {', '.join(sizes)}."
            )
        self.columns = add_columns({}, {name: n for name, n in sizes.items() if name in chosen})
        is_kept = [name in chosen for name, size in sizes.items() for _ in range(size)]
        self._kept = torch.tensor(is_kept, device=world.com.device).nonzero().squeeze(1)
        self._world = world
        self.past = {
            "last_costs": world.com.new_zeros(num_envs, num_costs),
            "cost_traces": world.com.new_zeros(num_envs, num_costs),
            "since_goal": torch.zeros_like(world.step_count),
        }

    def begin(self, mask: Tensor) -> None:
        """Forget what was before the episodes that begin in the worlds of a mask, bool [N]."""
        for tensor in self.past.values():
            tensor.masked_fill_(mask.view(-1, *[1] * (tensor.ndim - 1)), 0)

    def update(self, costs: Tensor, met: Tensor) -> None:
        """Remember the costs of a step [K, N], and which worlds got a new goal, bool [N]."""
        last, traces, since_goal = self.past.values()
        last.copy_(costs.T)
        traces.lerp_(last, 1 - TRACE_DECAY)
        since_goal.add_(1).masked_fill_(met, 0)

    def read(self) -> Tensor:
        """Return the entry for the present state, float32 [N, m]."""
        world = self._world
        last, traces, since_goal = self.past.values()
        positions = (world.positions - world.robot_pos.unsqueeze(1)) @ world.robot_mat
        velocities = world.velocities @ world.robot_mat
        config = world.scene.config
        timer = world.buttons_timer / max(1, config.buttons_resampling_delay)
        counts = [timer, since_goal / config.num_steps]
        values = [last, traces, positions.flatten(1), velocities.flatten(1)]
        entry = torch.cat([*values, *(count.unsqueeze(1) for count in counts)], 1)
        return entry.index_select(1, self._kept).float()
