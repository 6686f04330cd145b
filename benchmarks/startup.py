"""Seconds until training takes its first step, and until the end of a short run.

Every figure is a median over several new processes: of the imports of torch and TorchRL, of the
further time of `import safe_rl.envs`, of `train.py` until the first step, and of `train.py` with
20,000 steps, one epoch with the defaults. With compile=true, the compiler's cache is empty.

    python benchmarks/startup.py env=PointGoal1 algo=ppo_lagrangian
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
IMPORTS = """
import time
start = time.perf_counter()
import torch, tensordict, torchrl.collectors, torchrl.envs
theirs = time.perf_counter()
import safe_rl.envs
print(theirs - start, time.perf_counter() - theirs)
"""
FIRST_STEP = """
import runpy, time, safe_rl.envs
from torchrl.envs import EnvBase
step = EnvBase.step
def first_step(env, tensordict):
    print("first step at", time.time())
    EnvBase.step = step
    return step(env, tensordict)
EnvBase.step = first_step
runpy.run_path("train.py", run_name="__main__")
"""


def run(code, *arguments, **variables):
    """What a script prints, run in a new interpreter in the root of the repository."""
    result = subprocess.run(
        [sys.executable, "-c", code, *arguments],
        cwd=ROOT,
        env=os.environ | variables | {"PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
    )
    if result.returncode:
        raise SystemExit(result.stderr)
    return result.stdout


def time_training(overrides):
    """Seconds from the start of the process to the first step, and to the end of the run."""
    with tempfile.TemporaryDirectory() as directory:
        folder, cache = f"hydra.run.dir={directory}/run", f"{directory}/cache"
        start = time.time()
        printed = run(FIRST_STEP, *overrides, folder, TORCHINDUCTOR_CACHE_DIR=cache)
        end = time.time()
    line = next(line for line in printed.splitlines() if line.startswith("first step at"))
    return float(line.split()[-1]) - start, end - start


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("overrides", nargs="*", help="as train.py takes them")
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    overrides = [*options.overrides, "frames=20_000", "logger=none"]
    imports = [tuple(map(float, run(IMPORTS).split())) for _ in range(options.repeats)]
    training = [time_training(overrides) for _ in range(options.repeats)]
    rows = {
        "import torch, tensordict, torchrl": statistics.median(theirs for theirs, _ in imports),
        "import safe_rl.envs, beyond that": statistics.median(ours for _, ours in imports),
        "train.py to the first step": statistics.median(first for first, _ in training),
        "train.py with 20,000 steps": statistics.median(end for _, end in training),
    }
    print("| | seconds |\n|---|---|")
    for name, seconds in rows.items():
        print(f"| {name} | {seconds:.2f} |")


if __name__ == "__main__":
    main()
