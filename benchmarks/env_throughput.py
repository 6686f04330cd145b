"""Environment steps per second of Safety Gym, beside the bare physics of the same environments.

The bare physics is an upper bound for any environment on this backend. It is the same compiled
model with the same options: controls and the gremlins' targets are written, the substeps are
taken, and the outputs are computed once. Both start from the same states and get the same
controls, so that they compute the same trajectories. They are timed in turns in one process.
Figures are medians over the turns. The time of one reset of all environments is divided among the
steps of an episode.

    python benchmarks/env_throughput.py --envs PointGoal1 DoggoGoal2 --num-envs 64 --threads 0
    python benchmarks/env_throughput.py --envs PointGoal1 --change hazards_num=0 hazards_num=16
"""

import argparse
import itertools
import json
import resource
import statistics
import subprocess
import sys
import time

import safe_rl  # isort: skip  # noqa: F401, before torch, for its settings of threads
import torch
from omegaconf import OmegaConf

from safe_rl.envs import SUITE, SafetyGymEnv
from safe_rl.envs.physics import BatchPhysics
from safe_rl.envs.safety_gym.building import build_scene
from safe_rl.envs.safety_gym.episodes import gremlin_path
from safe_rl.envs.safety_gym.suite import resolve

COLUMNS = ("env", "num_envs", "threads", "env steps/s", "bare steps/s", "ratio", "reset ms", "MB")


def configuration(name, change):
    """An environment of the suite with some keys changed: "hazards_num=0 vases_num=5"."""
    changes = OmegaConf.to_container(OmegaConf.from_dotlist(change.split()))
    return resolve(name).replace(**changes)


def time_env(env, tensordict, actions):
    """Seconds for as many vector steps as there are actions."""
    start = time.perf_counter()
    for action in actions:
        tensordict["action"] = action
        _, tensordict = env.step_and_maybe_reset(tensordict)
    return time.perf_counter() - start, tensordict


def time_bare(physics, env, actions):
    """Seconds for the same steps of the physics alone; the targets' paths are not timed."""
    seconds, path = 0.0, None
    for action in actions:
        if env._world.scene.num_targets:
            path = gremlin_path(env._world, physics.time, env.config.frameskip_binom_n)
        start = time.perf_counter()
        physics.ctrl.copy_(action)
        physics.step(env.config.frameskip_binom_n, path)
        seconds += time.perf_counter() - start
    return seconds


def bare_physics(env, num_envs, threads):
    """The same worlds at the start of their episodes, without the environment."""
    world = env._world
    physics = BatchPhysics(world.scene.model, num_envs, threads)
    for name in ("qpos", "qvel", "qacc_warmstart", "time", "mocap_pos", "mocap_quat"):
        getattr(physics, name).copy_(getattr(world.physics, name))
    return physics


def time_reset(env):
    """Seconds for a reset of all worlds."""
    start = time.perf_counter()
    tensordict = env.reset()
    return time.perf_counter() - start, tensordict


def measure(name, change, num_envs, threads, steps, repeats):
    """One row of the table."""
    torch.set_num_threads(1)  # the physics has the cores; tensors this small gain nothing
    config = configuration(name, change)
    env = SafetyGymEnv(config, num_envs=num_envs, seed=0, num_threads=threads)
    if steps * (repeats + 1) >= config.num_steps:
        raise SystemExit(f"All turns have to fit into one episode of {config.num_steps} steps.")
    _, tensordict = time_reset(env)
    time_env(env, tensordict, env.action_spec.rand((steps,)))
    reset = statistics.median(time_reset(env)[0] for _ in range(5))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    tensordict, physics = env.reset(), bare_physics(env, num_envs, threads)
    env_seconds, bare_seconds = [], []
    for _ in range(repeats + 1):
        actions = env.action_spec.rand((steps,))
        seconds, tensordict = time_env(env, tensordict, actions)
        env_seconds.append(seconds + steps * reset / config.num_steps)
        bare_seconds.append(time_bare(physics, env, actions))
    if not torch.equal(physics.qpos, env._physics.qpos):
        raise SystemExit(f"{name}: the states differ, so the times cannot be compared.")
    env_rate, bare_rate = (
        num_envs * steps / statistics.median(seconds[1:]) for seconds in (env_seconds, bare_seconds)
    )
    ratios = [bare / env for env, bare in zip(env_seconds[1:], bare_seconds[1:], strict=True)]
    values = (f"{name} {change}".strip(), num_envs, threads, round(env_rate), round(bare_rate))
    rounded = (round(statistics.median(ratios), 3), round(1e3 * reset, 1), round(peak))
    return dict(zip(COLUMNS, (*values, *rounded), strict=True))


def measure_apart(*arguments):
    """Measure in a process of its own, so that peak memory is that of one environment."""
    command = [sys.executable, __file__, "--row", *map(str, arguments)]
    result = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    if result.returncode:
        raise SystemExit(result.returncode)  # it has printed the reason
    return json.loads(result.stdout)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--envs", nargs="+", default=["PointGoal1", "DoggoGoal2"], help="or: all")
    parser.add_argument(
        "--change", nargs="+", default=[""], help="keys, in quotes: 'vases_num=5 hazards_num=0'"
    )
    parser.add_argument("--num-envs", nargs="+", type=int, default=[64])
    parser.add_argument("--threads", nargs="+", type=int, default=[0], help="0: one per core")
    parser.add_argument("--steps", type=int, default=20, help="vector steps per turn")
    parser.add_argument("--repeats", type=int, default=20, help="turns")
    parser.add_argument("--row", nargs=6, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.row:
        name, change, *numbers = options.row
        print(json.dumps(measure(name, change, *map(int, numbers))))
        return
    names = list(SUITE) if options.envs == ["all"] else options.envs
    for name, change in itertools.product(names, options.change):
        build_scene(configuration(name, change))  # refuses unknown names before anything is timed
    print("| " + " | ".join(COLUMNS) + " |\n" + "|---" * len(COLUMNS) + "|")
    for case in itertools.product(names, options.change, options.num_envs, options.threads):
        row = measure_apart(*case, options.steps, options.repeats)
        print("| " + " | ".join(str(row[column]) for column in COLUMNS) + " |", flush=True)


if __name__ == "__main__":
    main()
