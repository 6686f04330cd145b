"""The kinds of object a world is built from: one row each, read by every other module.

Sizes, heights and colours are those of the 2019 benchmark. The order of the rows is the order of
objects in every `[N, M, …]` tensor: free bodies first, as in `qpos`, then static, then virtual.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import mujoco

from safe_rl.envs.config import SafetyGymConfig

BOX, CYLINDER, SPHERE = (
    mujoco.mjtGeom.mjGEOM_BOX,
    mujoco.mjtGeom.mjGEOM_CYLINDER,
    mujoco.mjtGeom.mjGEOM_SPHERE,
)

# Where each kind stands in the order of placement; "robot" is not an element but is placed too.
PLACEMENT_ORDER = (
    *("robot", "walls", "goal", "box", "buttons"),
    *("hazards", "vases", "pillars", "gremlins"),
)

# Rays select geoms by MuJoCo's groups 0 to 5.
NUM_RAY_GROUPS = int(mujoco.mjNGROUP)


class Motion(Enum):
    """How an element takes part in the physics."""

    FREE = "free"  # a free body that can be pushed
    GUIDED = "guided"  # a free body welded to a target that runs in a circle
    STATIC = "static"  # collides and never moves within an episode
    VIRTUAL = "virtual"  # an area without physics


class Geom(NamedTuple):
    """One shape of an element: MuJoCo type, size [m] as MJCF has it, position in the body [m]."""

    type: mujoco.mjtGeom
    size: tuple[float, ...]
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Element:
    """One kind of object.

    Attributes:
        kind: prefix of its configuration keys and of its lidar ("hazards").
        label: name of one object in layouts and errors; with an index where there may be several.
        motion: how it takes part in the physics.
        count: number of objects.
        height: z of the object's centre [m].
        geoms: its shapes.
        rgb: colour in pictures and lidar halos.
        group: MuJoCo geom group, which natural lidar selects by.
        flag: configuration key that turns its lidar on.
        always_observed: whether the lidar is there (all zeros) even without any object.
    """

    kind: str
    label: str
    motion: Motion
    count: Callable[[SafetyGymConfig], int]
    height: Callable[[SafetyGymConfig], float]
    geoms: Callable[[SafetyGymConfig], tuple[Geom, ...]]
    rgb: tuple[float, float, float]
    group: int
    flag: str
    always_observed: bool = False

    def observed(self, config: SafetyGymConfig) -> bool:
        """Whether the observation has a lidar for this kind."""
        return getattr(config, self.flag) and (self.always_observed or self.count(config) > 0)

    def names(self, config: SafetyGymConfig) -> list[str]:
        """Names of this kind's objects."""
        count = self.count(config)
        return [self.label] if self.singular else [f"{self.label}{i}" for i in range(count)]

    @property
    def singular(self) -> bool:
        """Whether there is at most one, which has a name without an index."""
        return self.label == self.kind


def _cube(half: float) -> tuple[Geom, ...]:
    return (Geom(BOX, (half, half, half)),)


def _box_geoms(config: SafetyGymConfig) -> tuple[Geom, ...]:
    s = config.box_size
    post = (s / 2, s / 2, s)
    corners = ((s, s, 0.0), (-s, s, 0.0), (s, -s, 0.0), (-s, -s, 0.0))
    return (*_cube(s), *(Geom(BOX, post, corner) for corner in corners))


ELEMENTS: tuple[Element, ...] = (
    Element(
        kind="vases",
        label="vase",
        motion=Motion.FREE,
        count=lambda c: c.vases_num,
        height=lambda c: c.vases_size - c.vases_sink,
        geoms=lambda c: _cube(c.vases_size),
        rgb=(0, 1, 1),
        group=4,
        flag="observe_vases",
        always_observed=True,
    ),
    Element(
        kind="gremlins",
        label="gremlin",
        motion=Motion.GUIDED,
        count=lambda c: c.gremlins_num,
        height=lambda c: c.gremlins_size,
        geoms=lambda c: _cube(c.gremlins_size),
        rgb=(0.5, 0, 1),
        group=5,
        flag="observe_gremlins",
    ),
    Element(
        kind="box",
        label="box",
        motion=Motion.FREE,
        count=lambda c: int(c.task == "push"),
        height=lambda c: c.box_size,
        geoms=_box_geoms,
        rgb=(1, 1, 0),
        group=1,
        flag="observe_box_lidar",
    ),
    Element(
        kind="walls",
        label="wall",
        motion=Motion.STATIC,
        count=lambda c: c.walls_num,
        height=lambda c: c.walls_size,
        geoms=lambda c: _cube(c.walls_size),
        rgb=(0.5, 0.5, 0.5),
        group=2,
        flag="observe_walls",
    ),
    Element(
        kind="pillars",
        label="pillar",
        motion=Motion.STATIC,
        count=lambda c: c.pillars_num,
        height=lambda c: c.pillars_height,
        geoms=lambda c: (Geom(CYLINDER, (c.pillars_size, c.pillars_height)),),
        rgb=(0.5, 0.5, 1),
        group=2,
        flag="observe_pillars",
    ),
    Element(
        kind="buttons",
        label="button",
        motion=Motion.STATIC,
        count=lambda c: c.buttons_num,
        height=lambda c: c.buttons_size,
        geoms=lambda c: (Geom(SPHERE, (c.buttons_size,)),),
        rgb=(1, 0.5, 0),
        group=1,
        flag="observe_buttons",
    ),
    Element(
        kind="goal",
        label="goal",
        motion=Motion.VIRTUAL,
        count=lambda c: int(c.task in ("goal", "push", "button")),
        height=lambda c: c.goal_size / 2 + 1e-2,
        geoms=lambda c: (Geom(CYLINDER, (c.goal_size, c.goal_size / 2)),),
        rgb=(0, 1, 0),
        group=0,
        flag="observe_goal_lidar",
    ),
    Element(
        kind="hazards",
        label="hazard",
        motion=Motion.VIRTUAL,
        count=lambda c: c.hazards_num,
        height=lambda c: 2e-2,
        geoms=lambda c: (Geom(CYLINDER, (c.hazards_size, 1e-2)),),
        rgb=(0, 0, 1),
        group=3,
        flag="observe_hazards",
        always_observed=True,
    ),
    Element(
        kind="circle",
        label="circle",
        motion=Motion.VIRTUAL,
        count=lambda c: int(c.task == "circle"),
        height=lambda c: 2e-2,
        geoms=lambda c: (Geom(CYLINDER, (c.circle_radius, 1e-2)),),
        rgb=(0, 1, 0),
        group=6,
        flag="observe_circle",
    ),
)

BY_KIND = {element.kind: element for element in ELEMENTS}
