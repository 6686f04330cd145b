"""Every key of a run's configuration: what it may hold, and what it means.

Keys that belong to a part are listed by the part's class, whatever node of the configuration it
stands in. Defaults are in ``conf/``; keys of environments are the environments' own business.
"""

from __future__ import annotations

from typing import NamedTuple

from safe_rl.cli.values import (
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
    one_or_per_cost,
    optional,
    text,
)

__all__ = ["EXTRAS", "FLAGS", "KEYS", "PARTS", "Key"]


class Key(NamedTuple):
    """A row of the tables.

    Attributes:
        values: What the key may hold.
        meaning: What it is, in a few words.
        bytes_each: Memory that every unit of a count takes at least; 0 if it takes none.
        may_lack: Whether a configuration without the key is whole.

    Examples:
        >>> KEYS["checkpoint.keep_last"].meaning
        'checkpoints that are kept besides the best'
    """

    values: Values
    meaning: str
    bytes_each: int = 0
    may_lack: bool = False


_SHARE = number(0, 1)
_POSITIVE = number(0, above=True)
_NOT_NEGATIVE = number(0)
_STRENGTH = number(1e-9, 1e9)  # what is divided by, and divides
_LIMITS = mapping_of(number(0))
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
    "cost_limits": Key(_LIMITS, "cost per episode allowed by cost, '{cost: 25}'"),
    "default_cost_limits": Key(optional(_LIMITS), "cost_limits unless given", may_lack=True),
    "device": Key(text, "where networks are trained: cpu or cuda"),
    # torch starts all of them at once, and crashes where the system gives it no more
    "num_threads": Key(optional(count(1, 1024)), "threads of physics and torch; null: all cores"),
    "compile": Key(boolean, "whether to compile the losses"),
    "preset": Key(text, "set of numbers"),
    "note": Key(anything, "free words about the run, for its config.yaml", may_lack=True),
    "import": Key(anything, "modules of one's own", may_lack=True),
    "paper": Key(anything, "numbers that preset=paper chooses from", may_lack=True),
    "env": Key(_SECTION, "the environment: env=PointGoal1"),
    "algo": Key(_SECTION, "the algorithm: algo=cpo"),
    "model": Key(_SECTION, "the networks"),
    "checkpoint": Key(_SECTION, "when checkpoints are written"),
    "collector": Key(_SECTION, "where environments are stepped: collector=local"),
    "transforms": Key(
        mapping_of(component), "what changes the problem: transforms=[saute]", may_lack=True
    ),
    "logger": Key(_SECTION, "what is logged besides the table: logger=none for nothing"),
    "env.name": Key(folder_name, "name of the environment"),
    "algo.name": Key(folder_name, "name of the algorithm"),
    "checkpoint.interval": Key(number(0), "seconds between checkpoints"),
    "checkpoint.keep_last": Key(count(1, 10_000), "checkpoints that are kept besides the best"),
    "checkpoint.keep_best": Key(count(1, 10_000), "best checkpoints kept", may_lack=True),
    "certificate": Key(_SECTION, "what is certified at a run's end", may_lack=True),
    "certificate.ranking": Key(count(2, 10**6), "episodes that order candidates", may_lack=True),
    "certificate.episodes": Key(count(0, 10**6), "episodes of a test; 0: none", may_lack=True),
    "certificate.tests": Key(count(1, 1000), "candidates tested at most", may_lack=True),
    "certificate.level": Key(
        number(0.5, 1, above=True, below=True), "confidence of a certificate", may_lack=True
    ),
    "certificate.most_over": Key(_SHARE, "share of episodes over a limit", may_lack=True),
    "collector.num_collectors": Key(count(1, 1024), "processes that step environments"),
    "model.hidden_sizes": Key(_WIDTHS, "widths of layers, such as [64, 64]"),
    "model.initial_log_std": Key(number(-20, 10), "log of the policy's first standard deviation"),
    "model.input_scale": Key(mapping_of(_POSITIVE), "factors by observation component"),
    "model.head": Key(_HEADS, "distribution of the actions", may_lack=True),
    "model.normalise": Key(
        optional(_POSITIVE), "where normalised observations are cut; null: not", may_lack=True
    ),
    "model.encoders": Key(optional(_SECTION), "what encodes every entry observed", may_lack=True),
    "model.encoders.vector": Key(optional(_WIDTHS), "layers for a vector", may_lack=True),
    "model.encoders.channels": Key(optional(_WIDTHS), "layers for a picture", may_lack=True),
    "model.encoders.kernels": Key(optional(_WIDTHS), "their sizes [pixels]", may_lack=True),
    "model.encoders.strides": Key(optional(_WIDTHS), "their strides [pixels]", may_lack=True),
    "model.memory": Key(optional(_SECTION), "what the policy remembers", may_lack=True),
    "model.memory.size": Key(optional(_WIDTH), "numbers that are remembered", may_lack=True),
    "advantage": Key(component, "estimator of the reward's advantages", may_lack=True),
    "cost_advantage": Key(optional(component), "estimator of the costs' advantages", may_lack=True),
    "lagrangian": Key(optional(component), "the multiplier", may_lack=True),
    "risk": Key(optional(_SECTION), "what is limited: risk=mean, cvar or chance", may_lack=True),
    "limits": Key(optional(_SECTION), "from the costs of a batch to violations", may_lack=True),
    "staggered_starts": Key(
        optional(boolean), "whether first episodes begin at different points", may_lack=True
    ),
    "replay": Key(anything, "numbers that preset=default takes instead of its own", may_lack=True),
    "memory": Key(component, "what is learned from, off policy", may_lack=True),
    "actor": Key(component, "the policy's network, off policy", may_lack=True),
    "critics": Key(_SECTION, "sizes of the ensembles of Q functions", may_lack=True),
    "critics.rewards": Key(count(1, 1000), "Q functions of the reward"),
    "critics.costs": Key(count(1, 1000), "Q functions of the costs"),
    "exploration": Key(_SECTION, "how a memory is filled", may_lack=True),
    "exploration.random_steps": Key(count(0), "steps taken at random first"),
    "exploration.noise": Key(
        _NOT_NEGATIVE, "standard deviation of a deterministic actor's noise", may_lack=True
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

_OPTIMIZER = {
    "lr": Key(number(0, 1000, above=True), "learning rate"),
    "betas": Key(list_of(number(0, 1, below=True), 3), "decay rates of the moments"),
    "eps": Key(_NOT_NEGATIVE, "what denominators are kept above"),
    "weight_decay": Key(_NOT_NEGATIVE, "decay of the weights"),
    "momentum": Key(number(0, 1, below=True), "weight of past gradients"),
    "fused": Key(optional(boolean), "whether to step in one kernel"),
    "foreach": Key(optional(boolean), "whether to step all tensors together"),
    "amsgrad": Key(boolean, "whether to keep the maximum of second moments"),
    "nesterov": Key(boolean, "whether to look ahead"),
}
_ESTIMATOR = {
    "gamma": Key(_SHARE, "discount per step"),
    "lmbda": Key(_SHARE, "decay of the TD errors"),
    "value_target": Key(choice("lambda_return", "return_to_go"), "what critics learn"),
}
_TRUST_REGION = {
    "target_kl": Key(_POSITIVE, "radius δ of the trust region, a mean KL divergence"),
    "damping": Key(_NOT_NEGATIVE, "multiple of the identity added to the Fisher matrix"),
    "cg_iterations": Key(count(1, 10_000), "iterations of conjugate gradients"),
    "backtrack_coeff": Key(
        number(0, 1, above=True, below=True), "factor from one try of the line search to the next"
    ),
    "max_backtracks": Key(count(1, 10_000), "tries of the line search"),
    "fisher_subsample": Key(number(0, 1, above=True), "share of the batch for the Fisher matrix"),
}
_LOSS = {
    "entropy_coeff": Key(_NOT_NEGATIVE, "factor of the entropy bonus"),
    "reduction": Key(choice("mean", "sum"), "how samples are reduced"),
}
_CLIPPED_LOSS = {
    **_LOSS,
    "clip_epsilon": Key(number(0, 1000, above=True), "half-width of the ratios that earn"),
}
_Q_FUNCTIONS = {
    "gamma": Key(_SHARE, "discount per step"),
    "loss_function": Key(choice("l2", "smooth_l1", "l1"), "of the TD errors"),
}
_SAC = {
    **_Q_FUNCTIONS,
    "alpha_init": Key(_STRENGTH, "first weight of the entropy"),
    "target_entropy": Key(
        Values(lambda v: v == "auto" or number().hold(v), f"auto, or {number().words}"),
        "entropy to which its weight is adapted; auto: minus the number of actions",
    ),
    "fixed_alpha": Key(boolean, "whether the weight of the entropy stays as it is"),
}
_TD3 = {
    **_Q_FUNCTIONS,
    "policy_noise": Key(_NOT_NEGATIVE, "deviation of the noise on the target policy's actions"),
    "noise_clip": Key(_NOT_NEGATIVE, "bound of that noise"),
}
_COST_CRITICS = {
    "pessimism": Key(number(), "standard deviations among cost critics on top of their mean"),
}
_SAUTE = {
    "budgets": Key(mapping_of(number(0, above=True)), "cost per episode allowed by cost"),
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
        "max_kl": Key(optional(_POSITIVE), "mean KL divergence that ends the update"),
        "max_grad_norm": Key(optional(_POSITIVE), "norm to which the gradient is clipped"),
        "adapt_rate": Key(optional(component), "what adapts the learning rate"),
        "compile": Key(boolean, "whether to compile the loss"),
    },
    "KLAdaptiveRate": {
        "factor": Key(number(1, above=True), "by which the rate is divided or multiplied"),
        "lowest": Key(number(0, 1000, above=True), "lower bound of the rate"),
        "highest": Key(number(0, 1000, above=True), "upper bound of the rate"),
        "few_steps": Key(_SHARE, "share of the steps below which an update ended early"),
        "low_kl": Key(_SHARE, "share of the KL limit below which an update fell short"),
    },
    "TRPOStep": _TRUST_REGION,
    "CPOStep": {
        **_TRUST_REGION,
        "rescale_violation": Key(boolean, "whether violations are divided by the episode length"),
    },
    "PCPOStep": {
        **_TRUST_REGION,
        "projection": Key(choice("kl", "l2"), "distance that the projection keeps small"),
        "rescale_violation": Key(boolean, "whether violations are divided by the episode length"),
    },
    "CRPOStep": {
        **_TRUST_REGION,
        "tolerance": Key(_NOT_NEGATIVE, "η, violation of an episode's cost that is let pass"),
    },
    "CTRPOStep": {
        **_TRUST_REGION,
        "beta": Key(_NOT_NEGATIVE, "β, weight of the barrier, per unit of an episode's cost"),
        "gamma": Key(
            optional(number(0, 1, below=True)), "discount that makes sums of averages; null: T̄ does"
        ),
        "hysteresis": Key(number(0, 1, above=True), "share of a limit at which a recovery ends"),
    },
    "PPOLoss": _CLIPPED_LOSS,
    "PPOLagrangianLoss": {
        **_CLIPPED_LOSS,
        "cost_clipping": Key(choice("none", "pessimistic", "joint"), "how cost surrogates are cut"),
    },
    "SACLoss": _SAC,
    "SACLagrangianLoss": {**_SAC, **_COST_CRITICS},
    "TD3Loss": _TD3,
    "TD3LagrangianLoss": {**_TD3, **_COST_CRITICS},
    "Memory": {
        "capacity": Key(count(), "transitions that are kept", bytes_each=50),
        "batch_size": Key(count(), "transitions in a minibatch"),
        "n_steps": Key(count(1, 1000), "steps that a transition spans"),
        "storage": Key(choice("tensor", "memmap"), "where transitions are kept"),
        "prioritised": Key(optional(mapping_of(_SHARE)), "{alpha: …, beta: …}; null: uniform"),
        "keep": Key(boolean, "whether checkpoints hold the transitions"),
    },
    "ReplayUpdate": {
        "optimizer": Key(component, "the optimiser"),
        "updates_per_step": Key(_POSITIVE, "gradient steps per step of an environment"),
        "tau": Key(number(0, 0.5, above=True), "share of the way that target networks go"),
        "policy_delay": Key(count(1, 10_000), "steps of the critics per step of the policy"),
        "rates": Key(optional(mapping_of(_POSITIVE)), "learning rates by name of parameters"),
        "max_grad_norm": Key(optional(_POSITIVE), "norm to which the gradient is clipped"),
        "compile": Key(boolean, "whether to compile the loss"),
    },
    "make_squashed_actor": {},
    "make_bounded_actor": {},
    "TRPOLoss": _LOSS,
    "TRPOLagrangianLoss": _LOSS,
    "CPOLoss": _LOSS,
    "RCPOLoss": _CLIPPED_LOSS,
    "P3OLoss": {
        **_CLIPPED_LOSS,
        "kappa": Key(_NOT_NEGATIVE, "penalty factor κ"),
        "gamma": Key(optional(_SHARE), "discount that weighs the violation; null: 1/T̄ does"),
    },
    "IPOLoss": {
        **_CLIPPED_LOSS,
        "kappa": Key(_STRENGTH, "strength κ of the barrier"),
        "max_weight": Key(_STRENGTH, "weight of costs at the limit and beyond"),
    },
    "FOCOPSLoss": {
        **_LOSS,
        "temperature": Key(_STRENGTH, "β, the trust region's multiplier"),
        "max_state_kl": Key(_POSITIVE, "KL divergence beyond which a state teaches nothing"),
    },
    "CUPLoss": {
        **_LOSS,
        "gamma": Key(number(0, 1, below=True), "discount of the cost advantages"),
        "lmbda": Key(_SHARE, "decay of their TD errors"),
    },
    "VectorGAE": _ESTIMATOR,
    "CostGAE": _ESTIMATOR,
    "LagrangeMultiplier": {
        "init": Key(one_or_per_cost(number(0, 1e6, above=True)), "first λ"),
        "lr": Key(_POSITIVE, "step size of Adam"),
        "betas": _OPTIMIZER["betas"],
        "eps": _OPTIMIZER["eps"],
    },
    "ProjectedMultiplier": {
        "init": Key(one_or_per_cost(number(0, 1e6)), "first λ"),
        "lr": Key(_POSITIVE, "change of λ per unit of violation"),
        "highest": Key(optional(_POSITIVE), "upper bound of λ; null: none"),
    },
    "PIMultiplier": {
        "init": Key(one_or_per_cost(number(0, 1e6)), "first λ"),
        "kp": Key(_NOT_NEGATIVE, "proportional gain"),
        "ki": Key(_NOT_NEGATIVE, "integral gain"),
        "saturation": Key(_POSITIVE, "bound of the error, in units of the limit"),
        "highest": Key(_POSITIVE, "upper bound of λ"),
    },
    "LimitTracker": {
        "margin": Key(_NOT_NEGATIVE, "standard errors of a batch's J_c below the limit"),
        "largest_margin": Key(_SHARE, "bound of the margin, as a share of the limit"),
        "free_steps": Key(count(0), "steps for which costs are free"),
        "descent_steps": Key(count(0), "steps in which the limit then comes down"),
        "recovery": Key(_SHARE, "share of a limit to come down to, once above it"),
        "frames": Key(count(), "steps of the whole run"),
        "latest_end": Key(number(0, 1, above=True), "share of a run by which the descent is over"),
        "smallest_scale": Key(_POSITIVE, "unit of violations of limits near 0, costs per step"),
        "drift": Key(optional(_POSITIVE), "share by which J_c changes per update"),
        "memory": Key(number(0, 1, below=True), "weight of the past"),
        "lowest_trust": Key(number(0, 1, above=True), "share of a promise believed at least"),
        "integral": Key(_NOT_NEGATIVE, "share of a violation that is asked for again"),
        "largest_integral": Key(_NOT_NEGATIVE, "bound of that, in units of violations"),
    },
    "CVaR": {
        "tail": Key(number(0, 1, above=True), "share of the episodes, the worst"),
        "window": Key(count(1, 10**6), "episodes from which the value at risk is taken"),
        "ramp_start": Key(count(0), "steps in which the mean is limited"),
        "ramp_steps": Key(count(0), "steps in which the tail then takes its place"),
    },
    "Chance": {"most_over": Key(number(0, 1, below=True), "share of episodes over the limit")},
    "PIDMultiplier": {
        "init": Key(one_or_per_cost(number(0, 1e6)), "first λ"),
        "kp": Key(_NOT_NEGATIVE, "proportional gain"),
        "ki": Key(_NOT_NEGATIVE, "integral gain"),
        "kd": Key(_NOT_NEGATIVE, "derivative gain"),
        "proportional_ema": Key(number(0, 1, below=True), "weight of the past in the error"),
        "derivative_ema": Key(number(0, 1, below=True), "weight of the past in the cost"),
        "derivative_delay": Key(count(1, 100_000), "updates over which growth is measured"),
        "scale": Key(
            Values(
                lambda v: v == "limit" or one_or_per_cost(_POSITIVE).hold(v),
                f"limit, or {one_or_per_cost(_POSITIVE).words}",
            ),
            "unit of the errors",
        ),
    },
    "make_process_collector": _WORKERS,
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
    "EarlyTermination": {"budgets": Key(_LIMITS, "cost per episode that ends it if exceeded")},
    "ActionFilter": {
        "filter": Key(component, "the function that replaces actions"),
        "cost_key": Key(text, "name of the cost of interventions"),
    },
    "PolicyMemory": {"size": Key(_WIDTH, "numbers that are remembered")},
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
    "_partial_": Key(boolean, "whether other arguments follow"),
}
"""Keys of any part that are Hydra's."""

EXTRAS = {
    "make_ray_collector": ("ray", "ray"),
    "WandbLogger": ("wandb", "wandb"),
    "MLflowLogger": ("mlflow", "mlflow"),
}
"""Parts that need a package besides: its name, and the extra that installs it."""
