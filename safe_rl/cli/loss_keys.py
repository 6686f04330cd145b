"""The keys of losses, by class: what each may hold, and what it means."""

from __future__ import annotations

from safe_rl.cli.keys import Key
from safe_rl.cli.values import (
    NOT_NEGATIVE,
    POSITIVE,
    SHARE,
    Values,
    boolean,
    choice,
    number,
    optional,
)

__all__ = ["LOSSES"]

_STRENGTH = number(1e-9, 1e9)  # what is divided by, and divides

_LOSS = {
    "entropy_coeff": Key(NOT_NEGATIVE, "factor of the entropy bonus"),
    "reduction": Key(choice("mean", "sum"), "how samples are reduced"),
}
_CLIPPED_LOSS = {
    **_LOSS,
    "clip_epsilon": Key(number(0, 1000, above=True), "ε, half-width of the clipping range"),
}
_Q_FUNCTIONS = {
    "gamma": Key(SHARE, "discount per step"),
    "loss_function": Key(choice("l2", "smooth_l1", "l1"), "loss of the TD errors"),
}
_SAC = {
    **_Q_FUNCTIONS,
    "alpha_init": Key(_STRENGTH, "first entropy coefficient"),
    "target_entropy": Key(
        Values(lambda v: v == "auto" or number().hold(v), f"auto, or {number().words}"),
        "entropy that its coefficient adapts to; auto: minus the number of actions",
    ),
    "fixed_alpha": Key(boolean, "whether the entropy coefficient is fixed"),
}
_TD3 = {
    **_Q_FUNCTIONS,
    "policy_noise": Key(NOT_NEGATIVE, "standard deviation of the target actions' noise"),
    "noise_clip": Key(NOT_NEGATIVE, "bound of that noise"),
}
_COST_CRITICS = {
    "pessimism": Key(number(), "standard deviations of the cost critics added to their mean"),
    "target_pessimism": Key(
        optional(number()), "the same in bootstrap targets; null: each its own target"
    ),
    "lowest_cost_value": Key(
        optional(number()), "lower bound of bootstrap targets, if no cost is below it"
    ),
}

LOSSES = {
    "PPOLoss": _CLIPPED_LOSS,
    "PPOLagrangianLoss": {
        **_CLIPPED_LOSS,
        "cost_clipping": Key(
            choice("none", "pessimistic", "joint"), "how cost surrogates are clipped"
        ),
    },
    "SACLoss": _SAC,
    "SACLagrangianLoss": {**_SAC, **_COST_CRITICS},
    "BCLoss": {"loss_function": _Q_FUNCTIONS["loss_function"]},
    "CALLoss": {
        **_SAC,
        **_COST_CRITICS,
        "convexity": Key(NOT_NEGATIVE, "c, weight per discounted cost beyond the limit"),
        "ratio_memory": Key(number(0, 1, below=True), "weight of the past in the limit's unit"),
        "largest_ratio": Key(number(1), "factor by which that may differ from the article's"),
    },
    "WCSACLoss": {
        **_SAC,
        **_COST_CRITICS,
        "tail": Key(number(0, 1, above=True), "share of the worst cost returns"),
    },
    "TD3Loss": _TD3,
    "TD3LagrangianLoss": {**_TD3, **_COST_CRITICS},
    "TRPOLoss": _LOSS,
    "TRPOLagrangianLoss": _LOSS,
    "CPOLoss": _LOSS,
    "RCPOLoss": _CLIPPED_LOSS,
    "P3OLoss": {
        **_CLIPPED_LOSS,
        "kappa": Key(NOT_NEGATIVE, "penalty factor κ"),
        "gamma": Key(optional(SHARE), "discount: violations weigh 1 - gamma; null: 1/T̄"),
    },
    "IPOLoss": {
        **_CLIPPED_LOSS,
        "kappa": Key(_STRENGTH, "strength κ of the barrier"),
        "max_weight": Key(_STRENGTH, "weight of costs at the limit and beyond"),
    },
    "FOCOPSLoss": {
        **_LOSS,
        "temperature": Key(_STRENGTH, "β, the trust region's multiplier"),
        "max_state_kl": Key(POSITIVE, "KL divergence beyond which a state is ignored"),
    },
    "CUPLoss": {
        **_LOSS,
        "gamma": Key(number(0, 1, below=True), "discount of the cost advantages"),
        "lmbda": Key(SHARE, "λ of their generalised advantage estimation"),
    },
}
"""Of the package's losses by class; `PARTS` holds them, too."""
