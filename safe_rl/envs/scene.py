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

from safe_rl.envs.bodies import add_bodies, add_floor, add_targets
from safe_rl.envs.config import ConfigError, SafetyGymConfig
from safe_rl.envs.elements import ELEMENTS, Element, Motion
from safe_rl.envs.rendering.scenery import decorate

ROBOT_FOLDER = Path(__file__).parent / "robots"
# The robot files' stack and contact sizes would reserve hundreds of MB for every environment.
ARENA_BYTES = 8 << 20
# MuJoCo's default (1e-3) lets slowly sliding vases sleep, which lowers the vase-velocity cost.
SLEEP_TOLERANCE = 1e-5
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
def build_scene(config: SafetyGymConfig, sleep: bool = False, decorated: bool = False) -> Scene:
    """Compile the world of a configuration.

    Args:
        config: the environment.
        sleep: let resting free bodies sleep until something touches them.
        decorated: build the world for pictures: areas are bodies too, and there are cameras, light
            and a floor pattern. Its `qpos` and first mocap bodies are those of the plain world.

    Raises:
        ConfigError: if a custom robot file lacks what an environment needs.
    """
    spec, robot_bodies = _load_robot(config)
    _set_options(spec, sleep)
    add_floor(spec)
    present = [element for element in ELEMENTS if element.count(config) > 0]
    for element in present:
        if element.motion in (Motion.FREE, Motion.GUIDED):
            add_bodies(spec, config, element, decorated)
    for element in present:
        if element.motion is Motion.GUIDED:
            add_targets(spec, config, element, decorated)
    if decorated:
        decorate(spec, config)
    # Rays and pictures see geoms only, so natural lidar needs bodies for the areas as well.
    needs_areas = decorated or config.lidar_type == "natural"
    in_physics = {Motion.STATIC} | ({Motion.VIRTUAL} if needs_areas else set())
    for element in present:
        if element.motion in in_physics:
            add_bodies(spec, config, element, decorated)
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
