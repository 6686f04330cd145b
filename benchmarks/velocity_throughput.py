"""Environment steps per second of the velocity family, beside bare physics and Gymnasium.

The bare physics is an upper bound for any environment on this backend: the same model without
sensors gets the same controls and takes the substeps, and nothing is read. Before every step it is
set to the state of the environment, which is not timed, so that both compute the same steps, also
after a reset of the environment; the script fails if they differ. Gymnasium's `SyncVectorEnv`
steps the same number of its own environments. All are timed in turns in one process. Figures are
medians over turns of the median step.

    python benchmarks/velocity_throughput.py --envs SafeHopperVelocity --num-envs 64 256
    python benchmarks/velocity_throughput.py --threads 1 --cpu-time  # on a machine that is shared
"""

import argparse
import itertools
import statistics
import time

import safe_rl  # isort: skip  # noqa: F401, before torch, for its settings of threads
import gymnasium
import torch

from safe_rl.envs.physics import BatchPhysics
from safe_rl.envs.velocity import VELOCITY_SUITE, VelocityEnv
from safe_rl.envs.velocity.velocity_config import RUNNERS

COLUMNS = (
    *("env", "num_envs", "threads", "env steps/s", "bare steps/s", "ratio"),
    *("SyncVectorEnv steps/s", "factor"),
)
STATE = ("qpos", "qvel", "qacc_warmstart", "time")


clock = time.perf_counter


def timed(function):
    """Seconds a call took, and its result."""
    start = clock()
    result = function()
    return clock() - start, result


def env_turn(env, tensordict, actions):
    """Seconds of the environment's steps, the states before and after, and which rows go on."""
    seconds, states = [], [read(env._physics)]
    for action in actions:
        tensordict["action"] = action
        spent, (after, tensordict) = timed(lambda td=tensordict: env.step_and_maybe_reset(td))
        seconds.append(spent)
        states.append((*read(env._physics), ~after["next", "done"][:, 0]))
    return seconds, states, tensordict


def read(physics):
    """Copies of the state."""
    return tuple(getattr(physics, name).clone() for name in STATE)


def bare_turn(name, physics, frame_skip, actions, states):
    """Seconds of the same steps of the physics alone, each from the environment's state."""

    def step(action):
        physics.ctrl.copy_(action)
        physics.step(frame_skip, refresh=False)

    seconds = []
    for action, before, after in zip(actions, states, states[1:], strict=False):
        for field, value in zip(STATE, before, strict=False):
            getattr(physics, field).copy_(value)
        seconds.append(timed(lambda action=action: step(action))[0])
        qpos, going = after[0], after[-1]
        if not torch.allclose(physics.qpos[going], qpos[going], rtol=1e-9, atol=1e-9):
            raise SystemExit(f"{name}: the states differ, so the times cannot be compared.")
    return seconds


def measure(name, num_envs, threads, steps, repeats):
    """One row of the table."""
    torch.set_num_threads(1)  # the physics has the cores; tensors this small gain nothing
    env = VelocityEnv(name, num_envs=num_envs, seed=0, num_threads=threads)
    plain = VelocityEnv(
        {"robot": env.config.robot, **_without_contacts(env.config)}, num_threads=threads
    )
    physics = BatchPhysics(plain._model, num_envs, threads, outputs=())
    gymnasium_id = RUNNERS[env.config.robot].gymnasium_id
    vector = gymnasium.make_vec(gymnasium_id, num_envs=num_envs, vectorization_mode="sync")
    vector.reset(seed=0)
    tensordict, turns = env.reset(), []
    for _ in range(repeats + 1):
        actions = env.action_spec.rand((steps,))
        mine, states, tensordict = env_turn(env, tensordict, actions)
        bare = bare_turn(name, physics, env.config.frame_skip, actions, states)
        theirs = [timed(lambda a=action: vector.step(a.numpy()))[0] for action in actions[:3]]
        turns.append([statistics.median(seconds) for seconds in (mine, bare, theirs)])
    mine, bare, theirs = zip(*turns[1:], strict=True)
    rates = [round(num_envs / statistics.median(seconds)) for seconds in (mine, bare, theirs)]
    ratio = statistics.median(b / m for b, m in zip(bare, mine, strict=True))
    factor = statistics.median(t / m for t, m in zip(theirs, mine, strict=True))
    values = (name, num_envs, threads, *rates[:2], round(ratio, 3), rates[2], round(factor, 1))
    return dict(zip(COLUMNS, values, strict=True))


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
    parser.add_argument("--steps", type=int, default=10, help="vector steps per turn")
    parser.add_argument("--repeats", type=int, default=10, help="turns")
    parser.add_argument(
        "--cpu-time", action="store_true", help="instead of wall time; needs --threads 1"
    )
    options = parser.parse_args()
    if options.cpu_time:
        global clock
        clock = time.process_time
        if options.threads != [1]:
            raise SystemExit("CPU time is that of all threads together: add --threads 1.")
    print("| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|")
    for case in itertools.product(options.envs, options.num_envs, options.threads):
        row = measure(*case, options.steps, options.repeats)
        print("| " + " | ".join(str(row[column]) for column in COLUMNS) + " |", flush=True)


if __name__ == "__main__":
    main()
