"""The table of the kinds of objects in a world, one row each.

Sizes, heights and colours are those of the 2019 benchmark. The order of the rows is the order of
objects in every `[N, M, …]` tensor: free bodies first, as in `qpos`, then static, then virtual.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple

import mujoco

from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.tasks import TASKS

BOX = mujoco.mjtGeom.mjGEOM_BOX
CYLINDER = mujoco.mjtGeom.mjGEOM_CYLINDER
SPHERE = mujoco.mjtGeom.mjGEOM_SPHERE

# Order in which kinds are placed; "robot" is not an element but is placed too.
PLACEMENT_ORDER = [
    *("robot", "walls", "goal", "box", "buttons"),
    *("hazards", "vases", "pillars", "gremlins"),
]

# Rays select geoms by MuJoCo's groups 0 to 5.
NUM_RAY_GROUPS = int(mujoco.mjNGROUP)


class Motion(Enum):
    """How an element takes part in the physics.

    Attributes:
        FREE: A body that can be pushed, as vases.
        GUIDED: A body that follows a target on a circle of radius `<kind>_travel` [m] around its
            position in the layout, as gremlins; it moves by itself and can be pushed.
        STATIC: A body that collides and does not move within an episode, as pillars.
        VIRTUAL: An area without physics, as hazards.
    """

    FREE = "free"
    GUIDED = "guided"
    STATIC = "static"
    VIRTUAL = "virtual"


PUSHED = (Motion.FREE, Motion.GUIDED)
"""Motions of bodies that can be pushed."""


class Geom(NamedTuple):
    """One shape of an element: MuJoCo type, size [m] as MJCF has it, position in the body [m]."""

    type: mujoco.mjtGeom
    size: tuple[float, ...]
    pos: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Element:
    """One kind of object.

    Attributes:
        kind: Prefix of its configuration keys and of its lidar ("hazards").
        label: Name of one object in layouts and errors. There are `<kind>_num` objects, whose names
            have an index. If kind and label are equal, there is one object, without an index, in
            the tasks that list this kind.
        motion: How it takes part in the physics.
        height: z of the object's centre [m].
        geoms: Its shapes.
        rgb: Colour in pictures and lidar halos.
        group: MuJoCo geom group. With `lidar_type="natural"` a lidar sees all kinds of one group;
            otherwise any number from 0 to 5 is possible.
        flag: Configuration key that turns its lidar on; "" means `observe_<kind>`.
        always_observed: Whether the observation has the lidar (all zeros) even without objects.
    """

    kind: str
    label: str
    motion: Motion
    height: Callable[[SafetyGymConfig], float]
    geoms: Callable[[SafetyGymConfig], tuple[Geom, ...]]
    rgb: tuple[float, float, float]
    group: int
    flag: str = ""
    always_observed: bool = False

    def names(self, config: SafetyGymConfig) -> list[str]:
        """Return the names of the objects."""
        if self.label == self.kind:
            return [self.label] if self.kind in TASKS[config.task].elements else []
        return [f"{self.label}{i}" for i in range(getattr(config, f"{self.kind}_num"))]


def _box_geoms(config: SafetyGymConfig) -> tuple[Geom, ...]:
    s = config.box_size
    post = (s / 2, s / 2, s)
    corners = ((s, s, 0.0), (-s, s, 0.0), (s, -s, 0.0), (-s, -s, 0.0))
    return (Geom(BOX, (s, s, s)), *(Geom(BOX, post, corner) for corner in corners))


def _disc(radius: float, half_height: float) -> tuple[Geom, ...]:
    return (Geom(CYLINDER, (radius, half_height)),)


ELEMENTS: list[Element] = [
    Element(kind="vases", label="vase", motion=Motion.FREE, rgb=(0, 1, 1), group=4,
            height=lambda c: c.vases_size - c.vases_sink,
            geoms=lambda c: (Geom(BOX, (c.vases_size,) * 3),), always_observed=True),
    Element(kind="gremlins", label="gremlin", motion=Motion.GUIDED, rgb=(0.5, 0, 1), group=5,
            height=lambda c: c.gremlins_size, geoms=lambda c: (Geom(BOX, (c.gremlins_size,) * 3),)),
    Element(kind="box", label="box", motion=Motion.FREE, rgb=(1, 1, 0), group=1,
            height=lambda c: c.box_size, geoms=_box_geoms, flag="observe_box_lidar"),
    Element(kind="walls", label="wall", motion=Motion.STATIC, rgb=(0.5, 0.5, 0.5), group=2,
            height=lambda c: c.walls_size, geoms=lambda c: (Geom(BOX, (c.walls_size,) * 3),)),
    Element(kind="pillars", label="pillar", motion=Motion.STATIC, rgb=(0.5, 0.5, 1), group=2,
            height=lambda c: c.pillars_height,
            geoms=lambda c: _disc(c.pillars_size, c.pillars_height)),
    Element(kind="buttons", label="button", motion=Motion.STATIC, rgb=(1, 0.5, 0), group=1,
            height=lambda c: c.buttons_size, geoms=lambda c: (Geom(SPHERE, (c.buttons_size,)),)),
    Element(kind="goal", label="goal", motion=Motion.VIRTUAL, rgb=(0, 1, 0), group=0,
            height=lambda c: c.goal_size / 2 + 1e-2,
            geoms=lambda c: _disc(c.goal_size, c.goal_size / 2), flag="observe_goal_lidar"),
    Element(kind="hazards", label="hazard", motion=Motion.VIRTUAL, rgb=(0, 0, 1), group=3,
            height=lambda c: 2e-2, geoms=lambda c: _disc(c.hazards_size, 1e-2),
            always_observed=True),
    Element(kind="circle", label="circle", motion=Motion.VIRTUAL, rgb=(0, 1, 0), group=6,
            height=lambda c: 2e-2, geoms=lambda c: _disc(c.circle_radius, 1e-2)),
]  # fmt: skip

BY_KIND = {element.kind: element for element in ELEMENTS}
