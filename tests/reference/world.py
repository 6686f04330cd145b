"""The world of section 3 as an MJCF string: one model per layout, nothing moved after compiling."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from .robots import COMMON_SENSORS, ROBOTS, Robot

# The geom group of each kind: what a natural lidar of that kind sees.
GROUPS = {
    "goal": 0,
    "box": 1,
    "buttons": 1,
    "walls": 2,
    "pillars": 2,
    "hazards": 3,
    "vases": 4,
    "gremlins": 5,
    "circle": 6,
}

_GHOST = 'contype="0" conaffinity="0"'


def text(*numbers: float) -> str:
    """Numbers as an MJCF attribute, all digits kept."""
    return " ".join(repr(float(n)) for n in numbers)


def yaw_quat(yaw: float) -> np.ndarray:
    """The unit quaternion [4] (w, x, y, z) of a turn by `yaw` [rad] about the vertical."""
    return np.array([np.cos(yaw / 2), 0.0, 0.0, np.sin(yaw / 2)])


def goal_height(config: dict[str, Any]) -> float:
    """Height of the goal body's centre [m]."""
    return config["goal_size"] / 2 + 0.01


@dataclass(frozen=True)
class Reset:
    """What a reset fixes for an episode.

    Attributes:
        layout: positions [K, 2] of every kind that the configuration has [m].
        robot: x, y [m] and yaw [rad] of the robot.
        gremlin_yaws: [K] [rad]; part of the gremlins' welds.
        pillar_yaws: [K] [rad]; a cylinder looks the same from all sides, but its collisions are
            found numerically, to a tolerance, and so differ in the seventh digit.
    """

    layout: dict[str, np.ndarray]
    robot: tuple[float, float, float]
    gremlin_yaws: tuple[float, ...]
    pillar_yaws: tuple[float, ...]

    def key(self) -> str:
        """Equal for two resets that compile to the same world; the goal is set apart from it."""
        layout = {kind: xy.tolist() for kind, xy in self.layout.items() if kind != "goal"}
        return repr((layout, self.robot, self.gremlin_yaws, self.pillar_yaws))


def compile_world(config: dict[str, Any], reset: Reset) -> mujoco.MjModel:
    """Compiles the world of a completed configuration with its elements where `reset` has them.

    The joints in `qpos` are those of robot, vases, gremlins, box, in this order.
    """
    return mujoco.MjModel.from_xml_string(world_xml(config, reset))


def world_xml(config: dict[str, Any], reset: Reset) -> str:
    """The MJCF behind `compile_world`."""
    robot = ROBOTS[config["robot_base"]]
    gremlins = _gremlins(config, reset)
    bodies = [
        _robot(robot, reset),
        *_vases(config, reset.layout),
        *(gremlin for gremlin, _, _ in gremlins),
        *_box(config),
        *_statics(config, reset),
        *(mocap for _, mocap, _ in gremlins),
    ]
    return f"""
<mujoco model="safety_gym_reference">
  <compiler angle="{robot.angle}"/>
  <option timestep="{robot.timestep}"><flag multiccd="disable"/></option>
  <default>{robot.default}</default>
  <worldbody>
    <geom name="floor" type="plane" size="3.5 3.5 0.1" condim="6"/>
    {"".join(bodies)}
  </worldbody>
  <equality>{"".join(weld for _, _, weld in gremlins)}</equality>
  <sensor>{COMMON_SENSORS}{robot.sensor}</sensor>
  <actuator>{robot.actuator}</actuator>
</mujoco>
"""


def _robot(robot: Robot, reset: Reset) -> str:
    """The robot's body, at its reset pose unless its joints count from the world's origin.

    A free joint's `qpos` holds the pose itself, so that the pose written here moves nothing; it
    keeps the constants that the compiler derives from it equal to the last digit.
    """
    x, y, yaw = reset.robot if 'type="free"' in robot.body else (0.0, 0.0, 0.0)
    pose = f'pos="{text(x, y, robot.height)}" quat="{text(*yaw_quat(yaw))}"'
    return f'<body name="robot" {pose}>{robot.body}</body>'


def _free_box(
    name: str, group: int, size: float, density: float, pose: str, more_geoms: str = ""
) -> str:
    return f"""
<body name="{name}" {pose}>
  <freejoint/>
  <geom type="box" size="{text(size, size, size)}" density="{density!r}" group="{group}"/>
  {more_geoms}
</body>
"""


def _vases(config: dict[str, Any], layout: dict[str, np.ndarray]) -> list[str]:
    size, density = config["vases_size"], config["vases_density"]
    height = size - config["vases_sink"]
    return [
        _free_box(f"vase{i}", GROUPS["vases"], size, density, f'pos="{text(x, y, height)}"')
        for i, (x, y) in enumerate(layout.get("vases", [])[: config["vases_num"]])
    ]


def _box(config: dict[str, Any]) -> list[str]:
    """The box of the push tasks with its four corner posts."""
    if config["task"] != "push":
        return []
    s, density, group = config["box_size"], config["box_density"], GROUPS["box"]
    posts = "".join(
        f'<geom type="box" size="{text(s / 2, s / 2, s)}" pos="{text(x * s, y * s, 0)}"'
        f' density="{density!r}" group="{group}"/>'
        for x, y in ((1, 1), (-1, 1), (1, -1), (-1, -1))
    )
    return [_free_box("box", group, s, density, f'pos="{text(0, 0, s)}"', posts)]


def _gremlins(config: dict[str, Any], reset: Reset) -> list[tuple[str, str, str]]:
    """Body, mocap body and weld of every gremlin.

    The compiler takes the weld's relative pose from the bodies as they are written here, with the
    mocap body in the origin: the gremlin's starting pose itself.
    """
    size, density, group = config["gremlins_size"], config["gremlins_density"], GROUPS["gremlins"]
    parts = []
    for i, (x, y) in enumerate(reset.layout.get("gremlins", [])[: config["gremlins_num"]]):
        pose = f'pos="{text(x, y, size)}" quat="{text(*yaw_quat(reset.gremlin_yaws[i]))}"'
        body = _free_box(f"gremlin{i}", group, size, density, pose)
        mocap = f"""
<body name="gremlin{i}_mocap" mocap="true">
  <geom type="box" size="{text(size, size, size)}" {pose} {_GHOST} group="{group}"/>
</body>
"""
        weld = f'<weld body1="gremlin{i}_mocap" body2="gremlin{i}" solref="0.02 1.5"/>'
        parts.append((body, mocap, weld))
    return parts


def _statics(config: dict[str, Any], reset: Reset) -> list[str]:
    """Everything that does not move by itself; the goal is a mocap body, for it is set anew."""
    r, h = config["pillars_size"], config["pillars_height"]
    shapes = {
        "walls": ("wall", "box", (config["walls_size"],) * 3, config["walls_size"], ""),
        "buttons": ("button", "sphere", (config["buttons_size"],), config["buttons_size"], ""),
        "pillars": ("pillar", "cylinder", (r, h), h, ""),
        "hazards": ("hazard", "cylinder", (config["hazards_size"], 0.01), 0.02, _GHOST),
    }
    bodies = []
    for kind, (name, shape, size, height, ghost) in shapes.items():
        for i, (x, y) in enumerate(reset.layout.get(kind, [])[: config[f"{kind}_num"]]):
            yaw = reset.pillar_yaws[i] if kind == "pillars" else 0.0
            pose = f'pos="{text(x, y, height)}" quat="{text(*yaw_quat(yaw))}"'
            bodies.append(
                f'<body name="{name}{i}" {pose}><geom type="{shape}" size="{text(*size)}"'
                f' group="{GROUPS[kind]}" {ghost}/></body>'
            )
    if config["task"] in ("goal", "push"):
        size = text(config["goal_size"], config["goal_size"] / 2)
        bodies.append(
            f'<body name="goal" mocap="true" pos="{text(0, 0, goal_height(config))}">'
            f'<geom type="cylinder" size="{size}" group="{GROUPS["goal"]}" {_GHOST}/></body>'
        )
    return bodies
