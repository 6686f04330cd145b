"""Every key of a run's configuration: what it may hold, and what it means.

Keys that belong to a part are in `part_keys`. Defaults are in ``conf/``; keys of environments are
the environments' own business.
"""

from __future__ import annotations

from safe_rl.cli.values import (
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    Values,
    anything,
    boolean,
    choice,
    component,
    count,
    folder_name,
    list_of,
    mapping_of,
    number,
    optional,
    text,
)
from safe_rl.parameters import Parameter

__all__ = ["KEYS", "Key"]


def Key(values: Values, meaning: str, bytes_each: int = 0, may_lack: bool = False) -> Parameter:
    """A row of the tables."""
    return Parameter(values, meaning, bytes_each, is_required=not may_lack)


_LIMITS = mapping_of(number(0))
_FOLDER_OF_ENV = folder_name._replace(
    words=f"{folder_name.words}: it names folders, and env.name=… gives another name"
)
_SECTION = mapping_of(anything)
_WIDTH = count(1, 16_384)
_WIDTHS = list_of(_WIDTH, 32)
_HEADS = choice("auto", "gaussian", "tanh", "beta", "categorical", "one_hot")

KEYS = {
    "frames": Key(count(), "steps to train for"),
    # a world of the smallest robot, and a step with one number of observation
    "num_envs": Key(count(), "environments that are stepped together", bytes_each=20_000),
    "frames_per_batch": Key(count(), "steps of all environments in one batch", bytes_each=50),
    # evaluations add to a seed, and environments count in 64 bits
    "seed": Key(count(0, 2**62), "seed of the run"),
    "init_from": Key(optional(text), "folder or checkpoint of the run to start from"),
    "cost_limits": Key(_LIMITS, "cost allowed per episode, by cost: '{cost: 25}'"),
    "default_cost_limits": Key(optional(_LIMITS), "cost_limits unless given", may_lack=True),
    "device": Key(text, "where networks are trained: cpu or cuda"),
    # torch starts all of them at once, and crashes where the system gives it no more
    "num_threads": Key(optional(count(1, 1024)), "threads of physics and torch; null: all cores"),
    "record": Key(boolean, "whether transitions are written to disk", may_lack=True),
    "compile": Key(boolean, "whether to compile the losses"),
    "preset": Key(text, "set of defaults: default or paper"),
    "note": Key(anything, "a note on the run, kept in its config.yaml", may_lack=True),
    "import": Key(anything, "modules of your own, imported first", may_lack=True),
    "paper": Key(anything, "numbers that preset=paper chooses from", may_lack=True),
    "env": Key(_SECTION, "the environment: env=PointGoal1"),
    "algo": Key(_SECTION, "the algorithm: algo=cpo"),
    "model": Key(_SECTION, "the networks"),
    "checkpoint": Key(_SECTION, "when checkpoints are written"),
    "collector": Key(_SECTION, "where environments are stepped: collector=local"),
    "transforms": Key(
        mapping_of(component), "what changes the problem: transforms=[saute]", may_lack=True
    ),
    "logger": Key(_SECTION, "where else columns go: logger=wandb; logger=none: nowhere"),
    "env.name": Key(_FOLDER_OF_ENV, "name of the environment"),
    "algo.name": Key(folder_name, "name of the algorithm"),
    "algo.constrained": Key(
        boolean, "whether cost_limits are kept, or costs only counted", may_lack=True
    ),
    "checkpoint.interval": Key(number(0), "seconds between checkpoints"),
    "checkpoint.keep_last": Key(count(1, 10_000), "checkpoints that are kept besides the best"),
    "checkpoint.keep_best": Key(count(1, 10_000), "best checkpoints kept", may_lack=True),
    "checkpoint.best_over": Key(
        count(1, 10_000), "epochs that the best are averaged over", may_lack=True
    ),
    "certificate": Key(
        _SECTION,
        "the test at a run's end; certificate.episodes=0 for none",
        may_lack=True,
    ),
    "certificate.ranking": Key(
        count(2, 10**6), "episodes per candidate that rank them", may_lack=True
    ),
    "certificate.episodes": Key(count(0, 10**6), "new episodes of a test; 0: none", may_lack=True),
    "certificate.tests": Key(count(1, 1000), "candidates tested at most", may_lack=True),
    "certificate.retest": Key(
        count(0, 1000), "if none passes: times the episodes of one more test", may_lack=True
    ),
    "certificate.level": Key(
        number(0.5, 1, above=True, below=True), "confidence of a certificate", may_lack=True
    ),
    "certificate.most_over": Key(SHARE, "share of episodes that may exceed a limit", may_lack=True),
    "collector.num_collectors": Key(count(1, 1024), "processes that step environments"),
    "model.hidden_sizes": Key(_WIDTHS, "widths of layers, such as [64, 64]"),
    "model.initial_log_std": Key(number(-20, 10), "log of the policy's first standard deviation"),
    "model.input_scale": Key(mapping_of(POSITIVE), "factors by observation component"),
    "model.head": Key(_HEADS, "distribution of the actions", may_lack=True),
    "model.normalise": Key(
        optional(POSITIVE), "bound of normalised observations; null: not normalised", may_lack=True
    ),
    "model.encoders": Key(
        optional(_SECTION), "encoders of observed entries: model=dict, model=cnn", may_lack=True
    ),
    "model.encoders.vector": Key(_WIDTHS, "widths of layers for a vector"),
    "model.encoders.channels": Key(_WIDTHS, "channels of convolutions for an image"),
    "model.encoders.kernels": Key(_WIDTHS, "sizes of their kernels [pixels]"),
    "model.encoders.strides": Key(_WIDTHS, "their strides [pixels]"),
    "model.memory": Key(optional(_SECTION), "recurrence: model=gru", may_lack=True),
    "model.memory.size": Key(_WIDTH, "size of the recurrent state"),
    "advantage": Key(component, "estimator of the reward's advantages", may_lack=True),
    "cost_advantage": Key(optional(component), "estimator of the costs' advantages", may_lack=True),
    "lagrangian": Key(optional(component), "the multiplier", may_lack=True),
    "risk": Key(optional(_SECTION), "what is limited: risk=mean, cvar or chance", may_lack=True),
    "limits": Key(
        optional(_SECTION), "how the limit is approached: limits=default or paper", may_lack=True
    ),
    "staggered_starts": Key(
        optional(boolean), "whether first episodes are cut to different lengths", may_lack=True
    ),
    "replay": Key(anything, "off-policy defaults, which preset=default reads", may_lack=True),
    "memory": Key(component, "the replay buffer, off policy", may_lack=True),
    "actor": Key(component, "the policy's network, off policy", may_lack=True),
    "critics": Key(_SECTION, "sizes of the ensembles of Q functions", may_lack=True),
    "critics.rewards": Key(count(0, 1000), "Q functions of the reward"),
    "critics.costs": Key(count(0, 1000), "Q functions of the costs"),
    "dataset": Key(
        _SECTION, "recorded transitions that the replay buffer begins with", may_lack=True
    ),
    "dataset.path": Key(optional(text), "folder of a recording, or an HDF5 file"),
    "dataset.safe_episodes": Key(boolean, "whether only episodes within cost_limits are taken"),
    "dataset.alone": Key(boolean, "whether to learn from the dataset only"),
    "exploration": Key(_SECTION, "exploration, off policy", may_lack=True),
    "exploration.random_steps": Key(count(0), "steps taken at random first"),
    "exploration.noise": Key(
        NOT_NEGATIVE, "standard deviation of a deterministic actor's noise", may_lack=True
    ),
    "evaluation": Key(optional(_SECTION), "evaluation while training", may_lack=True),
    "evaluation.interval": Key(count(), "steps between evaluations", may_lack=True),
    "evaluation.episodes": Key(count(1, 10**6), "episodes of an evaluation", may_lack=True),
    "loss": Key(component, "the policy's loss", may_lack=True),
    "policy_update": Key(component, "what moves the policy", may_lack=True),
    "then": Key(
        mapping_of(mapping_of(component)), "losses and updates after policy_update", may_lack=True
    ),
    "critic_update": Key(component, "what moves the critics", may_lack=True),
}
"""By full path. Of sections (``model`` and the like) these are all keys there are."""
