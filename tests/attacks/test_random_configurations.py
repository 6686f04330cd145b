"""Random valid configurations: each runs, and a run that is continued has the same table."""

import shutil

from attacking import RUN, cases
from omegaconf import open_dict
from run_configs import CONF, compose_config, without_times

from safe_rl.cli.composing import compose_run
from safe_rl.cli.config import check_settings
from safe_rl.runs.run import Run
from safe_rl.training.train import train

ALGORITHMS = sorted(path.stem for path in (CONF / "algo").glob("*.yaml") if path.stem != "bc")
GENERAL = [word for word in RUN if not word.startswith(("critic_update", "model"))]
ENVIRONMENTS = ("PointGoal1", "PointButton2", "CarPush1", "DoggoGoal0", "PointRun1", "CarCircle2")
CHANGES = (
    *("env.num_steps=13", "env.num_steps=1", "env.action_noise=0.2"),
    *("num_envs=4", "frames_per_batch=80", "record=true", "seed=12345", "checkpoint.keep_best=1"),
    *("transforms=[observed_costs]", "transforms=[saute]", "transforms=[action_filter]"),
    *("transforms=[sensor_noise,action_delay]", "model.hidden_sizes=[4,4]", "model.normalise=5"),
    *("cost_limits={cost: 0}", "cost_limits={cost: 3, cost_hazards: 1}", "staggered_starts=true"),
)


def with_sizes(algorithm):
    """Overrides that make updates of an algorithm as small as its batches."""
    config = compose_config(f"algo={algorithm}")
    sizes = {"policy_update.minibatch_size": 20, "critic_update.minibatch_size": 20}
    sizes |= {"memory.batch_size": 8, "exploration.random_steps": 40, "memory.keep": "true"}
    for key, size in sizes.items():
        section, _, name = key.partition(".")
        if name in (config.get(section) or {}):
            yield f"{key}={size}"


def composed(*words):
    """What the command line begins a run with."""
    config = compose_run(words)
    check_settings(config)
    with open_dict(config):
        config.pop("hydra")
    return config


def test_a_run_in_two_parts_has_the_table_of_one(tmp_path):
    refusals, finished = [], 0
    for random in cases("random configurations", 110, least=10):
        algorithm = random.choice(ALGORITHMS)
        words = [*GENERAL, f"algo={algorithm}", f"env={random.choice(ENVIRONMENTS)}"]
        words += [*with_sizes(algorithm), "certificate.episodes=0", "model.hidden_sizes=[8]"]
        words += random.sample(CHANGES, random.randint(0, 3))
        print(*words, flush=True)
        whole, parts = tmp_path / "whole", tmp_path / "parts"
        try:
            train(composed(*words, "frames=320", "limits=null"), whole)
        except ValueError as error:  # keys that do not go together
            refusals.append(str(error))
        else:
            train(composed(*words, "frames=160", "limits=null"), parts)
            train(composed(*words, "frames=320", "limits=null"), parts, continues=True)
            tables = [without_times(Run(place).table_file) for place in (whole, parts)]
            assert tables[0] == tables[1]
            finished += 1
        for place in (whole, parts):
            shutil.rmtree(place, ignore_errors=True)
    assert all(len(words.splitlines()) == 1 for words in refusals)
    assert finished > len(refusals)
