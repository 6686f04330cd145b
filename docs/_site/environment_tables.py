"""Tables on the environments, made from those that the program itself goes by."""

from __future__ import annotations

import inspect
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from result_tables import markdown as table

from safe_rl.envs import EXTRAS, SUITE, SafetyGymEnv
from safe_rl.envs.keys import adapter
from safe_rl.envs.safety_gym.config import KEYS
from safe_rl.envs.safety_gym.config_keys import Keys
from safe_rl.envs.safety_gym.costs import COSTS, EXCEPTION_KEY
from safe_rl.envs.safety_gym.elements import ELEMENTS
from safe_rl.envs.velocity import VELOCITY_SUITE, VelocityEnv

_NAMES = ("Point", "Car", "Doggo")
# pattern of names -> unit, meaning, and keys that turn these components of the observation on
COMPONENTS = {
    "accelerometer": ("m/s²", "acceleration of the robot's frame, gravity included", ""),
    "velocimeter": ("m/s", "velocity in the robot's frame", ""),
    "gyro": ("rad/s", "angular velocity in the robot's frame", ""),
    "magnetometer": ("field", "the field (0, −0.5, 0) in the robot's frame", ""),
    "touch_.*": ("N", "force on a foot", "sensors_obs"),
    "ballangvel_.*": ("rad/s", "angular velocity of a ball joint", "sensors_ball_joints"),
    "ballquat_.*": ("1", "rotation matrix of a ball joint, 3 × 3", "sensors_ball_joints"),
    "jointvel_.*": ("rad/s", "speed of a hinge", "sensors_hinge_joints"),
    "jointpos_.*": ("1", "sine and cosine of a hinge's angle", "sensors_hinge_joints"),
    ".*_lidar": ("1", "closeness of the nearest, by direction", "observe_<kind>, lidar_num_bins"),
    ".*_compass": ("1", "unit vector in the robot's frame", "observe_goal_comp, observe_box_comp"),
    "goal_dist": ("1", "e to the minus distance to the goal [m]", "observe_goal_dist"),
    "remaining": ("1", "share of the episode's steps taken so far", "observe_remaining"),
    "com": ("m", "the robot's centre of mass, in the frame of the world", "observe_com"),
    "ctrl": ("1", "the last control", "observe_ctrl"),
    "freejoint": ("m, 1", "position and quaternion of a free root", "observe_freejoint"),
    "qpos": ("m, rad, 1", "positions of all joints (`qpos` of MuJoCo)", "observe_qpos"),
    "qvel": ("m/s, rad/s", "velocities of all joints (`qvel` of MuJoCo)", "observe_qvel"),
    "vision": ("1", "image of the robot's camera, height × width × 3", "observe_vision"),
}
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


def benchmark() -> str:
    """The 27 environments."""
    return _suite_table(SUITE)


def debug() -> str:
    """Circle and Run, free and within boundaries."""
    return _suite_table(name for name in EXTRAS if not name.endswith("Vision"))


def _suite_table(names: Iterable[str]) -> str:
    rows = []
    for name in names:
        env = SafetyGymEnv(name, num_envs=1)
        kinds = [f"`{key}`" for key in env.cost_keys if key not in ("cost", EXCEPTION_KEY)]
        numbers = [(len(e.names(env.config)), e) for e in ELEMENTS]
        there = [f"{n} {e.kind if n > 1 else e.label}" for n, e in numbers if n]
        rows.append([f"`{name}`", *_sizes(env), ", ".join(kinds) or "none", ", ".join(there)])
    return table(["`env=`", "size of observation", "size of action", "costs", "objects"], rows)


def _sizes(env: SafetyGymEnv | VelocityEnv) -> tuple[int, int]:
    return max(c.stop for c in env.observation_layout.values()), env.action_spec.shape[-1]


def velocity() -> str:
    """The family of velocity limits."""
    rows = []
    for name, keys in VELOCITY_SUITE.items():
        id_of_gymnasium = f"{name.removeprefix('Safe').removesuffix('Velocity')}-v5"
        sizes = _sizes(VelocityEnv(keys, num_envs=1))
        rows.append([f"`{name}`", id_of_gymnasium, f"{keys['velocity_threshold']:g}", *sizes])
    head = ["`env=`", "Gymnasium's id", "threshold [m/s]", "size of observation", "size of action"]
    return table(head, rows)


def keys() -> str:
    """Every key of an environment, by what it is about: the comments of the dataclass."""
    source = inspect.getsource(Keys)
    heading = {key: name for name, key in re.findall(r"\n    # ([^\n]+)\n    (\w+):", source)}
    groups: dict[str, list[Sequence[str]]] = {}
    for key, row in KEYS.items():
        if key in heading:
            groups[heading[key]] = []
        values = _words(adapter(row.annotation).json_schema())
        cells = (f"`{key}`", values, f"`{row.default}`", row.meaning)
        next(reversed(groups.values())).append(cells)
    head = ["key", "allowed values", "default", "meaning"]
    return "\n\n".join(f"## {n.capitalize()}\n\n{table(head, rows)}" for n, rows in groups.items())


def _words(schema: Mapping[str, Any]) -> str:
    """The values that a JSON schema allows."""
    if "anyOf" in schema:
        return ", or ".join(map(_words, schema["anyOf"]))
    if "enum" in schema:
        return f"one of {', '.join(map(str, schema['enum']))}"
    if schema["type"] == "array":
        items = schema.get("prefixItems") or [schema["items"]]
        return f"list of {f'{len(items)} times ' if items[1:] else ''}{_words(items[0])}"
    words = {"string": "text", "boolean": "true or false"}.get(schema["type"], schema["type"])
    for name, word in {"minimum": "from", "exclusiveMinimum": "above", "maximum": "to"}.items():
        if abs(schema.get(name, 1e9)) < 1e9:
            words += f" {word} {schema[name]:,g}"
    return words


def observations() -> str:
    """Components of the observation: sizes, ranges, units, meaning."""
    ranges, robots, rows = dict[str, tuple](), dict[str, set[str]](), []
    for label, env in _observed():
        space = env.observation_spec["observation"].space
        for name, columns in env.observation_layout.items():
            low, high = (float(end[0, columns.start]) for end in (space.low, space.high))
            shown = "any" if high > 1e38 else f"[{low:g}, {high:g}]"
            ranges.setdefault(name, (columns.stop - columns.start, shown))
            robots.setdefault(name, set()).update(_NAMES if label == "any" else [label])
    for pattern, (unit, meaning, told) in COMPONENTS.items():
        for shown, group in _alike([name for name in ranges if component_of(name) == pattern]):
            flags = ", ".join(f"`{key}`" for key in told.split(", ") if key)
            who = [name for name in _NAMES if any(name in robots[part] for part in group)]
            of = "all" if len(who) == len(_NAMES) else ", ".join(who)
            rows.append((f"`{shown}`", *ranges[group[0]], unit, meaning, flags, of))
    return table(["component", "size", "range", "unit", "meaning", "keys", "robots"], rows)


def component_of(name: str) -> str:
    """The pattern in `COMPONENTS` that explains a component; KeyError if there is none."""
    return next((p for p in COMPONENTS if re.fullmatch(p, name)), None) or COMPONENTS[name][0]


def _observed() -> Iterable[tuple[str, SafetyGymEnv]]:
    """Environments in which every component of the observation occurs."""
    for robot in _NAMES:
        for name in ("Goal2", "Button2", "Push2", "Circle"):
            yield robot, SafetyGymEnv(f"{robot}{name}", num_envs=1)
    shown = ("goal_comp", "box_comp", "goal_dist", "remaining", "com", "ctrl", "qpos", "qvel")
    everything = {"task": "push"} | {f"observe_{name}": True for name in shown}
    yield "any", SafetyGymEnv(everything | {"robot_base": "point"}, num_envs=1)
    yield "Car", SafetyGymEnv(everything | {"robot_base": "car", "observe_freejoint": True}, 1)
    yield "any", SafetyGymEnv({"robot_base": "point", "task": "goal", "observe_vision": True}, 1)


def _alike(names: Sequence[str]) -> list[tuple[str, list[str]]]:
    """Names that differ in numbers and ends only, under one: `touch_ankle_<…>`."""
    stems = {name: re.sub(r"(?<=_)\d.*$|^.*(?=_(lidar|compass)$)", "…", name) for name in names}
    return [(s, [n for n in names if stems[n] == s]) for s in dict.fromkeys(stems.values())]


def costs() -> str:
    """Costs, their keys and their sizes."""
    flags = {row.key: f"`constrain_{row.key.split('_')[1]}`" for row in COSTS}
    names = ("cost", *(row.key for row in COSTS), EXCEPTION_KEY)
    rows = [(f"`{key}`", COST_MEANINGS[key], flags.get(key, "always there")) for key in names]
    return table(["cost", "it is positive if", "switched on by"], rows)


TABLES = (benchmark, debug, velocity, keys, observations, costs)
