"""Networks: actors, critics, and fast policies for data collection."""

from safe_rl.models.build_networks import build_networks
from safe_rl.models.collecting_policies import (
    BehaviourPolicy,
    ExploringPolicy,
    HeldActions,
    make_behaviour,
)
from safe_rl.models.networks import (
    InputScale,
    RunningScale,
    input_scale_vector,
    make_actor,
    make_critic,
    update_running_scales,
)
from safe_rl.models.replay_networks import (
    EnsembleMLP,
    QEnsemble,
    make_bounded_actor,
    make_squashed_actor,
)

__all__ = [
    "BehaviourPolicy",
    "EnsembleMLP",
    "ExploringPolicy",
    "HeldActions",
    "InputScale",
    "QEnsemble",
    "RunningScale",
    "build_networks",
    "input_scale_vector",
    "make_actor",
    "make_behaviour",
    "make_bounded_actor",
    "make_critic",
    "make_squashed_actor",
    "update_running_scales",
]
