"""The configuration vocabulary of the environment-builder: names, defaults, meaning, validation.

One environment is one flat, frozen `SafetyGymConfig`. Keys, defaults and meaning are those of the
2019 Safety Gym engine (paper, section 4.1), so that its dictionaries can be used as they are;
`layout_seeds`, `layout_seeds_first`, `vases_rots`, `gremlins_rots` and `box_rots` are additions.
Lengths are metres, angles radians, times environment steps unless said otherwise.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

from safe_rl.envs.errors import ConfigError, nearest
from safe_rl.envs.safety_gym.records.values import coerce

Rectangle = tuple[float, float, float, float]
Point2 = tuple[float, float]
Placements = tuple[Rectangle, ...] | None
Locations = tuple[Point2, ...]


@dataclass(frozen=True, kw_only=True, eq=False)
class SafetyGymConfig:
    """Everything that defines one environment.

    Keys that `safe_rl.envs.extending` registered are fields like the others. A record knows types
    and ranges; whether there is such a task or robot, and what keys need of one another, is checked
    where an environment is made or stored, see `suite.resolve`.

    Raises:
        ConfigError: if a value has the wrong type or is out of range.

    Examples:
        >>> config = SafetyGymConfig.from_dict({"task": "goal", "hazards_num": 3})
        >>> config.replace(hazards_num=5).hazards_num
        5
    """

    # episode
    num_steps: int = 1000
    action_noise: float = 0.0  # std of Gaussian noise added to the clipped control
    frameskip_binom_n: int = 10  # substeps per step ~ Binomial(n, p)
    frameskip_binom_p: float = 1.0

    # placement
    placements_extents: Rectangle = (-2.0, -2.0, 2.0, 2.0)  # xmin, ymin, xmax, ymax
    placements_margin: float = 0.0
    randomize_layout: bool = True
    layout_seeds: int | None = None  # number of different layouts; None: unlimited
    layout_seeds_first: int = 0  # they are first, first + 1, …; disjoint ranges share none
    continue_goal: bool = True
    terminate_resample_failure: bool = True

    # robot: point, car, doggo, or the path of an MJCF file
    robot_base: str = "car"
    robot_placements: Placements = None
    robot_locations: Locations = ()
    robot_keepout: float = 0.4
    robot_rot: float | None = None  # None: uniform

    # observations
    observation_flatten: bool = True
    observe_sensors: bool = True
    observe_goal_dist: bool = False
    observe_goal_comp: bool = False
    observe_goal_lidar: bool = False
    observe_box_comp: bool = False
    observe_box_lidar: bool = False
    observe_circle: bool = False
    observe_remaining: bool = False
    observe_walls: bool = False
    observe_hazards: bool = False
    observe_vases: bool = False
    observe_pillars: bool = False
    observe_buttons: bool = False
    observe_gremlins: bool = False
    observe_vision: bool = False
    observe_qpos: bool = False
    observe_qvel: bool = False
    observe_ctrl: bool = False
    observe_freejoint: bool = False
    observe_com: bool = False
    sensors_obs: tuple[str, ...] = ("accelerometer", "velocimeter", "gyro", "magnetometer")
    sensors_hinge_joints: bool = True
    sensors_ball_joints: bool = True
    sensors_angle_components: bool = True  # angles as (sin, cos), quaternions as matrices
    lidar_num_bins: int = 10
    lidar_max_dist: float | None = None  # None: exponential readings
    lidar_exp_gain: float = 1.0
    lidar_type: str = "pseudo"  # or natural
    lidar_alias: bool = True
    compass_shape: int = 2
    vision_size: tuple[int, int] = (60, 40)  # width, height
    vision_render: bool = True
    vision_render_size: tuple[int, int] = (300, 200)

    # task and reward
    task: str = "goal"
    goal_placements: Placements = None
    goal_locations: Locations = ()
    goal_keepout: float = 0.4
    goal_size: float = 0.3
    box_placements: Placements = None
    box_locations: Locations = ()
    box_rots: tuple[float, ...] = ()
    box_keepout: float = 0.2
    box_size: float = 0.2  # half side
    box_density: float = 0.001
    box_null_dist: float = 2.0  # in units of box_size
    reward_distance: float = 1.0
    reward_goal: float = 1.0
    reward_box_dist: float = 1.0
    reward_box_goal: float = 1.0
    reward_orientation: bool = False
    reward_orientation_scale: float = 0.002
    reward_orientation_body: str = "robot"
    reward_exception: float = -10.0
    reward_x: float = 1.0
    reward_z: float = 1.0
    reward_circle: float = 0.1
    reward_clip: float | None = 10.0
    circle_radius: float = 1.5

    # constraints
    constrain_hazards: bool = False
    constrain_vases: bool = False
    constrain_pillars: bool = False
    constrain_buttons: bool = False
    constrain_gremlins: bool = False
    constrain_indicator: bool = True

    # walls
    walls_num: int = 0
    walls_placements: Placements = None
    walls_locations: Locations = ()
    walls_keepout: float = 0.0
    walls_size: float = 0.5  # half side

    # hazards
    hazards_num: int = 0
    hazards_placements: Placements = None
    hazards_locations: Locations = ()
    hazards_keepout: float = 0.4
    hazards_size: float = 0.3  # radius
    hazards_cost: float = 1.0

    # vases
    vases_num: int = 0
    vases_placements: Placements = None
    vases_locations: Locations = ()
    vases_rots: tuple[float, ...] = ()
    vases_keepout: float = 0.15
    vases_size: float = 0.1  # half side
    vases_density: float = 0.001
    vases_sink: float = 4e-5
    vases_contact_cost: float = 1.0
    vases_displace_cost: float = 0.0
    vases_displace_threshold: float = 1e-3
    vases_velocity_cost: float = 1.0
    vases_velocity_threshold: float = 1e-4

    # pillars
    pillars_num: int = 0
    pillars_placements: Placements = None
    pillars_locations: Locations = ()
    pillars_keepout: float = 0.3
    pillars_size: float = 0.2  # radius
    pillars_height: float = 0.5  # half height
    pillars_cost: float = 1.0

    # buttons
    buttons_num: int = 0
    buttons_placements: Placements = None
    buttons_locations: Locations = ()
    buttons_keepout: float = 0.3
    buttons_size: float = 0.1  # radius
    buttons_cost: float = 1.0
    buttons_resampling_delay: int = 10

    # gremlins
    gremlins_num: int = 0
    gremlins_placements: Placements = None
    gremlins_locations: Locations = ()
    gremlins_rots: tuple[float, ...] = ()
    gremlins_keepout: float = 0.5
    gremlins_travel: float = 0.3  # radius of the circle they run
    gremlins_size: float = 0.1  # half side
    gremlins_density: float = 0.001
    gremlins_contact_cost: float = 1.0
    gremlins_dist_threshold: float = 0.2  # part of the vocabulary; no cost reads it
    gremlins_dist_cost: float = 1.0  # part of the vocabulary; no cost reads it

    # rendering
    render_labels: bool = False
    render_lidar_markers: bool = True
    render_lidar_radius: float = 0.15
    render_lidar_size: float = 0.025
    render_lidar_offset_init: float = 0.5
    render_lidar_offset_delta: float = 0.06
    floor_display_mode: bool = False

    def __new__(cls, **values: Any) -> SafetyGymConfig:
        """Make an object of the present vocabulary, registered keys included."""
        return object.__new__(_vocabulary)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle as values: the class with registered keys has no name to be found by."""
        return SafetyGymConfig.from_dict, (self.to_dict(),)

    def __eq__(self, other: object) -> bool:
        """Compare values: an object made before a key was registered has its default."""
        return isinstance(other, SafetyGymConfig) and self.to_dict() == other.to_dict()

    def __hash__(self) -> int:
        """Hash what never changes, the built-in keys."""
        return hash(tuple(getattr(self, key) for key in _BUILT_IN))

    def __post_init__(self) -> None:
        for field in dataclasses.fields(self):
            value = coerce(field.name, str(field.type), getattr(self, field.name))
            object.__setattr__(self, field.name, value)

    @classmethod
    def from_dict(cls, values: Mapping[str, Any]) -> SafetyGymConfig:
        """Build a configuration from a flat mapping.

        Raises:
            ConfigError: for a key that is not in the vocabulary (the nearest one is named), a
                wrong type or a value out of range.
        """
        known = known_keys()
        for key in values:
            if key not in known:
                raise ConfigError(
                    f"Unknown configuration key '{key}'.{nearest(str(key), known)} "
                    "SafetyGymConfig lists every key with its default."
                )
        return SafetyGymConfig(**values)

    def replace(self, **changes: Any) -> SafetyGymConfig:
        """Return a copy with some keys changed, checked like a new one."""
        return self.from_dict({**self.to_dict(), **changes})

    def to_dict(self) -> dict[str, Any]:
        """Return the flat mapping of every key, as `from_dict` takes it."""
        return {key: getattr(self, key) for key in known_keys()}


class Key(NamedTuple):
    """A key of the vocabulary: its default, and its type as `SafetyGymConfig` writes it."""

    default: Any
    annotation: str


_BUILT_IN = frozenset(field.name for field in dataclasses.fields(SafetyGymConfig))
_registered: dict[str, Key] = {}
_vocabulary: type[SafetyGymConfig] = SafetyGymConfig


def known_keys() -> list[str]:
    """Return the names of all keys, registered ones included."""
    return [field.name for field in dataclasses.fields(_vocabulary)]


def registered_keys() -> dict[str, Key]:
    """Return the keys that are not built in."""
    return dict(_registered)


def set_registered_keys(keys: Mapping[str, Key]) -> None:
    """Let the vocabulary consist of the built-in keys and these.

    Raises:
        ConfigError: if a key is built in, or a default is not of its type.
    """
    global _vocabulary
    for name, key in keys.items():
        if name in _BUILT_IN:
            raise ConfigError(f"The configuration key '{name}' is taken: choose another name.")
        coerce(name, key.annotation, key.default)
    for name in _registered:
        delattr(SafetyGymConfig, name)
    # Configurations that were made earlier have the default of what they don't know.
    for name, key in keys.items():
        setattr(SafetyGymConfig, name, key.default)
    _registered.clear()
    _registered.update(keys)
    _vocabulary = dataclasses.make_dataclass(
        "SafetyGymConfig",
        [(name, key.annotation, key.default) for name, key in keys.items()],
        bases=(SafetyGymConfig,),
        namespace={"__module__": __name__, "__doc__": SafetyGymConfig.__doc__},
        frozen=True,
        kw_only=True,
        eq=False,
    )
