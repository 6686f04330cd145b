"""Rewards of section 6: dense terms are differences to the distances of the previous step."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from .costs import robot_contacts

if TYPE_CHECKING:
    from .reference import ReferenceWorld


def distance_xy(a: np.ndarray, b: np.ndarray) -> float:
    """Distance of two points in the plane [m]."""
    return float(np.hypot(a[0] - b[0], a[1] - b[1]))


def reward_distances(world: ReferenceWorld) -> dict[str, float]:
    """The distances whose decrease the task rewards [m].

    Returns:
        `goal` for goal and button (in the plane), `box` (robot to box) and `box_goal` for push
        (both in space); nothing for the other tasks.
    """
    task = world.config["task"]
    robot = world.position("robot")
    if task in ("goal", "button"):
        return {"goal": distance_xy(robot, world.goal_position())}
    if task == "push":
        box = world.position("box")
        return {
            "box": float(np.linalg.norm(robot - box)),
            "box_goal": float(np.linalg.norm(box - world.goal_position())),
        }
    return {}


def goal_achieved(world: ReferenceWorld) -> bool:
    """Whether the goal of the task is met in the current state."""
    config = world.config
    if config["task"] == "goal":
        return reward_distances(world)["goal"] <= config["goal_size"]
    if config["task"] == "push":
        return reward_distances(world)["box_goal"] <= config["goal_size"]
    if config["task"] == "button":
        return robot_contacts(world, f"button{world.goal_button}") > 0
    return False


def dense_reward(world: ReferenceWorld) -> float:
    """The reward of the step that led here, without `reward_goal`; clipped."""
    config = world.config
    before, now = world.distances, reward_distances(world)
    task = config["task"]
    reward = 0.0
    if task in ("goal", "button"):
        reward += config["reward_distance"] * (before["goal"] - now["goal"])
    elif task == "push":
        if before["box"] > config["box_null_dist"] * config["box_size"]:
            reward += config["reward_box_dist"] * (before["box"] - now["box"])
        reward += config["reward_box_goal"] * (before["box_goal"] - now["box_goal"])
    elif task == "x":
        reward += config["reward_x"] * (world.centre_of_mass() - world.com)[0]
    elif task == "z":
        reward += config["reward_z"] * (world.centre_of_mass() - world.com)[2]
    elif task == "circle":
        reward += config["reward_circle"] * _circling(world)
    if config["reward_orientation"]:
        upright = world.rotation(config["reward_orientation_body"])[2, 2]
        reward += config["reward_orientation_scale"] * upright
    if config["reward_clip"]:
        reward = float(np.clip(reward, -config["reward_clip"], config["reward_clip"]))
    return float(reward)


def _circling(world: ReferenceWorld) -> float:
    """Tangential speed [m/s], counter-clockwise, discounted by the distance from the circle."""
    x, y, _ = world.centre_of_mass()
    u, v, _ = world.velocity("robot")
    radius = np.hypot(x, y)
    return (v * x - u * y) / radius / (1 + abs(radius - world.config["circle_radius"]))
