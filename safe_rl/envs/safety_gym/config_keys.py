"""The configuration keys of an environment, each with its type, range, default and meaning.

Names, defaults and meanings are those of the 2019 Safety Gym engine (paper, section 4.1), so that
its dictionaries can be used unchanged. Additional keys are `layout_seeds`, `layout_seeds_first`,
`vases_rots`, `gremlins_rots`, `box_rots`, `physics`, `physics_buffers`, and those of the dynamics
(scales), boundaries and the velocity limit.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

from annotated_types import Interval, MinLen

from safe_rl.checks import Share, Text, rule
from safe_rl.envs.keys import Backend, Count, Factor, FactorOrZero, NotNegative, Number, Positive

LARGEST_SEED = 2**62  # of layouts; layout seeds are hashed as 64-bit integers

Objects = Annotated[int, Interval(ge=0, le=1000)]
FreeObjects = Annotated[int, Interval(ge=0, le=200)]
"""Number of movable objects; the contacts of more would not fit into the physics' memory."""
Amount = Annotated[int, Interval(ge=1, le=10_000)]
Steps = Annotated[int, Interval(ge=0, le=10**15)]
Seed = Annotated[int, Interval(ge=0, le=LARGEST_SEED)]
Seeds = Annotated[int, Interval(ge=1, le=LARGEST_SEED)]
_Side = Annotated[int, Interval(ge=1, le=4096)]
Pixels = tuple[_Side, _Side]
Lidar = Literal["pseudo", "natural"]

Rectangle = Annotated[
    tuple[float, float, float, float],
    rule(
        lambda area: area[0] <= area[2] and area[1] <= area[3],
        "a rectangle (xmin, ymin, xmax, ymax) with xmin <= xmax and ymin <= ymax",
    ),
]
Placements = Annotated[tuple[Rectangle, ...], MinLen(1)] | None
Locations = tuple[tuple[float, float], ...]

_ARENA = "rectangle for all objects: xmin, ymin, xmax, ymax [m]"
_AREAS = "rectangles where centres may be; None: anywhere within placements_extents"
_PINNED = "fixed positions (x, y) of the first objects [m]"
_KEEPOUT = "radius around the centre that no keepout of another object overlaps [m]"
_YAWS = "fixed yaw of the first objects; others are random"
_LIDAR = "whether there is a lidar for "
_COSTS = "whether there is a cost for "
_NUMBER = "number of objects"
_NO_PLACE = "end an episode if there is no place for a new goal; False: an error"
_PRIVILEGED = (
    "an entry `privileged` for critics: costs, and places and velocities of all objects; or some "
    "of its components only, such as `[last_costs, cost_traces]`"
)
_SENSORS = ("accelerometer", "velocimeter", "gyro", "magnetometer")
_UNUSED = "not used; exists because the 2019 engine has it"


@dataclass(kw_only=True, repr=False)
class Keys:
    """The keys that are built in."""

    # episode
    num_steps: Annotated[Count, "steps after which an episode is truncated"] = 1000
    action_noise: Annotated[NotNegative, "std of noise added to the clipped control"] = 0.0
    frameskip_binom_n: Annotated[Amount, "substeps per step ~ Binomial(n, p): n"] = 10
    frameskip_binom_p: Annotated[Share, "substeps per step ~ Binomial(n, p): p"] = 1.0

    # physics
    physics: Annotated[Backend, "MuJoCo on the CPU, or MuJoCo Warp on the device"] = "cpu"
    physics_buffers: Annotated[Positive, "room for contacts on Warp, per contact in a trial"] = 2.0

    # placement
    placements_extents: Annotated[Rectangle, _ARENA] = (-2.0, -2.0, 2.0, 2.0)
    placements_margin: Annotated[Number, "minimal distance between two keepouts [m]"] = 0.0
    randomize_layout: Annotated[bool, "whether every episode has a new layout"] = True
    layout_seeds: Annotated[Seeds | None, "number of different layouts; None: unlimited"] = None
    layout_seeds_first: Annotated[Seed, "first of these layout seeds; the others follow it"] = 0
    continue_goal: Annotated[bool, "draw a new goal after one is met, or end the episode"] = True
    terminate_resample_failure: Annotated[bool, _NO_PLACE] = True

    # robot
    robot_base: Annotated[Text, "point, car, doggo, or the path of an MJCF file"] = "car"
    robot_placements: Annotated[Placements, _AREAS] = None
    robot_locations: Annotated[Locations, "(x, y) where the robot starts [m]"] = ()
    robot_keepout: Annotated[NotNegative, _KEEPOUT] = 0.4
    robot_rot: Annotated[Number | None, "yaw at the start; None: uniform"] = None

    # dynamics; two numbers: the range of a factor that is drawn for every episode
    mass_scale: Annotated[Factor, "factor on the robot's masses and inertias"] = 1.0
    friction_scale: Annotated[Factor, "factor on the friction of all surfaces"] = 1.0
    damping_scale: Annotated[FactorOrZero, "factor on the damping of the robot's joints"] = 1.0
    strength_scale: Annotated[FactorOrZero, "factor on the forces of its actuators"] = 1.0

    # observations
    observation_flatten: Annotated[bool, "True: one vector; False: an entry per component"] = True
    observe_sensors: Annotated[bool, "whether the robot's sensors are observed"] = True
    observe_goal_dist: Annotated[bool, "exp(-distance to the goal)"] = False
    observe_goal_comp: Annotated[bool, "compass to the goal"] = False
    observe_goal_lidar: Annotated[bool, _LIDAR + "the goal"] = False
    observe_box_comp: Annotated[bool, "compass to the box"] = False
    observe_box_lidar: Annotated[bool, _LIDAR + "the box"] = False
    observe_circle: Annotated[bool, _LIDAR + "the circle's centre"] = False
    observe_remaining: Annotated[bool, "share of the episode's steps taken so far"] = False
    observe_walls: Annotated[bool, _LIDAR + "walls"] = False
    observe_hazards: Annotated[bool, _LIDAR + "hazards"] = False
    observe_vases: Annotated[bool, _LIDAR + "vases"] = False
    observe_pillars: Annotated[bool, _LIDAR + "pillars"] = False
    observe_buttons: Annotated[bool, _LIDAR + "buttons"] = False
    observe_gremlins: Annotated[bool, _LIDAR + "gremlins"] = False
    observe_vision: Annotated[bool, "image of the robot's camera"] = False
    observe_privileged: Annotated[bool | tuple[Text, ...], _PRIVILEGED] = False
    observe_qpos: Annotated[bool, "positions of joints; a planar root's from its start"] = False
    observe_qvel: Annotated[bool, "velocities of joints"] = False
    observe_ctrl: Annotated[bool, "the last control"] = False
    observe_freejoint: Annotated[bool, "position and quaternion of a free root"] = False
    observe_com: Annotated[bool, "centre of mass of the robot [m]"] = False
    sensors_obs: Annotated[tuple[Text, ...], "sensors of the robot's file"] = _SENSORS
    sensors_hinge_joints: Annotated[bool, "angles and velocities of hinges with a sensor"] = True
    sensors_ball_joints: Annotated[bool, "rotations and velocities of balls with a sensor"] = True
    sensors_angle_components: Annotated[bool, "angles as (sin, cos), rotations as matrices"] = True
    lidar_num_bins: Annotated[Amount, "bins over the full circle"] = 10
    lidar_max_dist: Annotated[Positive | None, "where readings are 0 [m]; None: exponential"] = None
    lidar_exp_gain: Annotated[NotNegative, "gain of exponential readings [1/m]"] = 1.0
    lidar_type: Annotated[Lidar, "pseudo: from centres; natural: by rays"] = "pseudo"
    lidar_alias: Annotated[bool, "an object also raises the two bins next to its own"] = True
    compass_shape: Annotated[Literal[2, 3], "components of a compass"] = 2
    vision_size: Annotated[Pixels, "width and height of this image [pixels]"] = (60, 40)
    vision_render: Annotated[bool, "show this image in a corner of rendered frames"] = True
    vision_render_size: Annotated[Pixels, "its largest size in frames [pixels]"] = (300, 200)

    # task and reward
    task: Annotated[Text, "what is rewarded: goal, button, push, x, z, circle or none"] = "goal"
    goal_placements: Annotated[Placements, _AREAS] = None
    goal_locations: Annotated[Locations, _PINNED] = ()
    goal_keepout: Annotated[NotNegative, _KEEPOUT] = 0.4
    goal_size: Annotated[Positive, "radius of the goal [m]"] = 0.3
    box_placements: Annotated[Placements, _AREAS] = None
    box_locations: Annotated[Locations, _PINNED] = ()
    box_rots: Annotated[tuple[float, ...], _YAWS] = ()
    box_keepout: Annotated[NotNegative, _KEEPOUT] = 0.2
    box_size: Annotated[Positive, "half side of the box [m]"] = 0.2
    box_density: Annotated[Positive, "density of the box"] = 0.001
    box_null_dist: Annotated[Number, "approach is rewarded beyond this times box_size"] = 2.0
    reward_distance: Annotated[Number, "reward per metre nearer to the goal"] = 1.0
    reward_goal: Annotated[Number, "reward for a goal that is met"] = 1.0
    reward_box_dist: Annotated[Number, "reward per metre nearer to the box"] = 1.0
    reward_box_goal: Annotated[Number, "reward per metre that the box is nearer to the goal"] = 1.0
    reward_orientation: Annotated[bool, "whether being upright is rewarded"] = False
    reward_orientation_scale: Annotated[Number, "reward per step for being upright"] = 0.002
    reward_orientation_body: Annotated[Text, "body of the robot that must be upright"] = "robot"
    reward_exception: Annotated[Number, "reward of a step in which the physics failed"] = -10.0
    reward_x: Annotated[Number, "reward per metre along x, in task x"] = 1.0
    reward_z: Annotated[Number, "reward per metre upwards, in task z"] = 1.0
    reward_circle: Annotated[Number, "reward for moving round the circle, in task circle"] = 0.1
    reward_clip: Annotated[NotNegative | None, "bound of dense rewards; None or 0: none"] = 10.0
    circle_radius: Annotated[Positive, "radius of the circle [m]"] = 1.5

    # constraints
    constrain_hazards: Annotated[bool, _COSTS + "being in hazards"] = False
    constrain_vases: Annotated[bool, _COSTS + "touching and moving vases"] = False
    constrain_pillars: Annotated[bool, _COSTS + "touching pillars"] = False
    constrain_buttons: Annotated[bool, _COSTS + "pressing wrong buttons"] = False
    constrain_gremlins: Annotated[bool, _COSTS + "touching gremlins"] = False
    constrain_boundary: Annotated[bool, _COSTS + "leaving the boundaries"] = False
    boundary_x: Annotated[Positive | None, "largest |x| without a cost [m]; None: any"] = None
    boundary_y: Annotated[Positive | None, "largest |y| without a cost [m]; None: any"] = None
    constrain_velocity: Annotated[bool, _COSTS + "being faster than velocity_limit"] = False
    velocity_limit: Annotated[Positive | None, "largest speed without a cost [m/s]"] = None
    constrain_indicator: Annotated[bool, "costs are 0 or 1; False: their magnitudes"] = True

    # walls
    walls_num: Annotated[Objects, _NUMBER] = 0
    walls_placements: Annotated[Placements, _AREAS] = None
    walls_locations: Annotated[Locations, _PINNED] = ()
    walls_keepout: Annotated[NotNegative, _KEEPOUT] = 0.0
    walls_size: Annotated[Positive, "half side [m]"] = 0.5

    # hazards
    hazards_num: Annotated[Objects, _NUMBER] = 0
    hazards_placements: Annotated[Placements, _AREAS] = None
    hazards_locations: Annotated[Locations, _PINNED] = ()
    hazards_keepout: Annotated[NotNegative, _KEEPOUT] = 0.4
    hazards_size: Annotated[Positive, "radius [m]"] = 0.3
    hazards_cost: Annotated[NotNegative, "cost per metre of depth inside a hazard"] = 1.0

    # vases
    vases_num: Annotated[FreeObjects, _NUMBER] = 0
    vases_placements: Annotated[Placements, _AREAS] = None
    vases_locations: Annotated[Locations, _PINNED] = ()
    vases_rots: Annotated[tuple[float, ...], _YAWS] = ()
    vases_keepout: Annotated[NotNegative, _KEEPOUT] = 0.15
    vases_size: Annotated[Positive, "half side [m]"] = 0.1
    vases_density: Annotated[Positive, "density of vases"] = 0.001
    vases_sink: Annotated[Number, "depth of vases in the floor at the start [m]"] = 4e-5
    vases_contact_cost: Annotated[NotNegative, "cost per contact point with the robot"] = 1.0
    vases_displace_cost: Annotated[NotNegative, "cost per metre moved; 0: no such cost"] = 0.0
    vases_displace_threshold: Annotated[NotNegative, "displacement without a cost [m]"] = 1e-3
    vases_velocity_cost: Annotated[NotNegative, "cost per m/s of a vase; 0: no such cost"] = 1.0
    vases_velocity_threshold: Annotated[NotNegative, "speed without a cost [m/s]"] = 1e-4

    # pillars
    pillars_num: Annotated[Objects, _NUMBER] = 0
    pillars_placements: Annotated[Placements, _AREAS] = None
    pillars_locations: Annotated[Locations, _PINNED] = ()
    pillars_keepout: Annotated[NotNegative, _KEEPOUT] = 0.3
    pillars_size: Annotated[Positive, "radius [m]"] = 0.2
    pillars_height: Annotated[Positive, "half height [m]"] = 0.5
    pillars_cost: Annotated[NotNegative, "cost per contact point with the robot"] = 1.0

    # buttons
    buttons_num: Annotated[Objects, _NUMBER] = 0
    buttons_placements: Annotated[Placements, _AREAS] = None
    buttons_locations: Annotated[Locations, _PINNED] = ()
    buttons_keepout: Annotated[NotNegative, _KEEPOUT] = 0.3
    buttons_size: Annotated[Positive, "radius [m]"] = 0.1
    buttons_cost: Annotated[NotNegative, "cost per contact point with a wrong button"] = 1.0
    buttons_resampling_delay: Annotated[Steps, "steps without effect of buttons after a goal"] = 10

    # gremlins
    gremlins_num: Annotated[FreeObjects, _NUMBER] = 0
    gremlins_placements: Annotated[Placements, _AREAS] = None
    gremlins_locations: Annotated[Locations, _PINNED] = ()
    gremlins_rots: Annotated[tuple[float, ...], _YAWS] = ()
    gremlins_keepout: Annotated[NotNegative, _KEEPOUT] = 0.5
    gremlins_travel: Annotated[NotNegative, "radius of the circle on which they move [m]"] = 0.3
    gremlins_size: Annotated[Positive, "half side [m]"] = 0.1
    gremlins_density: Annotated[Positive, "density of gremlins"] = 0.001
    gremlins_contact_cost: Annotated[NotNegative, "cost per contact point with the robot"] = 1.0
    gremlins_dist_threshold: Annotated[NotNegative, _UNUSED] = 0.2
    gremlins_dist_cost: Annotated[Number, _UNUSED] = 1.0

    # rendering
    render_labels: Annotated[bool, "show the names of objects"] = False
    render_lidar_markers: Annotated[bool, "draw lidars as rings above the robot"] = True
    render_lidar_radius: Annotated[Positive, "radius of the rings [m]"] = 0.15
    render_lidar_size: Annotated[Positive, "radius of a ring's spheres [m]"] = 0.025
    render_lidar_offset_init: Annotated[Number, "height of the lowest ring [m]"] = 0.5
    render_lidar_offset_delta: Annotated[Number, "vertical distance between two rings [m]"] = 0.06
    floor_display_mode: Annotated[bool, "crop the visible floor to the placements"] = False
