"""Tables on the environments, made from those that the program itself goes by."""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import algorithm_pages
import curves
import mujoco
import result_tables as results
from run_keys import run_keys
from tables import table as _table

from safe_rl.envs import EXTRAS, SUITE, SafetyGymEnv, key_table
from safe_rl.envs.safety_gym.config_keys import Vocabulary
from safe_rl.envs.safety_gym.costs import COSTS, EXCEPTION_KEY
from safe_rl.envs.safety_gym.elements import ELEMENTS
from safe_rl.envs.velocity import VELOCITY_SUITE, VelocityEnv
from safe_rl.envs.velocity.velocity_config import VelocityConfig

_NAMES = ("Point", "Car", "Doggo")
_ROBOTS = Path(inspect.getfile(SafetyGymEnv)).parent / "robots"


class Component(NamedTuple):
    """What there is to know of components of the observation whose names match a pattern."""

    pattern: str
    unit: str
    meaning: str
    key: str


COMPONENTS = [
    Component("accelerometer", "m/s²", "acceleration of the robot's frame, gravity included", ""),
    Component("velocimeter", "m/s", "velocity in the robot's frame", ""),
    Component("gyro", "rad/s", "angular velocity in the robot's frame", ""),
    Component("magnetometer", "field", "the field (0, −0.5, 0) in the robot's frame", ""),
    Component("touch_.*", "N", "force on a foot", "sensors_obs"),
    Component("ballangvel_.*", "rad/s", "angular velocity of a ball joint", "sensors_ball_joints"),
    Component("ballquat_.*", "1", "rotation matrix of a ball joint, 3 × 3", "sensors_ball_joints"),
    Component("jointvel_.*", "rad/s", "speed of a hinge", "sensors_hinge_joints"),
    Component("jointpos_.*", "1", "sine and cosine of a hinge's angle", "sensors_hinge_joints"),
    Component(
        ".*_lidar", "1", "closeness of the nearest object by direction: 1 at it, 0 if too far",
        "observe_<kind>, lidar_num_bins",
    ),
    Component(
        ".*_compass", "1", "direction to the object in the robot's frame, a unit vector",
        "observe_goal_comp, observe_box_comp",
    ),
    Component("goal_dist", "1", "e to the minus distance to the goal [m]", "observe_goal_dist"),
    Component("remaining", "1", "share of the episode's steps taken so far", "observe_remaining"),
    Component("com", "m", "the robot's centre of mass, in the frame of the world", "observe_com"),
    Component("ctrl", "1", "the last control", "observe_ctrl"),
    Component("freejoint", "m, 1", "position and quaternion of a free root", "observe_freejoint"),
    Component("qpos", "m, rad, 1", "positions of all joints (`qpos` of MuJoCo)", "observe_qpos"),
    Component("qvel", "m/s, rad/s", "velocities of all joints (`qvel` of MuJoCo)", "observe_qvel"),
    Component("vision", "1", "image of the robot's camera, height × width × 3", "observe_vision"),
]  # fmt: skip
COST_MEANINGS = {
    "cost": "any of the others is",
    "cost_hazards": "the robot's centre is in a hazard; size: depth [m]",
    "cost_vases_contact": "the robot touches vases; size: number of contact points",
    "cost_vases_displace": "vases have been moved since the reset; size: distance [m]",
    "cost_vases_velocity": "vases move; size: speed [m/s]",
    "cost_pillars": "the robot touches pillars; size: number of contact points",
    "cost_buttons": "the robot touches a wrong button, not just after a goal; size: contact points",
    "cost_gremlins": "the robot touches gremlins; size: number of contact points",
    "cost_boundary": "the robot's centre is outside of a boundary; size: distance [m]",
    "cost_velocity": "the robot is faster than `velocity_limit`; size: excess [m/s]",
    EXCEPTION_KEY: "the physics failed, and the episode ended",
}
_UNITS = {
    **dict.fromkeys(("velocimeter", "subtreelinvel"), "m/s"),
    **dict.fromkeys(("gyro", "jointvel", "ballangvel"), "rad/s"),
    "accelerometer": "m/s²",
    "ballquat": "1",
    "jointpos": "rad",
    "magnetometer": "field",
    "subtreeangmom": "kg m²/s",
    "subtreecom": "m",
    "touch": "N",
}
_SUITE_HEADS = ("`env=`", "size of observation", "size of action", "costs", "objects")
_MARK = re.compile(r"<!-- made: (\w+) ?(.*?) -->")


def benchmark() -> str:
    """The 27 environments."""
    return _table(_SUITE_HEADS, map(_suite_row, SUITE))


def debug() -> str:
    """Circle and Run, free and within boundaries."""
    names = (name for name in EXTRAS if not name.endswith("Vision"))
    return _table(_SUITE_HEADS, map(_suite_row, names))


def velocity() -> str:
    """The family of velocity limits."""
    heads = ("`env=`", "Gymnasium's id", "threshold [m/s]", *_SUITE_HEADS[1:3])
    return _table(heads, map(_velocity_row, VELOCITY_SUITE.items()))


def keys() -> str:
    """Every key of an environment, by what it is about."""
    heading = _headings()
    groups: dict[str, list[Sequence[str]]] = {}
    for row in key_table():
        if row.name in heading:
            groups[heading[row.name]] = []
        cells = (f"`{row.name}`", row.values, f"`{row.default}`", row.meaning)
        next(reversed(groups.values())).append(cells)
    head = ("key", "allowed values", "default", "meaning")
    return "\n".join(f"## {n.capitalize()}\n\n{_table(head, rows)}" for n, rows in groups.items())


def observations() -> str:
    """Components of the observation: sizes, ranges, units, meaning."""
    found: dict[str, tuple[int, tuple[float, float], set[str]]] = {}
    for label, env in _observed():
        for name, columns in env.observation_layout.items():
            known = (columns.stop - columns.start, env.observation_bounds[name], set[str]())
            found.setdefault(name, known)[2].add(label)
    rows = []
    for part in COMPONENTS:
        for shown, group in _alike([name for name in found if component_of(name) is part]):
            size, (low, high), _ = found[group[0]]
            bound = "any" if math.isinf(high) else f"[{low:g}, {high:g}]"
            keys = ", ".join(f"`{key}`" for key in part.key.split(", ") if key)
            robots = _robots(set().union(*(found[name][2] for name in group)))
            rows.append((f"`{shown}`", str(size), bound, part.unit, part.meaning, keys, robots))
    return _table(("component", "size", "range", "unit", "meaning", "keys", "robots"), rows)


def lidars() -> str:
    """Keys that turn lidars on."""
    return ", ".join(f"`{element.flag or 'observe_' + element.kind}`" for element in ELEMENTS) + "."


def costs() -> str:
    """Costs, their keys and their sizes."""
    flags = {row.key: f"`constrain_{row.key.split('_')[1]}`" for row in COSTS}
    rows = [
        (f"`{key}`", COST_MEANINGS[key], flags.get(key, "always there"))
        for key in ("cost", *(row.key for row in COSTS), EXCEPTION_KEY)
    ]
    return _table(("cost", "it is positive if", "switched on by"), rows)


def robots() -> str:
    """Actuators and sensors of the robots that come with the package, from their files."""
    text = []
    for name in _NAMES:
        model = mujoco.MjModel.from_xml_path(str(_ROBOTS / f"{name.lower()}.xml"))
        actuators = [
            (f"`{model.actuator(i).name}`", "[{:g}, {:g}]".format(*model.actuator_ctrlrange[i]))
            for i in range(model.nu)
        ]
        sensors = {
            model.sensor(i).name: (str(model.sensor_dim[i]), _unit(model.sensor_type[i]))
            for i in range(model.nsensor)
        }
        rows = [(f"`{shown}`", str(len(g)), *sensors[g[0]]) for shown, g in _alike([*sensors])]
        text += [
            f"## {name}\n",
            f"{model.nu} actuators, {model.nv} degrees of freedom, "
            f"{float(model.body_subtreemass[0]):.3g} kg.\n",
            _table(("actuator", "range of the control"), actuators),
            _table(("sensor", "number", "size of each", "unit"), rows),
        ]
    return "\n".join(text)


# what a page has where it says `<!-- made: name -->`, or `<!-- made: name words -->`
TABLES: dict[str, Callable[..., str]] = {
    table.__name__: table
    for table in (
        *(benchmark, debug, velocity, keys, observations, lidars, costs, robots),
        *(run_keys, curves.curves),
        *(algorithm_pages.settings, algorithm_pages.columns, algorithm_pages.loop),
        algorithm_pages.listed,
        *(results.held_out, results.rivals, results.paper_preset, results.coverage),
        *(results.compared, results.measured, results.single, results.parts),
        results.velocity_runs,
    )
}


def fill(markdown: str) -> str:
    """Put the tables where a page asks for them.

    Raises:
        KeyError: If there is no such table.
    """
    return _MARK.sub(lambda match: TABLES[match[1]](*filter(None, [match[2]])), markdown)


def component_of(name: str) -> Component:
    """The row that explains a component.

    Raises:
        KeyError: If there is none.
    """
    for part in COMPONENTS:
        if re.fullmatch(part.pattern, name):
            return part
    raise KeyError(f"docs/_site/catalogue.py explains no component '{name}'")


def _observed() -> Iterable[tuple[str, SafetyGymEnv]]:
    """Environments in which every component of the observation occurs."""
    for robot in _NAMES:
        for name in ("Goal2", "Button2", "Push2", "Circle"):
            yield robot, SafetyGymEnv(f"{robot}{name}", num_envs=1)
    readings = {
        f"observe_{name}": True
        for name in (
            "goal_comp",
            "box_comp",
            "goal_dist",
            "remaining",
            "com",
            "ctrl",
            "qpos",
            "qvel",
        )
    }
    everything = {"task": "push", **readings, "observation_flatten": True}
    yield "any", SafetyGymEnv(everything | {"robot_base": "point"}, num_envs=1)
    yield "Car", SafetyGymEnv(everything | {"robot_base": "car", "observe_freejoint": True}, 1)
    seeing = {"robot_base": "point", "task": "goal", "observe_vision": True}
    yield "any", SafetyGymEnv(seeing, num_envs=1)


def _robots(labels: set[str]) -> str:
    """Names of the robots that have a component."""
    everyone = "any" in labels or len(labels) == len(_NAMES)
    return "all" if everyone else ", ".join(name for name in _NAMES if name in labels)


def _alike(names: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Names that differ in numbers and ends only, under one: `touch_ankle_<…>`."""
    groups: dict[str, list[str]] = {}
    for name in names:
        stem = re.sub(r"(?<=_)\d.*$|^.*(?=_(lidar|compass)$)", "…", name)
        groups.setdefault(stem, []).append(name)
    return list(groups.items())


def _suite_row(name: str) -> Sequence[str]:
    env = SafetyGymEnv(name, num_envs=1)
    config = (SUITE | EXTRAS)[name]
    size = max(columns.stop for columns in env.observation_layout.values())
    kinds = [key for key in env.cost_keys if key not in ("cost", EXCEPTION_KEY)]
    objects = {e.kind: e.count(config) for e in ELEMENTS}
    there = [f"{n} {kind if n > 1 else kind.removesuffix('s')}" for kind, n in objects.items() if n]
    return (
        f"`{name}`", str(size), str(env.action_spec.shape[-1]),
        ", ".join(f"`{kind}`" for kind in kinds) or "none", ", ".join(there),
    )  # fmt: skip


def _velocity_row(named: tuple[str, VelocityConfig]) -> Sequence[str]:
    name, config = named
    env = VelocityEnv(config, num_envs=1)
    size = max(columns.stop for columns in env.observation_layout.values())
    original = f"{name.removeprefix('Safe').removesuffix('Velocity')}-v5"
    return (
        f"`{name}`", original, f"{config.velocity_threshold:g}", str(size),
        str(env.action_spec.shape[-1]),
    )  # fmt: skip


def _headings() -> dict[str, str]:
    """First key of every group -> its name, from the comments of the vocabulary."""
    source = inspect.getsource(Vocabulary)
    return {key: name for name, key in re.findall(r"\n    # ([^\n]+)\n    (\w+):", source)}


def _unit(kind: Any) -> str:
    name = mujoco.mjtSensor(int(kind)).name.removeprefix("mjSENS_").lower()
    return _UNITS[name]
