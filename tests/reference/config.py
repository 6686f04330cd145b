"""The configuration vocabulary: the keys the reference reads, with their defaults (section 1)."""

from __future__ import annotations

import difflib
from typing import Any

from .robots import ROBOTS

DEFAULTS: dict[str, Any] = {
    # Episode.
    "num_steps": 1000,
    "action_noise": 0.0,
    "frameskip_binom_n": 10,
    "frameskip_binom_p": 1.0,
    "continue_goal": True,
    # Robot and its sensors.
    "robot_base": "car",
    "sensors_obs": ["accelerometer", "velocimeter", "gyro", "magnetometer"],
    "sensors_hinge_joints": True,
    "sensors_ball_joints": True,
    "sensors_angle_components": True,
    # What is observed.
    "observe_sensors": True,
    "observe_goal_dist": False,
    "observe_goal_comp": False,
    "observe_goal_lidar": False,
    "observe_box_comp": False,
    "observe_box_lidar": False,
    "observe_circle": False,
    "observe_remaining": False,
    "observe_walls": False,
    "observe_hazards": False,
    "observe_vases": False,
    "observe_pillars": False,
    "observe_buttons": False,
    "observe_gremlins": False,
    "observe_vision": False,
    "observe_qpos": False,
    "observe_qvel": False,
    "observe_ctrl": False,
    "observe_freejoint": False,
    "observe_com": False,
    "lidar_num_bins": 10,
    "lidar_max_dist": None,
    "lidar_exp_gain": 1.0,
    "lidar_type": "pseudo",
    "lidar_alias": True,
    "compass_shape": 2,
    # Task and reward.
    "task": "goal",
    "goal_size": 0.3,
    "box_size": 0.2,
    "box_density": 0.001,
    "box_null_dist": 2,
    "circle_radius": 1.5,
    "reward_distance": 1.0,
    "reward_goal": 1.0,
    "reward_box_dist": 1.0,
    "reward_box_goal": 1.0,
    "reward_orientation": False,
    "reward_orientation_scale": 0.002,
    "reward_orientation_body": "robot",
    "reward_exception": -10.0,
    "reward_x": 1.0,
    "reward_z": 1.0,
    "reward_circle": 0.1,
    "reward_clip": 10,
    # Elements and their costs.
    "constrain_hazards": False,
    "constrain_vases": False,
    "constrain_pillars": False,
    "constrain_buttons": False,
    "constrain_gremlins": False,
    "constrain_indicator": True,
    "walls_num": 0,
    "walls_size": 0.5,
    "hazards_num": 0,
    "hazards_size": 0.3,
    "hazards_cost": 1.0,
    "vases_num": 0,
    "vases_size": 0.1,
    "vases_density": 0.001,
    "vases_sink": 4e-5,
    "vases_contact_cost": 1.0,
    "vases_displace_cost": 0.0,
    "vases_displace_threshold": 1e-3,
    "vases_velocity_cost": 1.0,
    "vases_velocity_threshold": 1e-4,
    "pillars_num": 0,
    "pillars_size": 0.2,
    "pillars_height": 0.5,
    "pillars_cost": 1.0,
    "buttons_num": 0,
    "buttons_size": 0.1,
    "buttons_cost": 1.0,
    "buttons_resampling_delay": 10,
    "gremlins_num": 0,
    "gremlins_travel": 0.3,
    "gremlins_size": 0.1,
    "gremlins_density": 0.001,
    "gremlins_contact_cost": 1.0,
}

_PLACED = ("robot", "goal", "box", "walls", "hazards", "vases", "pillars", "buttons", "gremlins")

# Known keys that concern drawing a layout or a picture, which the caller does: read over.
IGNORED = {
    *(f"{kind}_{suffix}" for kind in _PLACED for suffix in ("placements", "locations", "keepout")),
    *("placements_extents", "placements_margin", "randomize_layout", "terminate_resample_failure"),
    *("layout_seeds", "layout_seeds_first", "physics", "physics_buffers"),
    *("mass_scale", "friction_scale", "damping_scale", "strength_scale"),
    *("constrain_boundary", "boundary_x", "boundary_y", "constrain_velocity", "velocity_limit"),
    *("robot_rot", "vases_rots", "gremlins_rots", "box_rots", "gremlins_dist_threshold"),
    *("gremlins_dist_cost", "observation_flatten", "vision_size", "vision_render"),
    *("vision_render_size", "render_labels", "render_lidar_markers", "render_lidar_radius"),
    *("render_lidar_size", "render_lidar_offset_init", "render_lidar_offset_delta"),
    "floor_display_mode",
}


def complete(config: dict[str, Any]) -> dict[str, Any]:
    """Returns `config` with defaults filled in.

    Args:
        config: flat configuration in the vocabulary of section 1.

    Returns:
        All keys of `DEFAULTS`, with the values of `config` where it has them.

    Raises:
        ValueError: for a key outside the vocabulary, or for what the reference cannot do.
    """
    for key in config:
        if key not in DEFAULTS and key not in IGNORED:
            near = difflib.get_close_matches(key, [*DEFAULTS, *IGNORED], n=1)
            raise ValueError(f"unknown configuration key {key!r}; nearest known: {near}")
    full = {**DEFAULTS, **{k: v for k, v in config.items() if k in DEFAULTS}}
    if full["robot_base"] not in ROBOTS:
        raise ValueError(f"robot_base {full['robot_base']!r}: the reference has {[*ROBOTS]}")
    if full["observe_vision"]:
        raise ValueError("the reference does not render: set observe_vision to False")
    return full
