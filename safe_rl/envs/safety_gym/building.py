"""Compile the model of a configuration, and find the indices of objects in its arrays.

The model is compiled once per configuration. Everything that differs between episodes is state:
free bodies are in `qpos`, and static bodies are mocap bodies. The order of bodies is robot, vases,
gremlins, box, the gremlins' targets, static bodies.
"""

from __future__ import annotations

import functools

import mujoco

from safe_rl.envs.contract import add_columns
from safe_rl.envs.errors import ConfigError
from safe_rl.envs.physics.dynamics import SCALES, scale_dynamics
from safe_rl.envs.safety_gym.bodies import add_bodies, add_floor, add_targets, decorate
from safe_rl.envs.safety_gym.config import SafetyGymConfig, robot_path
from safe_rl.envs.safety_gym.costs import active_costs
from safe_rl.envs.safety_gym.elements import ELEMENTS, Element, Motion
from safe_rl.envs.safety_gym.readings import active_readings
from safe_rl.envs.safety_gym.robots import Robot, fingerprint, load_robot
from safe_rl.envs.safety_gym.tasks import TASKS
from safe_rl.envs.safety_gym.world import Scene
from safe_rl.naming import did_you_mean

# The robot files' stack and contact sizes would reserve hundreds of MB for every environment.
ARENA_BYTES = 8 << 20
# MuJoCo's default (1e-3) lets slowly sliding vases sleep, which lowers the vase-velocity cost.
SLEEP_TOLERANCE = 1e-5


def build_scene(config: SafetyGymConfig, sleep: bool = False, decorated: bool = False) -> Scene:
    """Compile the world of a configuration; with `sleep`, resting free bodies sleep until touched.

    A `decorated` world is for pictures: areas are bodies too, and there are cameras, light and a
    floor pattern. It has the same `qpos` and first mocap bodies as the plain world.
    """
    # If the robot's file has changed, the world is compiled again.
    content = fingerprint(robot_path(config.robot_base))
    return _compile(config, content, sleep, decorated)


@functools.lru_cache(maxsize=64)
def _compile(config: SafetyGymConfig, content: str, sleep: bool, decorated: bool) -> Scene:
    """Build a scene for the present content of its robot's files."""
    robot = load_robot(config.robot_base)
    spec = robot.spec
    spec.memory = ARENA_BYTES
    # With this option, MuJoCo 4.0.0 computes wrong normals for cylinders; MuJoCo 2 lacks it.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    if sleep:
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        spec.option.sleep_tolerance = SLEEP_TOLERANCE
    present = [element for element in ELEMENTS if element.count(config) > 0]
    guided = [element for element in present if element.motion is Motion.GUIDED]
    # Rays and pictures see geoms only, so natural lidar needs bodies for the areas as well.
    needs_areas = decorated or config.lidar_type == "natural"
    mocaps = (Motion.STATIC, Motion.VIRTUAL) if needs_areas else (Motion.STATIC,)
    placed = [element for element in present if element.motion in mocaps]
    try:
        add_floor(spec)
        for element in present:
            if element.is_free:
                add_bodies(spec, config, element, decorated)
        for element in guided:
            add_targets(spec, config, element, decorated)
        if decorated:
            decorate(spec, config)
        for element in placed:
            add_bodies(spec, config, element, decorated)
        contact_names = _add_sensors(spec, config, present)
        model = spec.compile()
    except ConfigError:
        raise
    except ValueError as error:
        raise ConfigError(
            f"MuJoCo cannot build the world of 'robot_base' {config.robot_base}: {error}. If a "
            "name is repeated, rename the robot's part: it has the name of an object in the world. "
            "If a size is wrong, correct the Geoms of your elements."
        ) from error
    scales = {name: getattr(config, name) for name in SCALES}
    if any(factor != 1.0 for factor in scales.values()):
        scale_dynamics(model, scales, slice(1, 1 + robot.num_bodies))
    return _index(config, model, robot, present, guided, placed, contact_names)


# To be called after an element, task, cost, observation or robot is registered.
forget_scenes = _compile.cache_clear


def _add_sensors(
    spec: mujoco.MjSpec, config: SafetyGymConfig, present: list[Element]
) -> dict[str, list[str]]:
    """Add the robot's velocity, and a sensor per object that counts its contacts with the robot.

    Contacts are counted for the kinds whose contacts a task, a cost or an observation reads.
    """
    spec.add_sensor(
        name="robot_vel",
        type=mujoco.mjtSensor.mjSENS_FRAMELINVEL,
        objtype=mujoco.mjtObj.mjOBJ_XBODY,
        objname="robot",
    )
    touched = set(TASKS[config.task].touches).union(
        *(row.touches for row in active_costs(config)),
        *(row.touches for row in active_readings(config)),
    )
    sensors: dict[str, list[str]] = {}
    for element in present:
        if element.kind not in touched or element.motion is Motion.VIRTUAL:
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
    robot: Robot,
    present: list[Element],
    guided: list[Element],
    placed: list[Element],
    contact_names: dict[str, list[str]],
) -> Scene:
    """Find the indices of all names in the compiled model.

    `guided` elements have targets, and `placed` elements are mocap bodies.
    """
    slots = add_columns({}, {element.kind: element.count(config) for element in present})
    num_free = sum(element.count(config) for element in present if element.is_free)
    spans = [slots[element.kind] for element in guided] or [slice(0, 0)]
    return Scene(
        config=config,
        model=model,
        names=tuple(name for element in present for name in element.names(config)),
        slots=slots,
        kinds=tuple(element.kind for element in ELEMENTS),
        heights=tuple(element.height(config) for element in present for _ in element.names(config)),
        num_free=num_free,
        num_mocap_slots=sum(element.count(config) for element in placed),
        guided=slice(spans[0].start, spans[-1].stop),
        num_targets=spans[-1].stop - spans[0].start,
        travel=tuple(
            getattr(config, f"{element.kind}_travel")
            for element in guided
            for _ in element.names(config)
        ),
        robot_body=model.body("robot").id,
        robot_sensors=robot.num_sensors,
        robot_nq=model.nq - 7 * num_free,
        robot_nv=model.nv - 6 * num_free,
        planar=robot.planar,
        oriented_body=_oriented_body(config, model, robot)
        if config.reward_orientation
        else model.body("robot").id,
        free_bodies=slice(1 + robot.num_bodies, 1 + robot.num_bodies + num_free),
        contacts={
            kind: slice(first := int(model.sensor(sensors[0]).adr[0]), first + len(sensors))
            for kind, sensors in contact_names.items()
        },
    )


def _oriented_body(config: SafetyGymConfig, model: mujoco.MjModel, robot: Robot) -> int:
    """Body id of `reward_orientation_body`."""
    wanted = config.reward_orientation_body
    names = [model.body(i).name for i in range(1, 1 + robot.num_bodies)]
    if wanted not in names:
        raise ConfigError(
            f"'reward_orientation_body': robot '{config.robot_base}' has no body '{wanted}'."
            f"{did_you_mean(wanted, names)} Its bodies are {', '.join(names)}."
        )
    return 1 + names.index(wanted)
