"""Compile the model of a configuration, and find the indices of objects in its arrays.

Everything that differs between episodes is state: free bodies are in `qpos`, and static bodies are
mocap bodies. The order of bodies is robot, vases, gremlins, box, the gremlins' targets, static
bodies.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import mujoco

from safe_rl.envs.contract import add_columns
from safe_rl.envs.keys import ConfigError
from safe_rl.envs.physics.dynamics import SCALES, scale_dynamics
from safe_rl.envs.safety_gym.config import ROBOTS, SafetyGymConfig
from safe_rl.envs.safety_gym.costs import active_costs
from safe_rl.envs.safety_gym.elements import ELEMENTS, NUM_RAY_GROUPS, PUSHED, Element, Geom, Motion
from safe_rl.envs.safety_gym.observations import active_readings
from safe_rl.envs.safety_gym.robots import Robot, load_robot
from safe_rl.envs.safety_gym.tasks import TASKS
from safe_rl.envs.safety_gym.world import Scene
from safe_rl.naming import did_you_mean

# The robot files' stack and contact sizes would reserve hundreds of MB for every environment.
ARENA_BYTES = 8 << 20
# MuJoCo's default (1e-3) lets slowly sliding vases sleep, which lowers the vase-velocity cost.
SLEEP_TOLERANCE = 1e-5
FLOOR_HALF_SIZE = 3.5  # visible part [m]; the plane itself is infinite

# Rotation about x by 45 degrees: the camera looks north and down.
_NORTH_DOWN = (math.cos(math.pi / 8), math.sin(math.pi / 8), 0.0, 0.0)
# Fixed cameras: position in the world [m].
FIXED_CAMERAS = {"fixednear": (0.0, -2.0, 2.0), "fixedfar": (0.0, -5.0, 5.0)}
VISION = "vision"  # the robot's own, part of the robot file
# Textures and materials of the robot file may have any other name.
_FLOOR, _SKY = "safe_rl_floor", "safe_rl_sky"

SKY_RGB = ((0.7, 0.78, 0.92), (0.42, 0.5, 0.68))  # overhead and underfoot
FLOOR_RGB = ((0.74, 0.74, 0.74), (0.82, 0.82, 0.82))
FLOOR_TILE = 0.5  # side of a square of the chequered floor [m]
SLICES, STACKS = 24, 8  # facets of a round shape; few, as halos have hundreds of spheres
DISPLAY_RIM = 0.1  # how far a cropped floor reaches beyond the placements [m]


def build_scene(config: SafetyGymConfig, sleep: bool = False, decorated: bool = False) -> Scene:
    """Compile the world of a configuration; with `sleep`, resting free bodies sleep until touched.

    A `decorated` world is for pictures: areas are bodies too, and there are cameras, light and a
    floor pattern. It has the same `qpos` and first mocap bodies as the plain world.
    """
    robot = load_robot(ROBOTS.get(config.robot_base, Path(config.robot_base)))
    spec = robot.spec
    spec.memory = ARENA_BYTES
    # With this option, MuJoCo 4.0.0 computes wrong normals for cylinders; MuJoCo 2 lacks it.
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_MULTICCD
    if sleep:
        spec.option.enableflags |= mujoco.mjtEnableBit.mjENBL_SLEEP
        spec.option.sleep_tolerance = SLEEP_TOLERANCE
    present = [element for element in ELEMENTS if element.names(config)]
    guided = [element for element in present if element.motion is Motion.GUIDED]
    # Rays and pictures see geoms only, so natural lidar needs bodies for the areas as well.
    needs_areas = decorated or config.lidar_type == "natural"
    mocaps = (Motion.STATIC, Motion.VIRTUAL) if needs_areas else (Motion.STATIC,)
    placed = [element for element in present if element.motion in mocaps]
    try:
        floor = spec.worldbody.add_geom(
            spec.default, type=mujoco.mjtGeom.mjGEOM_PLANE, name="floor"
        )
        floor.size = [FLOOR_HALF_SIZE, FLOOR_HALF_SIZE, 0.1]
        floor.contype, floor.conaffinity = floor.contype | 1, floor.conaffinity | 1
        for element in present:
            if element.motion in PUSHED:
                _add_bodies(spec, config, element, decorated)
        for element in guided:
            _add_targets(spec, config, element, decorated)
        if decorated:
            _decorate(spec, config)
        for element in placed:
            _add_bodies(spec, config, element, decorated)
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
    scale_dynamics(model, scales, slice(1, 1 + robot.num_bodies))
    return _index(config, model, robot, present, guided, placed, contact_names)


def _add_bodies(
    spec: mujoco.MjSpec, config: SafetyGymConfig, element: Element, decorated: bool
) -> None:
    """Add a body per object: a free body if it can be pushed, else a mocap body.

    Areas have a shape only if rays see them, or in a `decorated` world, which is for pictures. The
    goal of a button task has none: its button is seen.
    """
    stands_in = element.kind == "goal" and TASKS[config.task].goal_at_button
    shows_area = (decorated or element.group < NUM_RAY_GROUPS) and not stands_in
    for name in element.names(config):
        body = spec.worldbody.add_body(
            name=name, pos=[0, 0, element.height(config)], mocap=element.motion not in PUSHED
        )
        if element.motion in PUSHED:
            body.add_freejoint(name=name)
        if element.motion is not Motion.VIRTUAL or shows_area:
            _add_geoms(spec, body, config, element)


def _add_targets(
    spec: mujoco.MjSpec, config: SafetyGymConfig, element: Element, decorated: bool
) -> None:
    """Add a mocap target per object, and weld the object to it without an offset."""
    for name in element.names(config):
        target = spec.worldbody.add_body(
            name=f"{name}_target", pos=[0, 0, element.height(config)], mocap=True
        )
        if config.lidar_type == "natural" and not decorated:
            # The benchmark's targets have a shape that only rays meet.
            _add_geoms(spec, target, config, element, ghost=True)
        weld = spec.add_equality(
            type=mujoco.mjtEq.mjEQ_WELD,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            name1=target.name,
            name2=name,
            solref=[0.02, 1.5],
        )
        # The data of a new equality are not those of a weld: no anchor, relative pose from the
        # initial one, torque scale 1.
        weld.data[:10], weld.data[10:] = 0, 1


def _add_geoms(
    spec: mujoco.MjSpec,
    body: mujoco.MjsBody,
    config: SafetyGymConfig,
    element: Element,
    ghost: bool = False,
) -> None:
    """Add an element's shapes; they inherit the robot file's defaults (condim, density)."""
    ghost = ghost or element.motion is Motion.VIRTUAL
    shapes = element.geoms(config)
    if isinstance(shapes, Geom):
        raise ConfigError(f"'geoms' of '{element.kind}' must return a tuple of Geoms, got a Geom.")
    for shape in shapes:
        geom = body.add_geom(spec.default, type=shape.type, pos=shape.pos, group=element.group)
        geom.size[: len(shape.size)] = shape.size
        geom.rgba = [*element.rgb, 0.25 if ghost else 1.0]
        if ghost:
            geom.contype = geom.conaffinity = 0
        else:
            # with objects, and with robots whose file has other defaults
            geom.contype, geom.conaffinity = geom.contype | 1, geom.conaffinity | 1
        if element.motion in PUSHED:
            geom.density = getattr(config, f"{element.kind}_density")
            geom.mass = math.nan  # a default of the robot file would replace the density


def _decorate(spec: mujoco.MjSpec, config: SafetyGymConfig) -> None:
    """Add cameras, light, sky and floor pattern to a world; they have no effect on the physics."""
    floor = spec.geom("floor")
    if config.floor_display_mode:
        half = max(abs(bound) for bound in config.placements_extents) + DISPLAY_RIM
        floor.size = [half, half, 0.1]
    kind, look = mujoco.mjtTexture, mujoco.mjtBuiltin
    _add_texture(spec, _FLOOR, kind.mjTEXTURE_2D, look.mjBUILTIN_CHECKER, FLOOR_RGB, (256, 256))
    _add_texture(spec, _SKY, kind.mjTEXTURE_SKYBOX, look.mjBUILTIN_GRADIENT, SKY_RGB, (128, 768))
    material = spec.add_material(name=_FLOOR, texuniform=True, texrepeat=[0.5 / FLOOR_TILE] * 2)
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = _FLOOR
    floor.material = _FLOOR
    floor.rgba = [1, 1, 1, 1]  # instead of the robot file's default, which would colour it
    spec.visual.quality.numslices, spec.visual.quality.numstacks = SLICES, STACKS
    # from above and the south-west, without shadows, which slow software OpenGL
    light = spec.worldbody.add_light(pos=[0, 0, 4], dir=[0.3, 0.4, -1], castshadow=False)
    light.type = mujoco.mjtLightType.mjLIGHT_DIRECTIONAL
    light.diffuse, light.specular = [0.7] * 3, [0.1] * 3
    headlight = spec.visual.headlight
    headlight.ambient, headlight.diffuse, headlight.specular = [0.35] * 3, [0.25] * 3, [0] * 3
    for name, position in FIXED_CAMERAS.items():
        if spec.camera(name) is None:  # those of the robot file are preferred
            spec.worldbody.add_camera(name=name, pos=position, quat=_NORTH_DOWN)


def _add_texture(
    spec: mujoco.MjSpec, name: str, kind: Any, look: Any, rgb: Any, size: tuple[int, int]
) -> None:
    texture = spec.add_texture(name=name, type=kind, builtin=look, rgb1=rgb[0], rgb2=rgb[1])
    texture.width, texture.height = size


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
    names = {element.kind: element.names(config) for element in present}
    slots = add_columns({}, {kind: len(objects) for kind, objects in names.items()})
    num_free = sum(len(names[element.kind]) for element in present if element.motion in PUSHED)
    spans = [slots[element.kind] for element in guided] or [slice(0, 0)]
    root = model.body("robot").id
    return Scene(
        config=config,
        model=model,
        names=tuple(name for objects in names.values() for name in objects),
        slots=slots,
        kinds=tuple(element.kind for element in ELEMENTS),
        heights=tuple(element.height(config) for element in present for _ in names[element.kind]),
        num_free=num_free,
        num_mocap_slots=sum(len(names[element.kind]) for element in placed),
        guided=slice(spans[0].start, spans[-1].stop),
        num_targets=spans[-1].stop - spans[0].start,
        travel=tuple(
            getattr(config, f"{element.kind}_travel")
            for element in guided
            for _ in names[element.kind]
        ),
        robot_body=root,
        robot_sensors=robot.num_sensors,
        robot_nq=model.nq - 7 * num_free,
        robot_nv=model.nv - 6 * num_free,
        planar=robot.planar,
        oriented_body=_oriented_body(config, model, robot) if config.reward_orientation else root,
        free_bodies=slice(1 + robot.num_bodies, 1 + robot.num_bodies + num_free),
        contacts={
            kind: slice(first := int(model.sensor(sensors[0]).adr[0]), first + len(sensors))
            for kind, sensors in contact_names.items()
        },
    )


def _oriented_body(config: SafetyGymConfig, model: mujoco.MjModel, robot: Robot) -> int:
    wanted = config.reward_orientation_body
    names = [model.body(i).name for i in range(1, 1 + robot.num_bodies)]
    if wanted not in names:
        raise ConfigError(
            f"'reward_orientation_body': robot '{config.robot_base}' has no body '{wanted}'."
            f"{did_you_mean(wanted, names)} Its bodies are {', '.join(names)}."
        )
    return 1 + names.index(wanted)
