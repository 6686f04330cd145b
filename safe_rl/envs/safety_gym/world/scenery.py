"""What pictures need besides the objects: cameras, light, a sky and a floor to look at."""

from __future__ import annotations

import math

import mujoco

from safe_rl.envs.safety_gym.records.config import SafetyGymConfig

# Rotation about x by 45 degrees: a camera that looks north and down.
_NORTH_DOWN = (math.cos(math.pi / 8), math.sin(math.pi / 8), 0.0, 0.0)
# Fixed cameras: position in the world [m].
FIXED_CAMERAS = {"fixednear": (0.0, -2.0, 2.0), "fixedfar": (0.0, -5.0, 5.0)}
TRACK = "track"  # behind the robot, see `rendering.display`
VISION = "vision"  # the robot's own, part of the robot file
# Textures and materials of the robot file may have any other name.
_FLOOR, _SKY = "safe_rl_floor", "safe_rl_sky"

SKY_RGB = ((0.7, 0.78, 0.92), (0.42, 0.5, 0.68))  # overhead and underfoot
FLOOR_RGB = ((0.74, 0.74, 0.74), (0.82, 0.82, 0.82))
FLOOR_TILE = 0.5  # side of a square of the chequered floor [m]
SLICES, STACKS = 24, 8  # facets of a round shape; halos have hundreds of spheres
DISPLAY_RIM = 0.1  # how far a cropped floor reaches beyond the placements [m]


def decorate(spec: mujoco.MjSpec, config: SafetyGymConfig) -> None:
    """Add cameras, light, sky and floor pattern to a world, and nothing that physics feels.

    Args:
        spec: the world, with its robot and a geom named "floor".
        config: the environment; `floor_display_mode` crops the visible floor to the placements.
    """
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
    """Light from above and the south-west, so that upright faces differ.

    It casts no shadows: they would take software OpenGL a hundred times longer than the rest.
    """
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
