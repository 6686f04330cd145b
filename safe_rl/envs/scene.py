"""From a configuration to one compiled model, and the integer maps into its arrays.

The model is compiled once per configuration. Everything that differs between episodes is state:
free bodies stand in `qpos`, static ones are mocap bodies. Body order: robot, vases, gremlins, box,
the gremlins' targets, static bodies.
"""

from __future__ import annotations

import functools
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import mujoco

from safe_rl.envs.config import ConfigError, SafetyGymConfig
from safe_rl.envs.elements import ELEMENTS, Element, Motion

ROBOT_FOLDER = Path(__file__).parent / "robots"
# The robot files' stack and contact sizes would reserve hundreds of MB for every environment.
ARENA_BYTES = 8 << 20
# MuJoCo's default (1e-3) lets slowly sliding vases sleep, which lowers the vase-velocity cost.
SLEEP_TOLERANCE = 1e-5
FLOOR_HALF_SIZE = 3.5  # visible part [m]; the plane itself is infinite
# Kinds whose contacts with the robot are counted, in the order of their sensors.
CONTACT_KINDS = ("vases", "gremlins", "pillars", "buttons")


@dataclass(frozen=True)
class Scene:
    """A compiled world and where things are in it.

    Attributes:
        config: the configuration it was built from.
        model: the compiled model.
        names: name of every object, by slot; slots are the M of `[N, M, …]` tensors.
        slots: slots of each kind that has objects.
        heights: z of every object's centre [m], by slot.
        num_free: slots below this are free bodies, 7 `qpos` and 6 `qvel` each after the robot's.
        num_mocap_slots: that many slots from `num_free` on are mocap bodies (after the targets').
        num_targets: mocap bodies that the gremlins are welded to; the first ones.
        robot_body: body id of the robot's root.
        robot_nq, robot_nv: the robot's share of `qpos` and `qvel`, which comes first.
        planar: whether the root is (x, y, yaw) instead of a free joint.
        free_bodies: body ids of the free slots.
        contacts: `sensordata` columns of each kind's contact counts with the robot.
    """

    config: SafetyGymConfig
    model: mujoco.MjModel
    names: tuple[str, ...]
    slots: Mapping[str, slice]
    heights: tuple[float, ...]
    num_free: int
    num_mocap_slots: int
    num_targets: int
    robot_body: int
    robot_nq: int
    robot_nv: int
    planar: bool
    free_bodies: slice
    contacts: Mapping[str, slice]


@functools.lru_cache(maxsize=64)
def build_scene(config: SafetyGymConfig, sleep: bool = False) -> Scene:
    """Compile the world of a configuration.

    Args:
        config: the environment.
        sleep: let resting free bodies sleep until something touches them.

    Raises:
        ConfigError: if a custom robot file lacks what an environment needs.
    """
    spec, robot_bodies = _load_robot(config)
    _set_options(spec, sleep)
    floor = _add_geom(spec, spec.worldbody, mujoco.mjtGeom.mjGEOM_PLANE, name="floor")
    floor.size = [FLOOR_HALF_SIZE, FLOOR_HALF_SIZE, 0.1]
    present = [element for element in ELEMENTS if element.count(config) > 0]
    for element in present:
        if element.motion in (Motion.FREE, Motion.GUIDED):
            _add_bodies(spec, config, element)
    for element in present:
        if element.motion is Motion.GUIDED:
            _add_targets(spec, config, element)
    # Rays see geoms only, so natural lidar needs bodies for the areas as well.
    in_physics = {Motion.STATIC} | ({Motion.VIRTUAL} if config.lidar_type == "natural" else set())
    for element in present:
        if element.motion in in_physics:
            _add_bodies(spec, config, element)
    contact_names = _add_contact_sensors(spec, config, present)
    if config.task == "circle":
        spec.add_sensor(
            name="robot_velocity",
            type=mujoco.mjtSensor.mjSENS_FRAMELINVEL,
            objtype=mujoco.mjtObj.mjOBJ_XBODY,
            objname="robot",
        )
    model = spec.compile()
    return _index(config, model, present, robot_bodies, in_physics, contact_names)


def _load_robot(config: SafetyGymConfig) -> tuple[mujoco.MjSpec, int]:
    base = config.robot_base
    path = Path(base) if base.endswith(".xml") else ROBOT_FOLDER / f"{base}.xml"
    try:
        spec = mujoco.MjSpec.from_file(str(path))
        robot_bodies = spec.copy().compile().nbody - 1
    except ValueError as error:
        raise ConfigError(f"'robot_base': MuJoCo cannot load {path}: {error}") from error
    if spec.body("robot") is None:
        raise ConfigError(f"'robot_base': {path} has no body named 'robot'.")
    if not spec.actuators:
        raise ConfigError(f"'robot_base': {path} has no actuators.")
    return spec, robot_bodies


def _set_options(spec: mujoco.MjSpec, sleep: bool) -> None:
    spec.memory = ARENA_BYTES
    # MuJoCo 4.0.0 gives wrong normals for cylinders with it; MuJoCo 2 had no such thing.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    if sleep:
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        spec.option.sleep_tolerance = SLEEP_TOLERANCE


def _add_geom(
    spec: mujoco.MjSpec, body: mujoco.MjsBody, geom_type: mujoco.mjtGeom, **attributes: object
) -> mujoco.MjsGeom:
    """Add a geom that inherits the robot file's defaults (condim, density)."""
    return body.add_geom(spec.default, type=geom_type, **attributes)


def _add_bodies(spec: mujoco.MjSpec, config: SafetyGymConfig, element: Element) -> None:
    free = element.motion in (Motion.FREE, Motion.GUIDED)
    collides = int(element.motion is not Motion.VIRTUAL)
    rgba = [*element.rgb, 1.0 if collides else 0.25]
    for name in element.names(config):
        body = spec.worldbody.add_body(
            name=name, pos=[0, 0, element.height(config)], mocap=not free
        )
        if free:
            body.add_freejoint(name=name)
        for shape in element.geoms(config):
            geom = _add_geom(spec, body, shape.type, pos=shape.pos, rgba=rgba)
            geom.size[: len(shape.size)] = shape.size
            geom.group = element.group
            geom.contype = geom.conaffinity = collides
            if free:
                geom.density = getattr(config, f"{element.kind}_density")


def _add_targets(spec: mujoco.MjSpec, config: SafetyGymConfig, element: Element) -> None:
    """Add a mocap target per object and weld the object to it, without any offset."""
    for name in element.names(config):
        target = spec.worldbody.add_body(
            name=f"{name}_target", pos=[0, 0, element.height(config)], mocap=True
        )
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


def _contact_kinds(config: SafetyGymConfig) -> set[str]:
    kinds = {kind for kind in CONTACT_KINDS if getattr(config, f"constrain_{kind}")}
    return kinds | ({"buttons"} if config.task == "button" else set())


def _add_contact_sensors(
    spec: mujoco.MjSpec, config: SafetyGymConfig, present: list[Element]
) -> dict[str, list[str]]:
    """Add a sensor per object that counts its contact points with the robot."""
    sensors: dict[str, list[str]] = {}
    for element in present:
        if element.kind not in _contact_kinds(config):
            continue
        for name in element.names(config):
            spec.add_sensor(
                name=f"contact_{name}",
                type=mujoco.mjtSensor.mjSENS_CONTACT,
                objtype=mujoco.mjtObj.mjOBJ_XBODY,  # the robot with its limbs
                objname="robot",
                reftype=mujoco.mjtObj.mjOBJ_BODY,
                refname=name,
                intprm=[1 << int(mujoco.mjtConDataField.mjCONDATA_FOUND), 0, 1],
            )
            sensors.setdefault(element.kind, []).append(f"contact_{name}")
    return sensors


def _index(
    config: SafetyGymConfig,
    model: mujoco.MjModel,
    present: list[Element],
    robot_bodies: int,
    in_physics: set[Motion],
    contact_names: dict[str, list[str]],
) -> Scene:
    """Resolve every name to integers."""
    names: list[str] = []
    slots, heights = {}, []
    for element in present:
        slots[element.kind] = slice(len(names), len(names) + element.count(config))
        names += element.names(config)
        heights += [element.height(config)] * element.count(config)

    def count(*motions: Motion) -> int:
        return sum(element.count(config) for element in present if element.motion in motions)

    num_free = count(Motion.FREE, Motion.GUIDED)
    robot_body = model.body("robot").id
    return Scene(
        config=config,
        model=model,
        names=tuple(names),
        slots=slots,
        heights=tuple(heights),
        num_free=num_free,
        num_mocap_slots=count(*in_physics),
        num_targets=count(Motion.GUIDED),
        robot_body=robot_body,
        robot_nq=model.nq - 7 * num_free,
        robot_nv=model.nv - 6 * num_free,
        planar=_is_planar(config, model, robot_body),
        free_bodies=slice(1 + robot_bodies, 1 + robot_bodies + num_free),
        contacts={
            kind: slice(first := int(model.sensor(sensors[0]).adr[0]), first + len(sensors))
            for kind, sensors in contact_names.items()
        },
    )


def _is_planar(config: SafetyGymConfig, model: mujoco.MjModel, robot_body: int) -> bool:
    """Whether the robot's root is (slide x, slide y, hinge z); else it must be a free joint."""
    joint = mujoco.mjtJoint
    first, number = model.body_jntadr[robot_body], model.body_jntnum[robot_body]
    types = list(model.jnt_type[first : first + number])
    if types[:1] == [joint.mjJNT_FREE]:
        return False
    axes = model.jnt_axis[first : first + 3].tolist()
    if types[:3] == [joint.mjJNT_SLIDE, joint.mjJNT_SLIDE, joint.mjJNT_HINGE] and axes == [
        [1, 0, 0],
        [0, 1, 0],
        [0, 0, 1],
    ]:
        return True
    raise ConfigError(
        f"'robot_base' {config.robot_base!r}: the body 'robot' needs a free joint, or slides "
        "along x and y and a hinge about z in this order, so that it can be placed."
    )
