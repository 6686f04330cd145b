r"""Seconds until the first policy that reaches a return and is shown to keep its limits.

A policy is tested after an epoch if the means over the last three epochs keep every limit and
reach the target return. The test has new episodes. The policy passes if its mean return reaches
the target and the upper confidence bound of every J_c is within its limit. All tests of a run
share one level (Bonferroni), so that many tests do not make a wrong result more likely. The
seconds are those of training and of the tests, from the first step; the start of Python is not
included.

    python benchmarks/time_to_safe.py env=PointGoal1 algo=ppo_lagrangian --seeds 0 1 2 3 4
    python benchmarks/time_to_safe.py env=PointGoal1 algo=trpo transforms=[early_termination] \
        transforms.early_termination.in_evaluation=true \
        transforms.early_termination.budgets='{cost: 24}' --seeds 0 1 2 3 4
"""

import argparse
import statistics
import tempfile
import time
from pathlib import Path

from omegaconf import OmegaConf
from train_throughput import compose_config, new_env

from safe_rl.evaluation import collect_episodes
from safe_rl.runs.table import feasible_return
from safe_rl.scores.certificate import Claim
from safe_rl.training.building import build_trainer, seed_everything


def is_promising(rows, limits, target):
    """Whether the policy is tested after these rows of the table."""
    mean = feasible_return(rows[-3:], limits)
    return len(rows) >= 3 and mean is not None and mean >= target


def passes(config, policy, claim, options, number):
    """Test a policy; returns its mean return, whether it passes, and the bounds."""
    worlds = {"num_envs": min(100, options.episodes), "seed": config.seed + 10**6 + number}
    test = new_env(OmegaConf.merge(config, worlds), evaluating=True)
    episodes = collect_episodes(
        test, policy, options.episodes, list(claim.limits), deterministic=False
    )
    test.close()
    costs = {key: values.numpy() for key, values in episodes.costs.items()}
    mean = episodes.returns.mean().item()
    bounds = {name: bound for name, (bound, _) in claim.bounds(costs, options.tests).items()}
    return mean, mean >= options.target and not claim.shortfalls(costs, options.tests), bounds


def time_to_safe(config, options, directory):
    """Train until a policy passes, the tests are used up, or the run is over."""
    seed_everything(config.seed, config.num_threads)
    env = new_env(config)
    trainer = build_trainer(config, env, directory)
    limits = {key: float(limit) for key, limit in config.cost_limits.items()}
    claim = Claim(limits, highest={key: env.highest_cost(key) for key in limits})
    batches, rows, tests = iter(trainer.collector), [], 0
    start = time.perf_counter()
    while trainer.progress.steps < config.frames and tests < options.tests:
        rows.append(trainer.epoch(batches))
        if is_promising(rows, claim.limits, options.target):
            tests += 1
            policy = trainer.algorithm.policy
            mean, is_safe, bounds = passes(config, policy, claim, options, tests)
            if is_safe:
                seconds = time.perf_counter() - start
                trainer.close()
                return trainer.progress.steps, seconds, f"return {mean:.1f}, {bounds}", tests
    trainer.close()
    return trainer.progress.steps, float("inf"), "none passed", tests


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("overrides", nargs="*", help="as train.py takes them")
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2, 3, 4])
    parser.add_argument("--target", type=float, default=15.0, help="mean return")
    parser.add_argument("--episodes", type=int, default=1000, help="of a test")
    parser.add_argument("--tests", type=int, default=5, help="at most, of a run")
    options = parser.parse_args()
    found = []
    print("| seed | steps | seconds | tests | policy |\n|---|---|---|---|---|")
    for seed in options.seeds:
        config = compose_config([*options.overrides, f"seed={seed}"])
        with tempfile.TemporaryDirectory() as directory:
            steps, seconds, outcome, tests = time_to_safe(config, options, Path(directory))
        found.append(seconds)
        print(f"| {seed} | {steps:,} | {seconds:.0f} | {tests} | {outcome} |", flush=True)
    print(f"median: {statistics.median(found):.0f} s")


if __name__ == "__main__":
    main()
