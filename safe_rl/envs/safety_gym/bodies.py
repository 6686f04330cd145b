"""Add bodies of elements, and objects for pictures, to the MJCF specification of a world."""

from __future__ import annotations

import math

import mujoco

from safe_rl.envs.errors import ConfigError
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.elements import NUM_RAY_GROUPS, Element, Geom, Motion
from safe_rl.envs.safety_gym.tasks import goal_is_button

FLOOR_HALF_SIZE = 3.5  # visible part [m]; the plane itself is infinite


def add_floor(spec: mujoco.MjSpec) -> None:
    """Add the ground plane."""
    floor = spec.worldbody.add_geom(spec.default, type=mujoco.mjtGeom.mjGEOM_PLANE, name="floor")
    floor.size = [FLOOR_HALF_SIZE, FLOOR_HALF_SIZE, 0.1]
    _collide(floor)


def _collide(geom: mujoco.MjsGeom) -> None:
    """Let a shape collide with objects, and with robots whose file has other defaults."""
    geom.contype |= 1
    geom.conaffinity |= 1


def add_bodies(
    spec: mujoco.MjSpec, config: SafetyGymConfig, element: Element, decorated: bool
) -> None:
    """Add a body per object: a free body if it can be pushed, else a mocap body.

    Areas have a shape only if rays see them, or in a `decorated` world, which is for pictures.
    """
    for name in element.names(config):
        body = spec.worldbody.add_body(
            name=name, pos=[0, 0, element.height(config)], mocap=not element.is_free
        )
        if element.is_free:
            body.add_freejoint(name=name)
        if element.motion is not Motion.VIRTUAL or _shows_area(config, element, decorated):
            _add_geoms(spec, body, config, element)


def add_targets(
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


def _shows_area(config: SafetyGymConfig, element: Element, decorated: bool) -> bool:
    """Whether an area has a shape; the goal of a button task has none, but its button has."""
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
            _collide(geom)
        if element.is_free:
            geom.density = getattr(config, f"{element.kind}_density")
            geom.mass = math.nan  # a default of the robot file would replace the density


# Rotation about x by 45 degrees: the camera looks north and down.
_NORTH_DOWN = (math.cos(math.pi / 8), math.sin(math.pi / 8), 0.0, 0.0)
# Fixed cameras: position in the world [m].
FIXED_CAMERAS = {"fixednear": (0.0, -2.0, 2.0), "fixedfar": (0.0, -5.0, 5.0)}
TRACK = "track"  # behind the robot, see `renderer`
VISION = "vision"  # the robot's own, part of the robot file
# Textures and materials of the robot file may have any other name.
_FLOOR, _SKY = "safe_rl_floor", "safe_rl_sky"

SKY_RGB = ((0.7, 0.78, 0.92), (0.42, 0.5, 0.68))  # overhead and underfoot
FLOOR_RGB = ((0.74, 0.74, 0.74), (0.82, 0.82, 0.82))
FLOOR_TILE = 0.5  # side of a square of the chequered floor [m]
SLICES, STACKS = 24, 8  # facets of a round shape; few, as halos have hundreds of spheres
DISPLAY_RIM = 0.1  # how far a cropped floor reaches beyond the placements [m]


def decorate(spec: mujoco.MjSpec, config: SafetyGymConfig) -> None:
    """Add cameras, light, sky and floor pattern to a world; they have no effect on the physics."""
    floor = spec.geom("floor")
    if config.floor_display_mode:
        half = max(abs(bound) for bound in config.placements_extents) + DISPLAY_RIM
        floor.size = [half, half, 0.1]
    floor.material = _floor_material(spec)
    floor.rgba = [1, 1, 1, 1]  # instead of the robot file's default, which would colour it
    spec.visual.quality.numslices, spec.visual.quality.numstacks = SLICES, STACKS
    _add_sky(spec)
    _add_light(spec)
    for name, position in {**FIXED_CAMERAS, TRACK: FIXED_CAMERAS["fixednear"]}.items():
        if spec.camera(name) is None:  # those of the robot file are preferred
            spec.worldbody.add_camera(name=name, pos=position, quat=_NORTH_DOWN)


def _floor_material(spec: mujoco.MjSpec) -> str:
    texture = spec.add_texture(
        name=_FLOOR,
        type=mujoco.mjtTexture.mjTEXTURE_2D,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_CHECKER,
        rgb1=FLOOR_RGB[0],
        rgb2=FLOOR_RGB[1],
        width=256,
        height=256,
    )
    material = spec.add_material(
        name=_FLOOR, texuniform=True, texrepeat=[0.5 / FLOOR_TILE, 0.5 / FLOOR_TILE]
    )
    material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = texture.name
    return material.name


def _add_sky(spec: mujoco.MjSpec) -> None:
    spec.add_texture(
        name=_SKY,
        type=mujoco.mjtTexture.mjTEXTURE_SKYBOX,
        builtin=mujoco.mjtBuiltin.mjBUILTIN_GRADIENT,
        rgb1=SKY_RGB[0],
        rgb2=SKY_RGB[1],
        width=128,
        height=128 * 6,
    )


def _add_light(spec: mujoco.MjSpec) -> None:
    """Add a light from above and the south-west, without shadows: they slow software OpenGL."""
    spec.worldbody.add_light(
        pos=[0, 0, 4],
        dir=[0.3, 0.4, -1],
        type=mujoco.mjtLightType.mjLIGHT_DIRECTIONAL,
        diffuse=[0.7, 0.7, 0.7],
        specular=[0.1, 0.1, 0.1],
        castshadow=False,
    )
    spec.visual.headlight.ambient = [0.35, 0.35, 0.35]
    spec.visual.headlight.diffuse = [0.25, 0.25, 0.25]
    spec.visual.headlight.specular = [0, 0, 0]
