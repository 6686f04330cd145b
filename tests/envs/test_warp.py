"""MuJoCo Warp beside MuJoCo, on Warp's CPU device."""

from importlib.util import find_spec

import pytest
import torch
from commands import run_train
from looking import CountLooks
from omegaconf import OmegaConf
from run_configs import compose_config
from torchrl.envs.utils import check_env_specs

from safe_rl.envs import ConfigError, SafetyGymEnv, make_env
from safe_rl.envs.safety_gym.building import build_scene
from safe_rl.envs.safety_gym.config import ROBOTS
from safe_rl.envs.safety_gym.suite import resolve
from safe_rl.envs.velocity import VELOCITY_SUITE
from safe_rl.runs.identity import experiment_of
from safe_rl.training.building import build_trainer, seed_everything

# kernels are compiled once for all tests, which takes a minute; imported by the tests themselves,
# as collecting should not take five seconds more
pytestmark = [
    pytest.mark.long,
    pytest.mark.skipif(not find_spec("mujoco_warp"), reason="comes with the extra gpu"),
]
# in the plane, in space, and the one whose solver Warp lacks
SHAPES = ("SafeHopperVelocity", "SafeAntVelocity", "SafeHumanoidVelocity")
BUSY = {"robot_base": "point", "gremlins_num": 1, "vases_num": 1, "buttons_num": 1, "task": "goal"}
BUSY |= {"constrain_gremlins": True, "constrain_vases": True, "observe_gremlins": True}


def steps_from_equal_states(cpu, warp, num_steps):
    """Steps of both from the same states, [(output, state) of cpu, of warp]."""
    start = cpu.reset()
    warp.reset()
    torch.manual_seed(0)
    # At a reset everything stands on the floor at a distance of 0, where rounding alone decides
    # whether there is a contact.
    cpu._step(start.set("action", cpu.action_spec.rand()))
    for _ in range(num_steps):
        warp.set_state(cpu.get_state())
        start.set("action", cpu.action_spec.rand())
        yield [(env._step(start), env.get_state()) for env in (cpu, warp)]


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in SHAPES else [pytest.mark.slow])
        for name in VELOCITY_SUITE
    ],
)
def test_one_step_of_a_robot_is_that_of_mujoco(name):
    """Random actions from a start until most robots have fallen, each step from equal states."""
    cpu, warp = (
        make_env(name, num_envs=16, seed=0, velocity_threshold=0.1, physics=physics)
        for physics in ("cpu", "warp")
    )
    torch.testing.assert_close(cpu.reset(), warp.reset(), atol=1e-5, rtol=1e-5)
    apart, differ, steps = [], 0, []
    for (step, state), (other, following) in steps_from_equal_states(cpu, warp, 60):
        far = (state["qpos"] - following["qpos"]).abs().amax(-1) > 1e-5
        for key in ("observation", "reward"):
            far |= ((step[key] - other[key]).abs() > 1e-3 * (1 + step[key].abs())).any(-1)
        apart.append(far)
        for key in ("cost", "cost_velocity", "terminated", "truncated"):
            differ += int((step[key] != other[key]).sum())
        steps.append(step)
    # Where a contact begins or ends, rounding decides; a speed may round across the threshold.
    assert torch.stack(apart).double().mean() < 0.02
    assert differ <= 4
    seen = torch.stack(steps)
    assert seen["cost"].unique().tolist() == [0.0, 1.0]
    assert seen["terminated"].any() == ("healthy_z_range" in cpu.config.to_dict())
    if "cfrc_ext" in cpu.observation_layout:
        assert seen["observation"][..., cpu.observation_layout["cfrc_ext"]].any()


@pytest.mark.parametrize("name", ["SafeHalfCheetahVelocity", "SafeHumanoidVelocity"])
def test_robots_on_warp_follow_the_rules_of_environments(name):
    env = make_env(name, num_envs=4, seed=0, physics="warp", num_steps=20)
    check_env_specs(env)
    env.set_seed(1)
    # episodes of any number of steps, and each row begins its own
    rollout = env.rollout(50, break_when_any_done=False)
    assert rollout["next", "done"].any()


def test_a_robot_whose_physics_failed_begins_anew_and_its_observation_has_numbers():
    env = make_env("SafeAntVelocity", num_envs=2, seed=0, physics="warp")
    state = env.reset().set("action", env.action_spec.zero())
    env._physics.qvel[1] = torch.nan
    step = env._step(state)
    assert step["terminated"].tolist() == [[False], [True]]
    assert step["observation"].isfinite().all()
    assert step["reward"][1] == 0.0
    assert not env._step(state)["terminated"].any()


def test_graphs_replay_what_is_launched_one_by_one():
    graphs, eager = (make_env("PointGoal1", num_envs=8, seed=0, physics="warp") for _ in range(2))
    eager._physics.use_graphs = False
    for (step, state), (other, following) in steps_from_equal_states(graphs, eager, 3):
        assert torch.equal(step["observation"], other["observation"])
        assert all(torch.equal(value, following[key]) for key, value in state.items())


def test_a_resumed_environment_continues_as_the_first():
    env = SafetyGymEnv(resolve(BUSY | {"physics": "warp"}), 4, seed=3)
    env.rollout(5)
    action = env.action_spec.rand()
    start = env.get_state()
    first = env._step(env.fake_tensordict().set("action", action))
    env.set_state(start)
    second = env._step(env.fake_tensordict().set("action", action))
    for key, value in first.items():
        torch.testing.assert_close(value, second[key], atol=1e-4, rtol=1e-4)
    assert env.get_positions()["gremlins"].shape == (4, 1, 3)


def looks_of_an_epoch(directory, num_steps, algo):
    """How often one epoch looks at values: a rollout, advantages and costs, and the updates."""
    own = {  # as many gradient steps of PPO, whatever they change
        "ppo_lagrangian": [
            f"critic_update.minibatch_size={2 * num_steps}",
            "policy_update.max_kl=1e3",
        ],
        "sac_lagrangian": ["memory.batch_size=16", "exploration.random_steps=0"],
    }
    config = compose_config(
        *("env=PointGoal1", f"algo={algo}", "preset=gpu", "num_envs=4", "logger=none"),
        *(f"frames={8 * num_steps}", f"frames_per_batch={4 * num_steps}", "num_threads=1"),
        *("certificate.episodes=0", *own[algo]),
    )
    seed_everything(config.seed, 1)
    env = make_env(OmegaConf.to_container(config.env, resolve=True), num_envs=4, num_threads=1)
    env._physics.waits, env._physics._look = True, lambda: None
    trainer = build_trainer(config, env, directory)
    batches = iter(trainer.collector)
    trainer.epoch(batches)
    with CountLooks() as mode:
        trainer.epoch(batches)
    trainer.close()
    return mode.num_looks


# SAC's 0.05 gradient steps per step of 4 worlds: a loss is looked at before each
@pytest.mark.parametrize(("algo", "more_updates"), [("ppo_lagrangian", 0), ("sac_lagrangian", 4)])
def test_an_epoch_waits_for_the_device_once_for_every_step(algo, more_updates, tmp_path):
    few, many = (looks_of_an_epoch(tmp_path / str(steps), steps, algo) for steps in (8, 24))
    # TorchRL's collector asks after a step whether an episode has ended
    assert 24 - 8 <= many - few <= 24 - 8 + more_updates


@pytest.mark.gpu
@pytest.mark.parametrize(
    "name",
    ["PointGoal1", "CarButton2", "DoggoPush1", "SafeHopperVelocity", "SafeHumanoidVelocity"],
)
def test_steps_on_cuda_do_not_wait_and_are_those_of_the_cpu_device(name):
    envs = [
        make_env(name, num_envs=16, device=device, seed=0, physics="warp")
        for device in ("cpu", "cuda")
    ]
    states = [env.reset() for env in envs]
    for _ in range(3):
        envs[1].set_state(envs[0].get_state().to("cuda"))
        action = envs[0].action_spec.rand()
        first = envs[0]._step(states[0].set("action", action))
        states[1].set("action", action.to("cuda"))
        torch.cuda.set_sync_debug_mode("error")
        second = envs[1]._step(states[1])
        torch.cuda.set_sync_debug_mode("default")
        apart = (first["observation"] - second["observation"].cpu()).abs().amax(-1)
        assert apart.median() < 1e-2


@pytest.mark.parametrize("device", ["cpu", pytest.param("cuda", marks=pytest.mark.gpu)])
@pytest.mark.parametrize(
    ("env", "algo", "choice"),
    [
        ("PointGoal1", "ppo_lagrangian", "preset=gpu"),
        ("PointGoal1", "sac_lagrangian", "env.physics=warp"),
        ("SafeAntVelocity", "ppo_lagrangian", "preset=gpu"),
    ],
)
def test_training_and_a_certificate_on_warp(env, algo, choice, device, tmp_path):
    run_train(
        *(f"env={env}", f"algo={algo}", choice, f"device={device}", "num_envs=4"),
        *("env.num_steps=10", "frames=64", "frames_per_batch=32", "certificate.ranking=2"),
        *("certificate.episodes=4", "logger=none", "num_threads=1", f"hydra.run.dir={tmp_path}"),
    )
    assert (tmp_path / "certificate.json").exists()
    config = OmegaConf.load(next(tmp_path.rglob("config.yaml")))
    assert config.env.physics == "warp"
    cpu = OmegaConf.merge(config, {"env": {"physics": "cpu"}})
    named = [experiment_of(OmegaConf.to_container(each, resolve=True)) for each in (config, cpu)]
    assert named[0] != named[1]
    assert named[0]["env.physics"] == "warp"


def small_physics(contacts):
    """Two simulations, with room for some contacts."""
    from safe_rl.envs.physics.warp_physics import WarpPhysics

    model = build_scene(resolve(BUSY)).model
    return WarpPhysics(model, 2, "cpu", contacts=contacts, constraints=256)


def test_what_is_wrong_on_the_device_is_said_by_a_later_call():
    physics = small_physics(contacts=64)
    physics.waits = True
    physics.check(torch.tensor([False, True]), lambda: ValueError("late"))
    with pytest.raises(ValueError, match="late"):
        physics.step(3)


def test_a_lack_of_room_is_an_error_that_names_the_key():
    from safe_rl.envs.physics.warp_physics import BufferOverflowError

    physics = small_physics(contacts=1)
    with pytest.raises(BufferOverflowError, match=r"room for 1 contacts.*env\.physics_buffers"):
        physics.step(5)


def test_what_warp_lacks_is_refused(tmp_path):
    robot = tmp_path / "robot.xml"
    text = ROBOTS["point"].read_text().replace("<option ", '<option solver="PGS" ', 1)
    robot.write_text(text)
    with pytest.raises(ConfigError, match=r"'physics' warp does not support the robot .*PGS"):
        SafetyGymEnv(BUSY | {"robot_base": str(robot), "physics": "warp"})
    with pytest.raises(ConfigError, match="'physics' warp runs on the devices cpu and cuda"):
        SafetyGymEnv(resolve(BUSY | {"physics": "warp"}), device="meta")
    for keys in ({"lidar_type": "natural"}, {"frameskip_binom_p": 0.9}):
        with pytest.raises(ConfigError, match=r"'lidar_type' natural and .* need 'physics' cpu"):
            SafetyGymEnv(BUSY | {"physics": "warp", **keys})
    with pytest.raises(ConfigError, match="physics=jax: it must be 'cpu' or 'warp'"):
        SafetyGymEnv({"physics": "jax"})


def test_a_class_of_ones_own_may_have_another_constructor():
    class Own(SafetyGymEnv):
        def __init__(self, number):
            super().__init__(resolve("PointGoal0").replace(physics="warp"), number)

    assert Own(2).reset()["observation"].shape[0] == 2
