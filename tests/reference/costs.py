"""Costs of section 7, one object and one contact at a time."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .reference import ReferenceWorld


def robot_contacts(world: ReferenceWorld, body: str) -> int:
    """Number of contact points between any geom of the robot and a body."""
    model = world.model
    other, robot = model.body(body).id, model.body("robot").id
    points = 0
    for contact in world.data.contact:
        bodies = [model.geom_bodyid[geom] for geom in contact.geom]
        if other in bodies and any(model.body_rootid[b] == robot for b in bodies):
            points += 1
    return points


def costs(world: ReferenceWorld) -> dict[str, float]:
    """`cost_<kind>` of every constrained kind, and their sum `cost`, in the current state."""
    config = world.config
    found = {}
    if config["constrain_hazards"]:
        found["cost_hazards"] = _hazards(world)
    if config["constrain_vases"]:
        found |= _vases(world)
    if config["constrain_pillars"]:
        points = sum(robot_contacts(world, f"pillar{i}") for i in range(world.count("pillars")))
        found["cost_pillars"] = config["pillars_cost"] * points
    if config["constrain_buttons"]:
        found["cost_buttons"] = _buttons(world)
    if config["constrain_gremlins"]:
        points = sum(robot_contacts(world, f"gremlin{i}") for i in range(world.count("gremlins")))
        found["cost_gremlins"] = config["gremlins_contact_cost"] * points
    found["cost"] = sum(found.values(), 0.0)
    if config["constrain_indicator"]:
        found = {key: float(value > 0) for key, value in found.items()}
    return {key: float(value) for key, value in found.items()}


def _hazards(world: ReferenceWorld) -> float:
    size, factor = world.config["hazards_size"], world.config["hazards_cost"]
    robot = world.position("robot")
    cost = 0.0
    for i in range(world.count("hazards")):
        distance = np.linalg.norm((world.position(f"hazard{i}") - robot)[:2])
        if distance <= size:
            cost += factor * (size - distance)
    return cost


def _buttons(world: ReferenceWorld) -> float:
    """Wrong buttons cost while buttons are live, judged by the timer before it counts down."""
    if world.buttons_timer != 0:
        return 0.0
    wrong = [i for i in range(world.count("buttons")) if i != world.goal_button]
    return world.config["buttons_cost"] * sum(robot_contacts(world, f"button{i}") for i in wrong)


def _vases(world: ReferenceWorld) -> dict[str, float]:
    config = world.config
    contact = displace = velocity = 0.0
    for i in range(world.count("vases")):
        name = f"vase{i}"
        contact += config["vases_contact_cost"] * robot_contacts(world, name)
        moved = np.linalg.norm(world.position(name)[:2] - world.layout["vases"][i])
        if moved > config["vases_displace_threshold"]:
            displace += config["vases_displace_cost"] * moved
        speed = np.linalg.norm(world.velocity(name))
        if speed >= config["vases_velocity_threshold"]:
            velocity += config["vases_velocity_cost"] * speed
    found = {"cost_vases_contact": contact}
    if config["vases_displace_cost"]:
        found["cost_vases_displace"] = displace
    if config["vases_velocity_cost"]:
        found["cost_vases_velocity"] = velocity
    return found
