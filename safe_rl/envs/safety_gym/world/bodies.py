"""Elements as MuJoCo bodies: what each of them adds to the specification of a world."""

from __future__ import annotations

import mujoco

from safe_rl.envs.safety_gym.records.config import SafetyGymConfig
from safe_rl.envs.safety_gym.rules.elements import NUM_RAY_GROUPS, Element, Motion
from safe_rl.envs.safety_gym.rules.tasks import goal_is_button

FLOOR_HALF_SIZE = 3.5  # visible part [m]; the plane itself is infinite


def add_floor(spec: mujoco.MjSpec) -> None:
    """Add the ground plane."""
    floor = spec.worldbody.add_geom(spec.default, type=mujoco.mjtGeom.mjGEOM_PLANE, name="floor")
    floor.size = [FLOOR_HALF_SIZE, FLOOR_HALF_SIZE, 0.1]


def add_bodies(
    spec: mujoco.MjSpec, config: SafetyGymConfig, element: Element, decorated: bool = False
) -> None:
    """Add a body per object: free where it can be pushed, else one that is placed at resets.

    Areas have a shape where rays see them, or in a `decorated` world, which is for pictures.
    """
    free = element.motion in (Motion.FREE, Motion.GUIDED)
    for name in element.names(config):
        body = spec.worldbody.add_body(
            name=name, pos=[0, 0, element.height(config)], mocap=not free
        )
        if free:
            body.add_freejoint(name=name)
        if element.motion is not Motion.VIRTUAL or _shows_area(config, element, decorated):
            _add_geoms(spec, body, config, element)


def add_targets(
    spec: mujoco.MjSpec, config: SafetyGymConfig, element: Element, decorated: bool
) -> None:
    """Add a mocap target per object and weld the object to it, without any offset."""
    for name in element.names(config):
        target = spec.worldbody.add_body(
            name=f"{name}_target", pos=[0, 0, element.height(config)], mocap=True
        )
        if config.lidar_type == "natural" and not decorated:
            # The benchmark's targets have a shape that nothing but rays meets.
            _add_geoms(spec, target, config, element, ghost=True)
        weld = spec.add_equality(
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=target.name,
            name2=name,
            solref=[0.02, 1.5],
        )
        # The data a new equality comes with are not a weld's: no anchor, relative pose from the
        # initial one, torque scale 1.
        weld.data[:10], weld.data[10:] = 0, 1


def _shows_area(config: SafetyGymConfig, element: Element, decorated: bool) -> bool:
    """Whether an area has a shape, for pictures or rays; a button's goal is the button."""
    stands_in = element.kind == "goal" and goal_is_button(config.task)
    return (decorated or element.group < NUM_RAY_GROUPS) and not stands_in


def _add_geoms(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    config: SafetyGymConfig,
    element: Element,
    ghost: bool = False,
) -> None:
    """Add an element's shapes; they inherit the robot file's defaults (condim, density)."""
    ghost = ghost or element.motion is Motion.VIRTUAL
    for shape in element.geoms(config):
        geom = body.add_geom(spec.default, type=shape.type, pos=shape.pos, group=element.group)
        geom.size[: len(shape.size)] = shape.size
        geom.rgba = [*element.rgb, 0.25 if ghost else 1.0]
        geom.contype = geom.conaffinity = 0 if ghost else 1
        if element.motion in (Motion.FREE, Motion.GUIDED):
            geom.density = getattr(config, f"{element.kind}_density")
