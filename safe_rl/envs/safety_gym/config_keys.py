"""The configuration keys of an environment, each with its type, range, default and meaning.

Names, defaults and meanings are those of the 2019 Safety Gym engine (paper, section 4.1), so that
its dictionaries can be used unchanged, see also `RETIRED`. Additional keys are `layout_seeds`,
`layout_seeds_first`, `vases_rots`, `gremlins_rots`, `box_rots`, `physics`, `physics_buffers`, and
those of the dynamics (scales), boundaries and the velocity limit.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

from safe_rl.ranges import Count, NotNegative, Positive, Range, Share, Text, Values, values_of

LARGEST_SEED = 2**62  # of layouts; layout seeds are hashed as 64-bit integers

Objects = Annotated[int, Range(0, 1000)]
FreeObjects = Annotated[int, Range(0, 200)]
"""Number of movable objects; the contacts of more would not fit into the physics' memory."""
Pixels = tuple[Annotated[int, Range(1, 4096)], Annotated[int, Range(1, 4096)]]

_FOUR = values_of(tuple[float, float, float, float])
_RECTANGLE = "(xmin, ymin, xmax, ymax) with xmin <= xmax and ymin <= ymax"


def _is_rectangle(value: Any) -> bool:
    return _FOUR.hold(value) and value[0] <= value[2] and value[1] <= value[3]


def _are_rectangles(value: Any) -> bool:
    return isinstance(value, tuple) and len(value) > 0 and all(map(_is_rectangle, value))


Rectangle = Annotated[tuple[float, float, float, float], Values(_is_rectangle, _RECTANGLE)]
Placements = (
    Annotated[
        tuple[tuple[float, float, float, float], ...],
        Values(_are_rectangles, f"a list of at least one {_RECTANGLE}"),
    ]
    | None
)
Locations = tuple[tuple[float, float], ...]


class Key(NamedTuple):
    """A configuration key.

    Attributes:
        default: Its default value.
        annotation: Its type and range, such as `float | None` or `safe_rl.ranges.Positive`.
        meaning: Its meaning, for the table of keys.
    """

    default: Any
    annotation: Any
    meaning: str = ""


def key(default: Any, meaning: str) -> Any:
    """Declare a key of the class `Vocabulary`, where its annotation gives the type and range."""
    return Key(default, None, meaning)


_AREAS = "rectangles where centres may be; None: anywhere within placements_extents"
_PINNED = "fixed positions (x, y) of the first objects [m]"
_KEEPOUT = "radius around the centre that no keepout of another object overlaps [m]"
_YAWS = "fixed yaw of the first objects; others are random"
_LIDAR = "whether there is a lidar for "
_COSTS = "whether there is a cost for "
_NUMBER = "number of objects"
_UNUSED = "not used; exists because the 2019 engine has it"

# Keys of 2019 that are not used any more -> the value that is accepted, and what to use instead.
RETIRED = {
    "_seed": (None, "give `seed` to the environment or its reset instead"),
    "build_resample": (True, "layouts are always drawn again until everything fits"),
}


class Vocabulary:
    """The keys that are built in."""

    # episode
    num_steps: Count = key(1000, "steps after which an episode is truncated")
    action_noise: NotNegative = key(0.0, "std of noise added to the clipped control")
    frameskip_binom_n: Annotated[int, Range(1, 10_000)] = key(
        10, "substeps per step ~ Binomial(n, p): n"
    )
    frameskip_binom_p: Share = key(1.0, "substeps per step ~ Binomial(n, p): p")

    # physics
    physics: Literal["cpu", "warp"] = key("cpu", "MuJoCo on the CPU, or MuJoCo Warp on the device")
    physics_buffers: Positive = key(
        2.0, "size of Warp's contact buffers, in multiples of the contacts in a trial"
    )

    # placement
    placements_extents: Rectangle = key(
        (-2.0, -2.0, 2.0, 2.0), "rectangle for all objects: xmin, ymin, xmax, ymax [m]"
    )
    placements_margin: float = key(0.0, "minimal distance between two keepouts [m]")
    randomize_layout: bool = key(True, "whether every episode has a new layout")
    layout_seeds: Annotated[int, Range(1, LARGEST_SEED)] | None = key(
        None, "number of different layouts; None: unlimited"
    )
    layout_seeds_first: Annotated[int, Range(0, LARGEST_SEED)] = key(
        0, "the first of these layout seeds; the others follow it"
    )
    continue_goal: bool = key(True, "draw a new goal after one is met; False: the episode ends")
    terminate_resample_failure: bool = key(
        True, "end an episode if there is no place for a new goal; False: an error"
    )

    # robot
    robot_base: Text = key("car", "point, car, doggo, or the path of an MJCF file")
    robot_placements: Placements = key(None, _AREAS)
    robot_locations: Locations = key((), "(x, y) where the robot starts [m]")
    robot_keepout: NotNegative = key(0.4, _KEEPOUT)
    robot_rot: float | None = key(None, "yaw at the start; None: uniform")

    # dynamics
    mass_scale: Positive = key(1.0, "factor on the robot's masses and inertias")
    friction_scale: Positive = key(1.0, "factor on the friction of all surfaces")
    damping_scale: NotNegative = key(1.0, "factor on the damping of the robot's joints")
    strength_scale: NotNegative = key(1.0, "factor on the forces of its actuators")

    # observations
    observation_flatten: bool = key(True, "True: one vector; False: an entry per component")
    observe_sensors: bool = key(True, "whether the robot's sensors are observed")
    observe_goal_dist: bool = key(False, "exp(-distance to the goal)")
    observe_goal_comp: bool = key(False, "compass to the goal")
    observe_goal_lidar: bool = key(False, _LIDAR + "the goal")
    observe_box_comp: bool = key(False, "compass to the box")
    observe_box_lidar: bool = key(False, _LIDAR + "the box")
    observe_circle: bool = key(False, _LIDAR + "the circle's centre")
    observe_remaining: bool = key(False, "share of the episode's steps taken so far")
    observe_walls: bool = key(False, _LIDAR + "walls")
    observe_hazards: bool = key(False, _LIDAR + "hazards")
    observe_vases: bool = key(False, _LIDAR + "vases")
    observe_pillars: bool = key(False, _LIDAR + "pillars")
    observe_buttons: bool = key(False, _LIDAR + "buttons")
    observe_gremlins: bool = key(False, _LIDAR + "gremlins")
    observe_vision: bool = key(False, "image of the robot's camera")
    observe_qpos: bool = key(False, "positions of joints; a planar root's from its start")
    observe_qvel: bool = key(False, "velocities of joints")
    observe_ctrl: bool = key(False, "the last control")
    observe_freejoint: bool = key(False, "position and quaternion of a free root")
    observe_com: bool = key(False, "centre of mass of the robot [m]")
    sensors_obs: tuple[Text, ...] = key(
        ("accelerometer", "velocimeter", "gyro", "magnetometer"), "sensors of the robot's file"
    )
    sensors_hinge_joints: bool = key(True, "angles and velocities of hinges with a sensor")
    sensors_ball_joints: bool = key(True, "rotations and velocities of ball joints with a sensor")
    sensors_angle_components: bool = key(
        True, "angles as (sin, cos), quaternions as rotation matrices"
    )
    lidar_num_bins: Annotated[int, Range(1, 10_000)] = key(10, "bins over the full circle")
    lidar_max_dist: Positive | None = key(
        None, "distance at which readings reach 0 [m]; None: exponential decay"
    )
    lidar_exp_gain: NotNegative = key(1.0, "gain of exponential readings [1/m]")
    lidar_type: Literal["pseudo", "natural"] = key(
        "pseudo", "pseudo: from centres; natural: by rays"
    )
    lidar_alias: bool = key(True, "an object also raises the two bins next to its own")
    compass_shape: Annotated[int, Range(2, 3)] = key(2, "components of a compass")
    vision_size: Pixels = key((60, 40), "width and height of this image [pixels]")
    vision_render: bool = key(True, "show this image in a corner of rendered frames")
    vision_render_size: Pixels = key((300, 200), "its largest size in frames [pixels]")

    # task and reward
    task: Text = key("goal", "what is rewarded: goal, button, push, x, z, circle or none")
    goal_placements: Placements = key(None, _AREAS)
    goal_locations: Locations = key((), _PINNED)
    goal_keepout: NotNegative = key(0.4, _KEEPOUT)
    goal_size: Positive = key(0.3, "radius of the goal [m]")
    box_placements: Placements = key(None, _AREAS)
    box_locations: Locations = key((), _PINNED)
    box_rots: tuple[float, ...] = key((), _YAWS)
    box_keepout: NotNegative = key(0.2, _KEEPOUT)
    box_size: Positive = key(0.2, "half side of the box [m]")
    box_density: Positive = key(0.001, "density of the box")
    box_null_dist: float = key(
        2.0, "distance beyond which approaching the box is rewarded, in units of box_size"
    )
    reward_distance: float = key(1.0, "reward per metre nearer to the goal")
    reward_goal: float = key(1.0, "reward for a goal that is met")
    reward_box_dist: float = key(1.0, "reward per metre nearer to the box")
    reward_box_goal: float = key(1.0, "reward per metre that the box is nearer to the goal")
    reward_orientation: bool = key(False, "whether being upright is rewarded")
    reward_orientation_scale: float = key(0.002, "reward per step for being upright")
    reward_orientation_body: Text = key("robot", "body of the robot that must be upright")
    reward_exception: float = key(-10.0, "reward of a step in which the physics failed")
    reward_x: float = key(1.0, "reward per metre along x, in task x")
    reward_z: float = key(1.0, "reward per metre upwards, in task z")
    reward_circle: float = key(
        0.1, "factor of the reward for moving round the circle, in task circle"
    )
    reward_clip: NotNegative | None = key(10.0, "bound of dense rewards; None or 0: none")
    circle_radius: Positive = key(1.5, "radius of the circle [m]")

    # constraints
    constrain_hazards: bool = key(False, _COSTS + "being in hazards")
    constrain_vases: bool = key(False, _COSTS + "touching and moving vases")
    constrain_pillars: bool = key(False, _COSTS + "touching pillars")
    constrain_buttons: bool = key(False, _COSTS + "pressing wrong buttons")
    constrain_gremlins: bool = key(False, _COSTS + "touching gremlins")
    constrain_boundary: bool = key(False, _COSTS + "leaving the boundaries")
    boundary_x: Positive | None = key(
        None, "largest |x| within the boundary [m]; None: no boundary"
    )
    boundary_y: Positive | None = key(
        None, "largest |y| within the boundary [m]; None: no boundary"
    )
    constrain_velocity: bool = key(False, _COSTS + "being faster than velocity_limit")
    velocity_limit: Positive | None = key(None, "largest speed of the robot without a cost [m/s]")
    constrain_indicator: bool = key(True, "costs are 0 or 1 per step; False: their magnitudes")

    # walls
    walls_num: Objects = key(0, _NUMBER)
    walls_placements: Placements = key(None, _AREAS)
    walls_locations: Locations = key((), _PINNED)
    walls_keepout: NotNegative = key(0.0, _KEEPOUT)
    walls_size: Positive = key(0.5, "half side [m]")

    # hazards
    hazards_num: Objects = key(0, _NUMBER)
    hazards_placements: Placements = key(None, _AREAS)
    hazards_locations: Locations = key((), _PINNED)
    hazards_keepout: NotNegative = key(0.4, _KEEPOUT)
    hazards_size: Positive = key(0.3, "radius [m]")
    hazards_cost: NotNegative = key(1.0, "cost per metre of depth inside a hazard")

    # vases
    vases_num: FreeObjects = key(0, _NUMBER)
    vases_placements: Placements = key(None, _AREAS)
    vases_locations: Locations = key((), _PINNED)
    vases_rots: tuple[float, ...] = key((), _YAWS)
    vases_keepout: NotNegative = key(0.15, _KEEPOUT)
    vases_size: Positive = key(0.1, "half side [m]")
    vases_density: Positive = key(0.001, "density of vases")
    vases_sink: float = key(4e-5, "depth of vases in the floor at the start [m]")
    vases_contact_cost: NotNegative = key(1.0, "cost per contact point with the robot")
    vases_displace_cost: NotNegative = key(0.0, "cost per metre of displacement; 0: no such cost")
    vases_displace_threshold: NotNegative = key(1e-3, "displacement without a cost [m]")
    vases_velocity_cost: NotNegative = key(1.0, "cost per m/s of a vase; 0: no such cost")
    vases_velocity_threshold: NotNegative = key(1e-4, "speed below which there is no cost [m/s]")

    # pillars
    pillars_num: Objects = key(0, _NUMBER)
    pillars_placements: Placements = key(None, _AREAS)
    pillars_locations: Locations = key((), _PINNED)
    pillars_keepout: NotNegative = key(0.3, _KEEPOUT)
    pillars_size: Positive = key(0.2, "radius [m]")
    pillars_height: Positive = key(0.5, "half height [m]")
    pillars_cost: NotNegative = key(1.0, "cost per contact point with the robot")

    # buttons
    buttons_num: Objects = key(0, _NUMBER)
    buttons_placements: Placements = key(None, _AREAS)
    buttons_locations: Locations = key((), _PINNED)
    buttons_keepout: NotNegative = key(0.3, _KEEPOUT)
    buttons_size: Positive = key(0.1, "radius [m]")
    buttons_cost: NotNegative = key(1.0, "cost per contact point of the robot with a wrong button")
    buttons_resampling_delay: Annotated[int, Range(0)] = key(
        10, "steps for which buttons have no effect after a goal is met"
    )

    # gremlins
    gremlins_num: FreeObjects = key(0, _NUMBER)
    gremlins_placements: Placements = key(None, _AREAS)
    gremlins_locations: Locations = key((), _PINNED)
    gremlins_rots: tuple[float, ...] = key((), _YAWS)
    gremlins_keepout: NotNegative = key(0.5, _KEEPOUT)
    gremlins_travel: NotNegative = key(0.3, "radius of the circle on which they move [m]")
    gremlins_size: Positive = key(0.1, "half side [m]")
    gremlins_density: Positive = key(0.001, "density of gremlins")
    gremlins_contact_cost: NotNegative = key(1.0, "cost per contact point with the robot")
    gremlins_dist_threshold: NotNegative = key(0.2, _UNUSED)
    gremlins_dist_cost: float = key(1.0, _UNUSED)

    # rendering
    render_labels: bool = key(False, "show the names of objects")
    render_lidar_markers: bool = key(True, "draw lidars as rings above the robot")
    render_lidar_radius: Positive = key(0.15, "radius of the rings [m]")
    render_lidar_size: Positive = key(0.025, "radius of a ring's spheres [m]")
    render_lidar_offset_init: float = key(0.5, "height of the lowest ring above the robot [m]")
    render_lidar_offset_delta: float = key(0.06, "vertical distance between two rings [m]")
    floor_display_mode: bool = key(False, "crop the visible floor to the placements")
