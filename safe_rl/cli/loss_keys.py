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
    "clip_epsilon": Key(number(0, 1000, above=True), "half-width of the ratios that earn"),
}
_Q_FUNCTIONS = {
    "gamma": Key(SHARE, "discount per step"),
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
    "policy_noise": Key(NOT_NEGATIVE, "deviation of the noise on the target policy's actions"),
    "noise_clip": Key(NOT_NEGATIVE, "bound of that noise"),
}
_COST_CRITICS = {
    "pessimism": Key(number(), "standard deviations among cost critics on top of their mean"),
    "target_pessimism": Key(
        optional(number()), "the same for what they bootstrap on; null: each on its own target"
    ),
    "lowest_cost_value": Key(
        optional(number()), "lower bound of what they bootstrap on, if no cost is below it"
    ),
}

LOSSES = {
    "PPOLoss": _CLIPPED_LOSS,
    "PPOLagrangianLoss": {
        **_CLIPPED_LOSS,
        "cost_clipping": Key(choice("none", "pessimistic", "joint"), "how cost surrogates are cut"),
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
        "tail": Key(number(0, 1, above=True), "share of the worst cost-returns"),
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
        "gamma": Key(optional(SHARE), "discount that weighs the violation; null: 1/T̄ does"),
    },
    "IPOLoss": {
        **_CLIPPED_LOSS,
        "kappa": Key(_STRENGTH, "strength κ of the barrier"),
        "max_weight": Key(_STRENGTH, "weight of costs at the limit and beyond"),
    },
    "FOCOPSLoss": {
        **_LOSS,
        "temperature": Key(_STRENGTH, "β, the trust region's multiplier"),
        "max_state_kl": Key(POSITIVE, "KL divergence beyond which a state teaches nothing"),
    },
    "CUPLoss": {
        **_LOSS,
        "gamma": Key(number(0, 1, below=True), "discount of the cost advantages"),
        "lmbda": Key(SHARE, "decay of their TD errors"),
    },
}
"""Of the package's losses by class; `PARTS` holds them, too."""
