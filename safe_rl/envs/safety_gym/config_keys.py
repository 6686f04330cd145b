"""The environment-builder's keys: one declaration each of type, default, meaning and range.

Names, defaults and meaning are those of the 2019 Safety Gym engine (paper, section 4.1), so that
its dictionaries can be used as they are, see also `RETIRED`; `layout_seeds`, `layout_seeds_first`,
`vases_rots`, `gremlins_rots` and `box_rots` are additions, and so are the scales of the dynamics,
`physics`, boundaries and `velocity_limit`.
"""

from __future__ import annotations

from safe_rl.envs.safety_gym.config_values import (
    FREE_OBJECTS,
    LARGEST_SEED,
    NOT_NEGATIVE,
    OBJECTS,
    POSITIVE,
    PROBABILITY,
    Locations,
    Placements,
    Rectangle,
    key,
    one_of,
)

_AREAS = "rectangles where centres may be; None: anywhere within placements_extents"
_PINNED = "(x, y) of the first objects, which then stand there [m]"
_KEEPOUT = "distance that other keepouts stay away from the centre [m]"
_YAWS = "yaw of the first objects; the others' are drawn"
_LIDAR = "whether there is a lidar for "
_COSTS = "whether there is a cost for "
_NUMBER = "number of objects"
_PIXELS = POSITIVE.up_to(4096)
_UNUSED = "part of the vocabulary; no cost reads it"

# Keys of 2019 that nothing reads any more -> the value that changes nothing, and what to do else.
RETIRED = {
    "_seed": (None, "give `seed` to the environment or its reset instead"),
    "build_resample": (True, "layouts are always drawn again until everything fits"),
}


class Vocabulary:
    """The keys that are built in."""

    # episode
    num_steps: int = key(1000, "steps after which an episode is truncated", POSITIVE)
    action_noise: float = key(0.0, "std of noise added to the clipped control", NOT_NEGATIVE)
    frameskip_binom_n: int = key(
        10, "substeps per step ~ Binomial(n, p): n", POSITIVE.up_to(10_000)
    )
    frameskip_binom_p: float = key(1.0, "and p", PROBABILITY)

    # physics
    physics: str = key(
        "cpu", "MuJoCo on the CPU, or MuJoCo Warp on the device", one_of("cpu", "warp")
    )
    physics_buffers: float = key(
        2.0, "room for contacts in Warp, in multiples of the most that a trial met", POSITIVE
    )

    # placement
    placements_extents: Rectangle = key(
        (-2.0, -2.0, 2.0, 2.0), "xmin, ymin, xmax, ymax of where anything is placed [m]"
    )
    placements_margin: float = key(0.0, "added to the sum of two keepouts [m]")
    randomize_layout: bool = key(True, "whether every episode has another layout")
    layout_seeds: int | None = key(
        None, "number of different layouts; None: unlimited", POSITIVE.up_to(LARGEST_SEED)
    )
    layout_seeds_first: int = key(
        0,
        "they are first, first + 1, …; disjoint ranges share none",
        NOT_NEGATIVE.up_to(LARGEST_SEED),
    )
    continue_goal: bool = key(True, "draw a new goal where one was met; False ends the episode")
    terminate_resample_failure: bool = key(
        True, "end an episode whose new goal has no place; False is an error"
    )

    # robot
    robot_base: str = key("car", "point, car, doggo, or the path of an MJCF file")
    robot_placements: Placements = key(None, _AREAS)
    robot_locations: Locations = key((), "(x, y) where the robot starts [m]")
    robot_keepout: float = key(0.4, _KEEPOUT, NOT_NEGATIVE)
    robot_rot: float | None = key(None, "yaw at the start; None: uniform")

    # dynamics
    mass_scale: float = key(1.0, "factor on the robot's masses and inertias", POSITIVE)
    friction_scale: float = key(1.0, "factor on the friction of all surfaces", POSITIVE)
    damping_scale: float = key(1.0, "factor on the damping of the robot's joints", NOT_NEGATIVE)
    strength_scale: float = key(1.0, "factor on the forces of its actuators", NOT_NEGATIVE)

    # observations
    observation_flatten: bool = key(True, "one vector; False: every component by its name")
    observe_sensors: bool = key(True, "whether the robot's sensors are observed")
    observe_goal_dist: bool = key(False, "exp(-distance to the goal)")
    observe_goal_comp: bool = key(False, "compass to the goal")
    observe_goal_lidar: bool = key(False, _LIDAR + "the goal")
    observe_box_comp: bool = key(False, "compass to the box")
    observe_box_lidar: bool = key(False, _LIDAR + "the box")
    observe_circle: bool = key(False, _LIDAR + "the circle's centre")
    observe_remaining: bool = key(False, "share of the episode's steps that are taken")
    observe_walls: bool = key(False, _LIDAR + "walls")
    observe_hazards: bool = key(False, _LIDAR + "hazards")
    observe_vases: bool = key(False, _LIDAR + "vases")
    observe_pillars: bool = key(False, _LIDAR + "pillars")
    observe_buttons: bool = key(False, _LIDAR + "buttons")
    observe_gremlins: bool = key(False, _LIDAR + "gremlins")
    observe_vision: bool = key(False, "picture of the robot's camera")
    observe_qpos: bool = key(False, "positions of joints; a planar root's from where it started")
    observe_qvel: bool = key(False, "velocities of joints")
    observe_ctrl: bool = key(False, "the last control")
    observe_freejoint: bool = key(False, "position and quaternion of a free root")
    observe_com: bool = key(False, "centre of mass of the robot [m]")
    sensors_obs: tuple[str, ...] = key(
        ("accelerometer", "velocimeter", "gyro", "magnetometer"), "sensors of the robot's file"
    )
    sensors_hinge_joints: bool = key(True, "angles and velocities of hinges with a sensor")
    sensors_ball_joints: bool = key(True, "rotations and velocities of ball joints with a sensor")
    sensors_angle_components: bool = key(
        True, "angles as (sin, cos), quaternions as rotation matrices"
    )
    lidar_num_bins: int = key(10, "bins over the full circle", POSITIVE.up_to(10_000))
    lidar_max_dist: float | None = key(
        None, "readings fall linearly to 0 there [m]; None: exponentially", POSITIVE
    )
    lidar_exp_gain: float = key(1.0, "gain of exponential readings [1/m]", NOT_NEGATIVE)
    lidar_type: str = key(
        "pseudo", "by bearings of centres, or by rays", one_of("pseudo", "natural")
    )
    lidar_alias: bool = key(True, "also light neighbouring bins, by where in its bin an object is")
    compass_shape: int = key(2, "components of a compass", one_of(2, 3))
    vision_size: tuple[int, int] = key((60, 40), "width and height of the picture", _PIXELS)
    vision_render: bool = key(True, "show it in the corner of frames, where it is observed")
    vision_render_size: tuple[int, int] = key((300, 200), "and how large at most", _PIXELS)

    # task and reward
    task: str = key("goal", "what is rewarded: goal, button, push, x, z, circle or none")
    goal_placements: Placements = key(None, _AREAS)
    goal_locations: Locations = key((), _PINNED)
    goal_keepout: float = key(0.4, _KEEPOUT, NOT_NEGATIVE)
    goal_size: float = key(0.3, "radius of the goal [m]", POSITIVE)
    box_placements: Placements = key(None, _AREAS)
    box_locations: Locations = key((), _PINNED)
    box_rots: tuple[float, ...] = key((), _YAWS)
    box_keepout: float = key(0.2, _KEEPOUT, NOT_NEGATIVE)
    box_size: float = key(0.2, "half side of the box [m]", POSITIVE)
    box_density: float = key(0.001, "of the box", POSITIVE)
    box_null_dist: float = key(2.0, "approach is rewarded beyond this, in units of box_size")
    reward_distance: float = key(1.0, "per metre nearer to the goal")
    reward_goal: float = key(1.0, "for a goal that is met")
    reward_box_dist: float = key(1.0, "per metre nearer to the box")
    reward_box_goal: float = key(1.0, "per metre that the box is nearer to the goal")
    reward_orientation: bool = key(False, "whether being upright is rewarded")
    reward_orientation_scale: float = key(0.002, "and how much, per step")
    reward_orientation_body: str = key("robot", "body of the robot that is to be upright")
    reward_exception: float = key(-10.0, "of a step in which the physics failed")
    reward_x: float = key(1.0, "per metre along x, in task x")
    reward_z: float = key(1.0, "per metre upwards, in task z")
    reward_circle: float = key(0.1, "of moving round the circle, in task circle")
    reward_clip: float | None = key(10.0, "bound of dense rewards; None or 0: none", NOT_NEGATIVE)
    circle_radius: float = key(1.5, "of the circle [m]", POSITIVE)

    # constraints
    constrain_hazards: bool = key(False, _COSTS + "being in hazards")
    constrain_vases: bool = key(False, _COSTS + "touching and moving vases")
    constrain_pillars: bool = key(False, _COSTS + "touching pillars")
    constrain_buttons: bool = key(False, _COSTS + "pressing wrong buttons")
    constrain_gremlins: bool = key(False, _COSTS + "touching gremlins")
    constrain_boundary: bool = key(False, _COSTS + "leaving the boundaries")
    boundary_x: float | None = key(None, "beyond this |x| is outside [m]; None: nothing", POSITIVE)
    boundary_y: float | None = key(None, "beyond this |y| is outside [m]; None: nothing", POSITIVE)
    constrain_velocity: bool = key(False, _COSTS + "being faster than velocity_limit")
    velocity_limit: float | None = key(
        None, "speed of the robot that costs nothing [m/s]", POSITIVE
    )
    constrain_indicator: bool = key(True, "costs are 0 or 1 per step; False: their magnitudes")

    # walls
    walls_num: int = key(0, _NUMBER, OBJECTS)
    walls_placements: Placements = key(None, _AREAS)
    walls_locations: Locations = key((), _PINNED)
    walls_keepout: float = key(0.0, _KEEPOUT, NOT_NEGATIVE)
    walls_size: float = key(0.5, "half side [m]", POSITIVE)

    # hazards
    hazards_num: int = key(0, _NUMBER, OBJECTS)
    hazards_placements: Placements = key(None, _AREAS)
    hazards_locations: Locations = key((), _PINNED)
    hazards_keepout: float = key(0.4, _KEEPOUT, NOT_NEGATIVE)
    hazards_size: float = key(0.3, "radius [m]", POSITIVE)
    hazards_cost: float = key(1.0, "per metre that the robot is inside", NOT_NEGATIVE)

    # vases
    vases_num: int = key(0, _NUMBER, FREE_OBJECTS)
    vases_placements: Placements = key(None, _AREAS)
    vases_locations: Locations = key((), _PINNED)
    vases_rots: tuple[float, ...] = key((), _YAWS)
    vases_keepout: float = key(0.15, _KEEPOUT, NOT_NEGATIVE)
    vases_size: float = key(0.1, "half side [m]", POSITIVE)
    vases_density: float = key(0.001, "of vases", POSITIVE)
    vases_sink: float = key(4e-5, "how deep they stand in the floor at the start [m]")
    vases_contact_cost: float = key(1.0, "per contact point with the robot", NOT_NEGATIVE)
    vases_displace_cost: float = key(
        0.0, "per metre from where one stood; 0: no such cost", NOT_NEGATIVE
    )
    vases_displace_threshold: float = key(1e-3, "displacement that is free [m]", NOT_NEGATIVE)
    vases_velocity_cost: float = key(1.0, "per m/s of a vase; 0: no such cost", NOT_NEGATIVE)
    vases_velocity_threshold: float = key(1e-4, "speed below which it is free [m/s]", NOT_NEGATIVE)

    # pillars
    pillars_num: int = key(0, _NUMBER, OBJECTS)
    pillars_placements: Placements = key(None, _AREAS)
    pillars_locations: Locations = key((), _PINNED)
    pillars_keepout: float = key(0.3, _KEEPOUT, NOT_NEGATIVE)
    pillars_size: float = key(0.2, "radius [m]", POSITIVE)
    pillars_height: float = key(0.5, "half height [m]", POSITIVE)
    pillars_cost: float = key(1.0, "per contact point with the robot", NOT_NEGATIVE)

    # buttons
    buttons_num: int = key(0, _NUMBER, OBJECTS)
    buttons_placements: Placements = key(None, _AREAS)
    buttons_locations: Locations = key((), _PINNED)
    buttons_keepout: float = key(0.3, _KEEPOUT, NOT_NEGATIVE)
    buttons_size: float = key(0.1, "radius [m]", POSITIVE)
    buttons_cost: float = key(1.0, "per contact point of the robot with a wrong one", NOT_NEGATIVE)
    buttons_resampling_delay: int = key(
        10, "steps for which buttons sleep after one was pressed", NOT_NEGATIVE
    )

    # gremlins
    gremlins_num: int = key(0, _NUMBER, FREE_OBJECTS)
    gremlins_placements: Placements = key(None, _AREAS)
    gremlins_locations: Locations = key((), _PINNED)
    gremlins_rots: tuple[float, ...] = key((), _YAWS)
    gremlins_keepout: float = key(0.5, _KEEPOUT, NOT_NEGATIVE)
    gremlins_travel: float = key(0.3, "radius of the circle that they run [m]", NOT_NEGATIVE)
    gremlins_size: float = key(0.1, "half side [m]", POSITIVE)
    gremlins_density: float = key(0.001, "of gremlins", POSITIVE)
    gremlins_contact_cost: float = key(1.0, "per contact point with the robot", NOT_NEGATIVE)
    gremlins_dist_threshold: float = key(0.2, _UNUSED, NOT_NEGATIVE)
    gremlins_dist_cost: float = key(1.0, _UNUSED)

    # rendering
    render_labels: bool = key(False, "write the objects' names at them")
    render_lidar_markers: bool = key(True, "draw lidars as rings above the robot")
    render_lidar_radius: float = key(0.15, "of the rings [m]", POSITIVE)
    render_lidar_size: float = key(0.025, "radius of a ring's spheres [m]", POSITIVE)
    render_lidar_offset_init: float = key(0.5, "height of the lowest ring above the robot [m]")
    render_lidar_offset_delta: float = key(0.06, "and of every ring above the one below [m]")
    floor_display_mode: bool = key(False, "crop the visible floor to the placements")
