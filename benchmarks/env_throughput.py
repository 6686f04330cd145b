"""Environment steps per second, beside the bare physics of the same model.

The bare loop is what no environment on this backend can beat: the same compiled model with the
same options, controls and the gremlins' targets in, the substeps, one forward at the end. Both are
timed in turns in one process; the figures are medians.

    python benchmarks/env_throughput.py --envs PointGoal1 DoggoGoal2 --num-envs 64 --threads 0
"""

import argparse
import json
import resource
import statistics
import subprocess
import sys
import time

import torch

from safe_rl.envs import SUITE, SafetyGymEnv
from safe_rl.envs.episodes import gremlin_path
from safe_rl.envs.physics.cpu import BatchPhysics
from safe_rl.envs.scene import build_scene

COLUMNS = ("env", "num_envs", "threads", "env steps/s", "bare steps/s", "ratio", "reset ms", "MB")


def time_env(env, tensordict, steps):
    """Seconds for `steps` vector steps with random actions, resets included."""
    actions = env.action_spec.rand((steps,))
    start = time.perf_counter()
    for action in actions:
        tensordict["action"] = action
        _, tensordict = env.step_and_maybe_reset(tensordict)
    return time.perf_counter() - start, tensordict


def time_bare(physics, env, paths, steps):
    """Seconds for as many steps of the physics alone."""
    actions = env.action_spec.rand((steps,))
    start = time.perf_counter()
    for action in actions:
        physics.ctrl.copy_(action)
        physics.step(env.config.frameskip_binom_n, paths)
    return time.perf_counter() - start


def bare_physics(env, num_envs, threads):
    """The same worlds, in the environment's present state, without the environment."""
    world = env._world
    physics = BatchPhysics(world.scene.model, num_envs, threads)
    for name in ("qpos", "qvel", "qacc_warmstart", "time", "mocap_pos", "mocap_quat"):
        getattr(physics, name).copy_(getattr(world.physics, name))
    path = None
    if world.scene.num_targets:
        path = gremlin_path(world, physics.time, env.config.frameskip_binom_n)
    return physics, path


def measure(name, num_envs, threads, steps, repeats):
    """One row of the table."""
    torch.set_num_threads(1)  # the physics has the cores; tensors this small gain nothing
    env = SafetyGymEnv(name, num_envs=num_envs, seed=0, num_threads=threads)
    tensordict = env.reset()
    start = time.perf_counter()
    tensordict = env.reset()
    reset = time.perf_counter() - start
    physics, path = bare_physics(env, num_envs, threads)
    env_seconds, bare_seconds = [], []
    for _ in range(repeats + 1):
        seconds, tensordict = time_env(env, tensordict, steps)
        env_seconds.append(seconds)
        bare_seconds.append(time_bare(physics, env, path, steps))
    env_rate, bare_rate = (
        num_envs * steps / statistics.median(seconds[1:]) for seconds in (env_seconds, bare_seconds)
    )
    ratios = [bare / env for env, bare in zip(env_seconds[1:], bare_seconds[1:], strict=True)]
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    values = (name, num_envs, threads, round(env_rate), round(bare_rate))
    rounded = (round(statistics.median(ratios), 3), round(1e3 * reset, 1), round(peak))
    return dict(zip(COLUMNS, (*values, *rounded), strict=True))


def measure_apart(*arguments):
    """Measure in a process of its own, so that peak memory is that of one environment."""
    command = [sys.executable, __file__, "--row", *map(str, arguments)]
    return json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--envs", nargs="+", default=["PointGoal1", "DoggoGoal2"], help="or: all")
    parser.add_argument("--num-envs", nargs="+", type=int, default=[64])
    parser.add_argument("--threads", nargs="+", type=int, default=[0], help="0: one per core")
    parser.add_argument("--steps", type=int, default=200, help="vector steps per repeat")
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--row", nargs=5, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.row:
        name, *numbers = options.row
        print(json.dumps(measure(name, *map(int, numbers))))
        return
    names = list(SUITE) if options.envs == ["all"] else options.envs
    for name in names:
        build_scene(SUITE[name])  # an unknown name fails here, before anything is timed
    print("| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|")
    for name in names:
        for num_envs in options.num_envs:
            for threads in options.threads:
                row = measure_apart(name, num_envs, threads, options.steps, options.repeats)
                print("| " + " | ".join(str(row[column]) for column in COLUMNS) + " |", flush=True)


if __name__ == "__main__":
    main()
