"""Robots by the path of an MJCF file: what works, and the errors for files that do not."""

import math

import numpy as np
import pytest
import torch
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import ConfigError, SafetyGymEnv
from safe_rl.envs.extending import register_robot

pytestmark = pytest.mark.filterwarnings("ignore:The keyframes of")

# A planar disc with an arm on a hinge; the turning motor has no control range of its own.
DISC = """
<mujoco>
  <option timestep="0.004"/>
  <default><geom condim="6" density="10"/></default>
  <worldbody>
    <body name="robot" pos="0 0 0.1">
      <joint name="x" type="slide" axis="1 0 0" damping="0.1"/>
      <joint name="y" type="slide" axis="0 1 0" damping="0.1"/>
      <joint name="yaw" type="hinge" axis="0 0 1" damping="0.01"/>
      <geom type="cylinder" size="0.1 0.05"/>
      <site name="robot"/>
      <body name="arm" pos="0.1 0 0">
        <joint name="elbow" type="hinge" axis="0 1 0" range="-90 0" stiffness="0.01"/>
        <geom type="capsule" fromto="0 0 0 0.1 0 0" size="0.02"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="drive" site="robot" gear="1 0 0 0 0 0" ctrlrange="-0.5 2"/>
    <motor name="turn" joint="yaw" gear="0.1"/>
    <motor name="lift" joint="elbow" gear="0.02" ctrlrange="-1 1"/>
  </actuator>
  <sensor>
    <velocimeter name="speed" site="robot"/>
    <gyro name="gyro" site="robot"/>
    <jointpos name="elbow_pos" joint="elbow"/>
    <jointvel name="elbow_vel" joint="elbow"/>
  </sensor>
</mujoco>
"""
# The same, free in space; its file brings a pose, a texture and more memory than it needs.
BALL = """
<mujoco>
  <size memory="200M"/>
  <worldbody>
    <body name="robot" pos="0.3 0.2 0.12">
      <freejoint/>
      <geom type="sphere" size="0.12"/>
      <site name="imu"/>
    </body>
  </worldbody>
  <actuator><general site="imu" gear="0 0 0 0 0 0.01"/></actuator>
  <sensor><gyro name="gyro" site="imu"/></sensor>
  <keyframe><key name="start" qpos="1 2 3 1 0 0 0"/></keyframe>
</mujoco>
"""
EVERYTHING = {
    **{f"{kind}_num": 1 for kind in ("hazards", "vases", "pillars", "buttons", "gremlins")},
    **{f"constrain_{kind}": True for kind in ("hazards", "vases", "pillars", "gremlins")},
    "observe_goal_lidar": True,
    "placements_extents": [-2.5, -2.5, 2.5, 2.5],
}


@pytest.fixture
def make(tmp_path):
    def build(xml: str, num_envs: int = 2, **keys) -> SafetyGymEnv:
        path = tmp_path / "robot.xml"
        path.write_text(xml)
        config = {"robot_base": str(path), "sensors_obs": ["gyro"], **keys}
        return SafetyGymEnv(config, num_envs, seed=0, num_threads=1)

    return build


@pytest.mark.parametrize(
    ("xml", "task"),
    [*((DISC, task) for task in ("goal", "push", "button", "circle")), (BALL, "goal")],
    ids=["goal", "push", "button", "circle", "free"],
)
def test_own_robots_work_in_every_task(make, xml, task):
    env = make(xml, task=task, **EVERYTHING)
    check_env_specs(env)
    rollout = env.rollout(30)
    assert not rollout["next", "cost_exception"].any()
    assert rollout["next", "observation"].isfinite().all()


@pytest.mark.parametrize(("xml", "yaw"), [(DISC, 2), (BALL, None)], ids=["planar", "free"])
def test_they_are_placed_by_their_root(make, xml, yaw):
    env = make(xml, robot_locations=[[1.5, -0.5]], robot_rot=0.9, vases_num=1)
    env.reset()
    qpos = env.get_state()["qpos"][0]
    np.testing.assert_allclose(qpos[:2], [1.5, -0.5], atol=1e-8)
    turned = qpos[yaw] if yaw else 2 * math.atan2(qpos[6], qpos[3])
    assert float(turned) == pytest.approx(0.9)
    if not yaw:
        assert float(qpos[2]) == pytest.approx(0.12)
    position = env.get_positions()["robot"][0, 0, :2]
    np.testing.assert_allclose(position, [1.5, -0.5], atol=1e-8)


def test_actions_have_the_range_of_the_actuators(make):
    env = make(DISC, observe_ctrl=True, task="none")
    low, high = env.action_spec.space.low[0], env.action_spec.space.high[0]
    assert low.tolist() == [-0.5, -1.0, -1.0]
    assert high.tolist() == [2.0, 1.0, 1.0]
    columns = env.observation_layout["ctrl"]
    for request, applied in (([9.0, 9.0, 0.5], [2.0, 1.0, 0.5]), ([-9.0, -9, 0], [-0.5, -1, 0])):
        action = torch.tensor(request).expand(2, 3)
        result = env.step(env.reset().set("action", action))["next", "observation"]
        assert result[0, columns].tolist() == applied


def _mass(env) -> float:
    return float(env._world.scene.model.body_subtreemass[1])


def test_their_sensors_are_found_by_type_and_name(make):
    env = make(DISC, sensors_obs=["speed"], observe_goal_lidar=True)
    sizes = {name: span.stop - span.start for name, span in env.observation_layout.items()}
    assert sizes == {"elbow_pos": 2, "elbow_vel": 1, "goal_lidar": 10, "speed": 3}
    without = make(DISC, sensors_obs=["speed"], sensors_hinge_joints=False)
    assert list(without.observation_layout) == ["speed"]
    listed = make(DISC, sensors_obs=["elbow_vel", "speed", "elbow_pos"], observe_goal_lidar=True)
    assert listed.observation_layout == env.observation_layout
    assert list(make(BALL).observation_layout) == ["gyro"]


def changed(xml: str, old: str, new: str) -> str:
    assert old in xml
    return xml.replace(old, new)


SLIDES = DISC[DISC.index('<joint name="x"') : DISC.index('<joint name="yaw"')]
ACTUATORS = DISC[DISC.index("<actuator>") : DISC.index("<sensor>")]
SLIDE = '<jointpos name="east" joint="x"/></sensor>'
WRONG = {
    "no XML": ("<mujoco><worldbody>", "cannot load"),
    "no robot": (changed(BALL, '"robot"', '"robto"'), "no body named 'robot'.*'robto'"),
    "a floor": (
        changed(BALL, "<worldbody>", '<worldbody><geom name="ground" type="plane" size="9 9 1"/>'),
        r"belong to no body, \['ground'\]",
    ),
    "robot inside another": (
        changed(changed(BALL, "<worldbody>", '<worldbody><body name="cart">'),
                "</worldbody>", "</body></worldbody>").replace("<freejoint/>", ""),
        "'robot' inside 'cart'",
    ),
    "a turned root": (changed(BALL, 'pos="0.3 0.2 0.12"', 'euler="90 0 0"'), "rotates its body"),
    "no actuators": (changed(DISC, ACTUATORS, ""), "no actuators"),
    "no root joint": (changed(DISC, SLIDES, ""), "free joint, or slides"),
    "another body before": (
        changed(BALL, "<worldbody>", '<worldbody><body><freejoint/><geom size="1"/></body>'),
        "put this body first",
    ),
    "a reversed control range": (changed(DISC, '"-0.5 2"', '"2 -0.5"'), "control range.*2.0, -0.5"),
    "an observed slide": (changed(DISC, "</sensor>", SLIDE), "'east' on a slide joint"),
    "a name of the world": (changed(DISC, 'name="arm"', 'name="vase0"'), "repeated name 'vase0'"),
}  # fmt: skip


@pytest.mark.parametrize(("xml", "message"), WRONG.values(), ids=WRONG)
def test_files_that_lack_something_are_told_what(make, xml, message):
    with pytest.raises(ConfigError, match="'robot_base'.*" + message):
        make(xml, vases_num=1)


def test_the_body_that_is_kept_upright_is_one_of_the_robots(make):
    keys = {"reward_orientation": True, "task": "none"}
    env = make(DISC, **keys, reward_orientation_body="arm", reward_orientation_scale=1.0)
    env.reset()
    state = env.get_state()
    state["qpos"][:, 3] = -1.0  # the elbow
    result = env.step(env.set_state(state).set("action", torch.zeros(2, 3)))
    elbow = env.get_state()["qpos"][0, 3]
    assert float(result["next", "reward"][0]) == pytest.approx(math.cos(elbow), abs=1e-6)
    with pytest.raises(ConfigError, match=r"'reward_orientation_body'.*'arms'.*'arm'"):
        make(DISC, **keys, reward_orientation_body="arms")
    with pytest.raises(ConfigError, match=r"'reward_orientation_body'.*'vase0'"):
        make(DISC, **keys, reward_orientation_body="vase0", vases_num=1)


def test_a_file_that_changed_is_noticed_and_one_that_it_includes(make, tmp_path):
    default, part = '<default><geom condim="6" density="10"/></default>', tmp_path / "part.xml"
    masses = []
    for density in ("10", "20"):
        part.write_text(f"<mujoco>{default.replace('10', density)}</mujoco>")
        masses.append(_mass(make(changed(DISC, default, '<include file="part.xml"/>'))))
        masses.append(_mass(make(changed(DISC, 'density="10"', f'density="{density}"'))))
    assert masses == pytest.approx([masses[0], masses[0], 2 * masses[0], 2 * masses[0]])


SLOW_MOTOR = {
    "filter": ("general", 'dyntype="filter" dynprm="0.5"'),
    "delay": ("motor", 'delay="0.05" nsample="30"'),
}


@pytest.mark.parametrize("kind", SLOW_MOTOR)
def test_what_actuators_remember_is_part_of_a_state(make, kind):
    tag, keys = SLOW_MOTOR[kind]
    xml = changed(DISC, '<motor name="drive"', f'<{tag} {keys} name="drive"')
    env = make(xml, sensors_obs=["speed"])
    idle, drive = torch.zeros(2, 3), torch.ones(2, 3)
    here = env.rollout(10, lambda td: td.set("action", drive))[:, -1]["next"]
    state = env.get_state()
    if kind == "filter":  # 100 substeps of Euler's
        remembered = torch.full((2,), 1 - (1 - 0.004 / 0.5) ** 100, dtype=torch.float64)
        torch.testing.assert_close(state["act"][:, 0], remembered)
    onward = env.step(here.clone().set("action", idle))["next", "observation"]
    env.set_state(state)
    assert torch.equal(env.step(here.clone().set("action", idle))["next", "observation"], onward)


@pytest.mark.usefixtures("registrations_undone")
def test_registered_robots_are_made_by_name(make, tmp_path):
    make(BALL)
    register_robot("mine", tmp_path / "robot.xml")
    env = SafetyGymEnv({"robot_base": "mine", "sensors_obs": ["gyro"]}, seed=0)
    assert env.observation_layout == {"gyro": slice(0, 3)}
    with pytest.raises(ConfigError, match=r"built-in robot"):
        register_robot("car", tmp_path / "robot.xml")


@pytest.mark.parametrize("masks", [(1, 0), (2, 2), (4, 1)])
def test_robots_with_other_masks_stand_on_the_floor_and_touch_objects(make, masks):
    """Gymnasium's Ant has the masks (1, 0)."""
    default = '<default><geom contype="{}" conaffinity="{}"/></default>'.format(*masks)
    xml = changed(BALL, "<worldbody>", default + "<worldbody>")
    keys = {"robot_locations": [[0, 0]], "robot_keepout": 0.0, "pillars_keepout": 0.0}
    env = make(xml, task="none", vases_num=1, pillars_num=1, pillars_locations=[[0.2, 0]],
               constrain_pillars=True, **keys)  # fmt: skip
    rollout = env.rollout(50)
    heights = env.get_positions().apply(lambda place: place[..., 2])
    assert heights["robot"].min() > 0.1
    assert heights["vases"].min() > 0.09
    assert rollout["next", "cost_pillars"][:, 0].all()


def test_keyframes_are_told(make):
    with pytest.warns(UserWarning, match="keyframes of .* are not used"):
        make(BALL)


@pytest.mark.parametrize(
    "options", ['settotalmass="5"', 'boundmass="1" boundinertia="0.1"', 'inertiagrouprange="0 0"']
)
def test_options_that_would_change_the_masses_of_objects_are_refused(make, options):
    with pytest.raises(ConfigError, match="would change the masses of objects"):
        make(changed(DISC, "<mujoco>", f"<mujoco><compiler {options}/>"))


def test_a_default_mass_of_the_robots_geoms_is_not_that_of_objects(make):
    xml = changed(DISC, 'density="10"', 'mass="1"')
    model = make(xml, vases_num=1, vases_density=2.0)._world.scene.model
    assert model.body("robot").mass == 1.0
    assert model.body("vase0").mass == pytest.approx(2.0 * 0.2**3)
