"""The three robots of section 4 as MJCF fragments, written out from the table of numbers."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Robot:
    """The parts of a world's MJCF that belong to a robot.

    Attributes:
        timestep: length of a physics substep [s].
        default: inside of `<default>`; the elements of the world inherit it.
        height: of the robot's origin at the reset [m].
        body: inside of `<body name="robot">`.
        sensor: inside of `<sensor>`, beyond the sensors that every robot has.
        actuator: inside of `<actuator>`.
        angle: unit of the angles in `body`.
    """

    timestep: float
    height: float
    default: str
    body: str
    sensor: str
    actuator: str
    angle: str = "radian"


# Sensors of every robot, at the site in the origin of the body "robot".
COMMON_SENSORS = """
<accelerometer name="accelerometer" site="robot"/>
<velocimeter name="velocimeter" site="robot"/>
<gyro name="gyro" site="robot"/>
<magnetometer name="magnetometer" site="robot"/>
"""

POINT = Robot(
    timestep=0.002,
    height=0.1,
    default="""
<geom condim="6" density="1"/>
<joint damping="0.001"/>
<motor ctrlrange="-1 1" forcerange="-0.05 0.05"/>
<velocity ctrlrange="-1 1" forcerange="-0.05 0.05"/>
""",
    body="""
<joint name="x" type="slide" axis="1 0 0" damping="0.01"/>
<joint name="y" type="slide" axis="0 1 0" damping="0.01"/>
<joint name="z" type="hinge" axis="0 0 1" damping="0.005"/>
<geom type="sphere" size="0.1" friction="1 0.01 0.01"/>
<geom type="box" size="0.05 0.05 0.05" pos="0.1 0 0"/>
<site name="robot"/>
""",
    sensor="",
    actuator="""
<motor name="forward" site="robot" gear="0.3 0 0 0 0 0"/>
<velocity name="turn" jointinparent="z" gear="0.3" kv="1"/>
""",
)

CAR = Robot(
    timestep=0.004,
    height=0.1,
    default="""
<geom condim="6" density="5" size="0.05"/>
<joint damping="0.001"/>
<motor ctrlrange="-1 1" forcerange="-0.02 0.02"/>
""",
    body="""
<joint name="robot" type="free" damping="0"/>
<geom name="chassis" type="box" size="0.1 0.1 0.05"/>
<geom name="back_bumper" type="box" pos="0 0.15 0" size="0.1 0.01 0.05"/>
<geom name="back_connector" type="box" pos="0 0.125 0" size="0.01 0.025 0.03"/>
<geom name="front_bumper" type="box" pos="0 -0.165 0" size="0.05 0.01 0.05"/>
<geom name="front_connector" type="box" pos="0 -0.13 0.04" size="0.05 0.03 0.01"/>
<site name="robot"/>
<body name="left" pos="-0.1 0.1 -0.05">
  <joint name="left" type="hinge" axis="1 0 0"/>
  <geom name="left" type="cylinder" size="0.05" fromto="-0.055 0 0 -0.005 0 0"/>
</body>
<body name="right" pos="0.1 0.1 -0.05">
  <joint name="right" type="hinge" axis="1 0 0"/>
  <geom name="right" type="cylinder" size="0.05" fromto="0.005 0 0 0.055 0 0"/>
</body>
<body name="rear" pos="0 -0.1 -0.05">
  <joint name="rear" type="ball"/>
  <geom name="rear" type="sphere" size="0.05"/>
</body>
""",
    sensor="""
<ballquat name="ballquat_rear" joint="rear"/>
<ballangvel name="ballangvel_rear" joint="rear"/>
""",
    actuator="""
<motor name="left" jointinparent="left" gear="1"/>
<motor name="right" jointinparent="right" gear="1"/>
""",
)


def _leg(number: int, side: int, end: int) -> str:
    """One leg of the Doggo with its hip strut.

    The strut is fixed to the torso, yet a body of its own: contacts are softened by the inertia
    of the body that a geom belongs to, so a strut on the floor tells the two apart.

    Args:
        number: 1 to 4, in the names of joints and sites.
        side: +1 on the y+ side, -1 on the y- side (the table's sigma).
        end: +1 on the front, -1 on the rear half (the table's xi).
    """
    hip_range, hip_rest = ("-75 15", -10) if end > 0 else ("0 135", 0)
    x, y, y_ankle = 0.2 * end, 0.1 * side, 0.0566 * side
    foot = f"-0.1176 {-0.0679 * side} -0.1"
    return f"""
<body name="hip_{number}">
  <geom name="hip_{number}" type="capsule" fromto="{0.1 * end} 0 0 {x} {y} 0"/>
  <body name="leg_{number}" pos="{x} {y} 0">
    <joint name="hip_{number}_z" type="hinge" axis="0 0 {side}" range="-10 30" springref="0"/>
    <joint name="hip_{number}_y" type="hinge" axis="0 1 0" range="{hip_range}"
           springref="{hip_rest}"/>
    <geom name="thigh_{number}" type="capsule" fromto="0 0 0 0.098 {y_ankle} -0.05"/>
    <body name="ankle_{number}" pos="0.098 {y_ankle} -0.05">
      <joint name="ankle_{number}" type="hinge" axis="{-0.5 * side} 0.866 0" range="-75 0"
             springref="-20"/>
      <geom name="shank_{number}" type="capsule" fromto="0 0 0 {foot}"/>
      <site name="ankle_{number}a" type="sphere" size="0.036" pos="0 0 0"/>
      <site name="ankle_{number}b" type="sphere" size="0.036" pos="{foot}"/>
    </body>
  </body>
</body>
"""


_LEGS = (1, 2, 3, 4)
_LEG_JOINTS = (
    *(f"hip_{leg}_z" for leg in _LEGS),
    *(f"hip_{leg}_y" for leg in _LEGS),
    *(f"ankle_{leg}" for leg in _LEGS),
)

# The golden joint order (legs 1 and 4, waist, legs 2 and 3) puts the rear half behind leg 4.
DOGGO = Robot(
    timestep=0.01,
    height=0.22,
    angle="degree",
    default="""
<joint limited="true" stiffness="0.01"/>
<geom condim="6" type="capsule" size="0.032" density="5"/>
<motor ctrlrange="-1 1" gear="0.0125"/>
""",
    body=f"""
<joint name="robot" type="free" limited="false" stiffness="0"/>
<site name="robot"/>
<geom name="front" type="cylinder" size="0.075" fromto="0 0 0 0.2 0 0" density="0.5"/>
{_leg(1, +1, +1)}
{_leg(4, -1, +1)}
<body name="rear" pos="0 0 0">
  <joint name="waist_x" type="hinge" axis="1 0 0" range="-30 30" springref="0"/>
  <geom name="rear" type="cylinder" size="0.075" fromto="-0.2 0 0 0 0 0" density="0.5"/>
  {_leg(2, +1, -1)}
  {_leg(3, -1, -1)}
</body>
""",
    sensor="".join(
        f'<touch name="touch_ankle_{leg}{end}" site="ankle_{leg}{end}"/>'
        for leg in _LEGS
        for end in "ab"
    )
    + "".join(
        f'<jointpos name="jointpos_{joint}" joint="{joint}"/>'
        f'<jointvel name="jointvel_{joint}" joint="{joint}"/>'
        for joint in _LEG_JOINTS
    ),
    actuator="".join(f'<motor name="{joint}" joint="{joint}"/>' for joint in _LEG_JOINTS),
)

ROBOTS = {"point": POINT, "car": CAR, "doggo": DOGGO}
