"""Environment steps per second of the velocity family, beside bare physics and Gymnasium.

The bare loop is what no environment on this backend can beat: the same model without sensors, the
same controls in, the substeps, nothing read. Before every step it is set to the environment's own
state, untimed, so that both compute the same trajectories, resets of the environment or not; the
script fails if they do not. Gymnasium's `SyncVectorEnv` steps as many of its own environments in
turns of its own. All are timed in one process, step by step in turns; rates are of the medians.

    python benchmarks/velocity_throughput.py --envs SafeHopperVelocity --num-envs 64 256
"""

import argparse
import itertools
import statistics
import time

import gymnasium
import torch

from safe_rl.envs.physics.cpu import BatchPhysics
from safe_rl.envs.velocity import VELOCITY_SUITE, VelocityEnv
from safe_rl.envs.velocity.robots import ROBOTS

COLUMNS = (
    *("env", "num_envs", "threads", "env steps/s", "bare steps/s", "ratio"),
    *("SyncVectorEnv steps/s", "factor"),
)
STATE = ("qpos", "qvel", "qacc_warmstart", "time")


def timed(function):
    """Seconds a call took, and its result."""
    start = time.perf_counter()
    result = function()
    return time.perf_counter() - start, result


def bare_seconds(physics, env, action):
    """Seconds of the physics alone for the step that the environment takes next."""
    for name in STATE:
        getattr(physics, name).copy_(getattr(env._physics, name))

    def step():
        physics.ctrl.copy_(action)
        physics.step(env.config.frame_skip, refresh=False)

    return timed(step)[0]


def check_same(name, physics, env, done):
    """Compare the states after a step, but of robots that were reset."""
    if not torch.allclose(physics.qpos[~done], env._physics.qpos[~done], rtol=1e-9, atol=1e-9):
        raise SystemExit(f"{name}: the two went different ways, there is nothing to compare.")


def gymnasium_seconds(config, num_envs, actions):
    """Seconds of each vector step of Gymnasium's own environments."""
    gymnasium_id = ROBOTS[config.robot].gymnasium_id
    vector = gymnasium.make_vec(gymnasium_id, num_envs=num_envs, vectorization_mode="sync")
    vector.reset(seed=0)
    yield
    for action in actions:
        yield timed(lambda action=action: vector.step(action.numpy()))[0]


def measure(name, num_envs, threads, steps):
    """One row of the table."""
    torch.set_num_threads(1)  # the physics has the cores; tensors this small gain nothing
    env = VelocityEnv(name, num_envs=num_envs, seed=0, num_threads=threads)
    plain = VelocityEnv(
        {"robot": env.config.robot, **_without_contacts(env.config)}, num_envs, num_threads=threads
    )
    physics = BatchPhysics(plain._model, num_envs, threads, outputs=())
    actions = env.action_spec.rand((steps,))
    others = gymnasium_seconds(env.config, num_envs, actions)
    next(others)
    tensordict, seconds = env.reset(), {"env": [], "bare": [], "gymnasium": []}
    for action in actions:
        seconds["bare"].append(bare_seconds(physics, env, action))
        tensordict["action"] = action
        spent, (after, tensordict) = timed(lambda td=tensordict: env.step_and_maybe_reset(td))
        seconds["env"].append(spent)
        check_same(name, physics, env, after["next", "done"][:, 0])
        seconds["gymnasium"].append(next(others))
    warm = {key: values[steps // 5 :] for key, values in seconds.items()}
    rates = {key: num_envs / statistics.median(values) for key, values in warm.items()}
    ratio = statistics.median(b / e for b, e in zip(warm["bare"], warm["env"], strict=True))
    factor = statistics.median(g / e for g, e in zip(warm["gymnasium"], warm["env"], strict=True))
    return dict(
        zip(
            COLUMNS,
            (
                *(name, num_envs, threads, round(rates["env"]), round(rates["bare"])),
                *(round(ratio, 3), round(rates["gymnasium"]), round(factor, 1)),
            ),
            strict=True,
        )
    )


def _without_contacts(config):
    """Keys that do away with the sensor for contact forces."""
    keys = config.to_dict()
    off = {"include_cfrc_ext_in_observation": False, "contact_cost_weight": 0.0}
    return {key: value for key, value in off.items() if key in keys}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--envs", nargs="+", default=list(VELOCITY_SUITE))
    parser.add_argument("--num-envs", nargs="+", type=int, default=[256])
    parser.add_argument("--threads", nargs="+", type=int, default=[0], help="0: one per core")
    parser.add_argument("--steps", type=int, default=100, help="vector steps of each")
    options = parser.parse_args()
    print("| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|")
    for case in itertools.product(options.envs, options.num_envs, options.threads):
        row = measure(*case, options.steps)
        print("| " + " | ".join(str(row[column]) for column in COLUMNS) + " |", flush=True)


if __name__ == "__main__":
    main()
