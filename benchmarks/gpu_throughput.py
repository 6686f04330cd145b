"""Environment steps/s on MuJoCo Warp, with observations, beside the CPU backend.

    python benchmarks/gpu_throughput.py --device cuda --worlds 1024 4096 8192 32768 --training

For a check without a GPU, it also runs on Warp's CPU device, which is slow:

    python benchmarks/gpu_throughput.py PointGoal1 --device cpu --worlds 8 --steps 3
"""

import argparse
import csv
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import safe_rl  # isort: skip  # noqa: F401, before torch, for its settings of threads
import torch

from safe_rl.envs import make_env

IDS = ("PointGoal1", "CarGoal1", "DoggoGoal2", "PointButton2", "SafeAntVelocity")
TRAIN = Path(__file__).parents[1] / "train.py"


def rate(name, num_envs, steps, device, **keys):
    """Environment steps/s within episodes; robots that fall stay on the floor."""
    env = make_env(name, num_envs=num_envs, device=device, seed=0, **keys)
    steps = min(steps, env.config.num_steps - 1)
    state = env.reset()
    actions = env.action_spec.rand((steps + 1,))
    env._step(state.set("action", actions[0]))
    start = time.perf_counter()
    for action in actions[1:]:
        env._step(state.set("action", action))
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return num_envs * steps / (time.perf_counter() - start)


def training_rate(name, num_envs, device):
    """Steps/s of the last of three epochs of PPO-Lagrangian with preset=gpu."""
    frames = 32 * num_envs
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, str(TRAIN), f"env={name}", "preset=gpu", f"device={device}"]
        command += [f"num_envs={num_envs}", f"frames_per_batch={frames}", f"frames={3 * frames}"]
        command += ["certificate.episodes=0", "logger=none", f"hydra.run.dir={folder}"]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
        with (Path(folder) / "progress.csv").open() as table:
            return float(list(csv.DictReader(table))[-1]["steps_per_second"])


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("ids", nargs="*", default=IDS)
    parser.add_argument("--device", type=torch.device, default="cuda")
    parser.add_argument("--worlds", type=int, nargs="+", default=[1024, 4096, 8192, 32768])
    parser.add_argument("--cpu-worlds", type=int, default=256)
    parser.add_argument("--steps", type=int, default=100)
    parser.add_argument("--training", action="store_true", help="whole training steps/s as well")
    arguments = parser.parse_args()
    print("| environment | worlds | warp, steps/s | CPU, steps/s | training, steps/s |")
    print("|---|---|---|---|---|")
    for name in arguments.ids:
        on_cpu = rate(name, arguments.cpu_worlds, arguments.steps, torch.device("cpu"))
        for worlds in arguments.worlds:
            on_warp = rate(name, worlds, arguments.steps, arguments.device, physics="warp")
            trained = "—"
            if arguments.training:
                trained = f"{training_rate(name, worlds, arguments.device):,.0f}"
            print(
                f"| {name} | {worlds:,} | {on_warp:,.0f} | {on_cpu:,.0f} | {trained} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
