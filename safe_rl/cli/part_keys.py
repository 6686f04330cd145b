"""The keys of the parts that a run is built from, by class: what each may hold, and what it means.

They hold whatever node of the configuration a part stands in.
"""

from __future__ import annotations

from safe_rl.cli.keys import KEYS, Key
from safe_rl.cli.values import (
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    anything,
    boolean,
    choice,
    component,
    count,
    list_of,
    mapping_of,
    number,
    optional,
    text,
)

__all__ = ["EXTRAS", "FLAGS", "PARTS"]


_OPTIMIZER = {
    "lr": Key(number(0, 1000, above=True), "learning rate"),
    "betas": Key(list_of(number(0, 1, below=True), 3), "decay rates of the moments"),
    "eps": Key(NOT_NEGATIVE, "added to denominators"),
    "weight_decay": Key(NOT_NEGATIVE, "decay of the weights"),
    "momentum": Key(number(0, 1, below=True), "weight of past gradients"),
    "fused": Key(optional(boolean), "whether to step in one kernel"),
    "foreach": Key(optional(boolean), "whether to step all tensors together"),
    "amsgrad": Key(boolean, "whether to keep the maximum of second moments"),
    "nesterov": Key(boolean, "whether to look ahead"),
}
_TRUST_REGION = {
    "target_kl": Key(POSITIVE, "radius δ of the trust region, a mean KL divergence"),
    "damping": Key(NOT_NEGATIVE, "multiple of the identity added to the Fisher matrix"),
    "cg_iterations": Key(count(1, 10_000), "iterations of conjugate gradients"),
    "backtrack_coeff": Key(
        number(0, 1, above=True, below=True), "factor from one try of the line search to the next"
    ),
    "max_backtracks": Key(count(1, 10_000), "tries of the line search"),
    "fisher_subsample": Key(number(0, 1, above=True), "share of the batch for the Fisher matrix"),
}
_CONSTRAINED = {
    "rescale_violation": Key(boolean, "whether violations are divided by the episode length"),
    "largest_demand": Key(
        optional(POSITIVE), "bound of a violation, as a share of what a step can correct"
    ),
}
_SAUTE = {
    "budgets": Key(mapping_of(POSITIVE), "cost allowed per episode, by cost"),
    "discount": Key(number(0, 1, above=True), "discount of the costs that a budget is for"),
    "unsafe_reward": Key(number(), "reward of a step once a budget is spent"),
    "rescale_budgets": Key(boolean, "whether budgets are undiscounted"),
}
_WORKERS = {"num_collectors": KEYS["collector.num_collectors"]}

PARTS = {
    "MinibatchUpdate": {
        "optimizer": Key(component, "the optimiser"),
        "num_passes": Key(count(1, 10**9), "passes over the batch"),
        "minibatch_size": Key(optional(count()), "samples per step; null: the whole batch"),
        "max_kl": Key(optional(POSITIVE), "mean KL divergence that ends the update"),
        "max_grad_norm": Key(optional(POSITIVE), "norm to which the gradient is clipped"),
        "adapt_rate": Key(optional(component), "what adapts the learning rate"),
        "compile": Key(boolean, "whether to compile the loss"),
    },
    "KLAdaptiveRate": {
        "factor": Key(number(1, above=True), "by which the rate is divided or multiplied"),
        "lowest": Key(number(0, 1000, above=True), "lower bound of the rate"),
        "highest": Key(number(0, 1000, above=True), "upper bound of the rate"),
        "few_steps": Key(SHARE, "an update with a smaller share of its steps ended early"),
        "low_kl": Key(SHARE, "an update with a smaller share of max_kl fell short"),
    },
    "TRPOStep": _TRUST_REGION,
    "CPOStep": {**_TRUST_REGION, **_CONSTRAINED},
    "PCPOStep": {
        **_TRUST_REGION,
        **_CONSTRAINED,
        "projection": Key(choice("kl", "l2"), "metric of the projection"),
    },
    "CRPOStep": {
        **_TRUST_REGION,
        "tolerance": Key(NOT_NEGATIVE, "η, tolerated violation per episode"),
    },
    "CTRPOStep": {
        **_TRUST_REGION,
        "beta": Key(NOT_NEGATIVE, "β, weight of the barrier, per unit of an episode's cost"),
        "gamma": Key(
            optional(number(0, 1, below=True)), "from averages to sums: 1 / (1 - gamma); null: T̄"
        ),
        "hysteresis": Key(number(0, 1, above=True), "share of a limit at which a recovery ends"),
    },
    "Memory": {
        "capacity": Key(count(), "transitions that are kept", bytes_each=50),
        "batch_size": Key(count(), "transitions in a minibatch"),
        "n_steps": Key(count(1, 1000), "steps of n-step returns"),
        "storage": Key(choice("tensor", "memmap"), "where transitions are kept"),
        "prioritised": Key(optional(mapping_of(SHARE)), "{alpha: …, beta: …}; null: uniform"),
        "keep": Key(boolean, "whether checkpoints hold the transitions"),
    },
    "ReplayUpdate": {
        "optimizer": Key(component, "the optimiser"),
        "updates_per_step": Key(POSITIVE, "gradient steps per step of an environment"),
        "tau": Key(
            optional(number(0, 0.5, above=True)),
            "Polyak averaging: share of the way that targets move; null: no targets",
        ),
        "policy_delay": Key(count(1, 10_000), "steps of the critics per step of the policy"),
        "rates": Key(optional(mapping_of(POSITIVE)), "learning rates by prefix of parameter names"),
        "max_grad_norm": Key(optional(POSITIVE), "norm to which the gradient is clipped"),
        "compile": Key(boolean, "whether to compile the loss"),
    },
    "make_squashed_actor": {},
    "make_bounded_actor": {},
    "make_process_collector": {
        **_WORKERS,
        "ahead": Key(boolean, "whether the next batch is collected while one is learned from"),
    },
    "make_ray_collector": {
        **_WORKERS,
        "ray_init": Key(mapping_of(anything), "arguments of ray.init"),
        "resources": Key(mapping_of(anything), "resources of every actor"),
    },
    "Saute": _SAUTE,
    "Simmer": {
        **_SAUTE,
        "first": Key(number(0, 1, above=True), "share of the budgets to begin with"),
        "steps": Key(count(), "steps of each environment until budgets are whole"),
    },
    "EarlyTermination": {
        "budgets": Key(mapping_of(NOT_NEGATIVE), "cost per episode that ends it if exceeded"),
        "in_evaluation": Key(boolean, "whether episodes of an evaluation end as well"),
    },
    "ActionFilter": {
        "filter": Key(component, "the function that replaces actions"),
        "cost_key": Key(text, "name of the cost of interventions"),
    },
    "RewardScale": {"factor": Key(POSITIVE, "what rewards are multiplied by")},
    "SensorNoise": {
        "std": Key(NOT_NEGATIVE, "standard deviation of the noise"),
        "components": Key(optional(list_of(text, 1000)), "components with noise; null: all"),
    },
    "ActionDelay": {"steps": Key(count(1, 1000), "steps from an action to its effect")},
    "PolicyMemory": {"size": Key(count(1, 16_384), "size of the recurrent state")},
    "TensorboardLogger": {"exp_name": Key(text, "folder of the event files")},
    "MLflowLogger": {
        "exp_name": Key(text, "name of the experiment"),
        "tracking_uri": Key(text, "database or server"),
    },
    "WandbLogger": {
        "exp_name": Key(text, "name of the run"),
        "project": Key(text, "name of the project"),
        "offline": Key(boolean, "whether to keep everything in the folder of the run"),
    },
    "torch.optim": _OPTIMIZER,
}
"""Of the package's parts by class, and of torch's optimisers together."""

FLAGS = {
    "_target_": Key(optional(text), "what is built"),
    "_partial_": Key(boolean, "whether it is called later with more arguments"),
}
"""Keys of any part that are Hydra's."""

EXTRAS = {
    "make_ray_collector": ("ray", "ray"),
    "WandbLogger": ("wandb", "wandb"),
    "MLflowLogger": ("mlflow", "mlflow"),
}
"""Parts that need a package besides: its name, and the extra that installs it."""
