"""Networks: actors, critics, and the fast policies that explore."""

from safe_rl.models.behaviour import BehaviourPolicy, make_behaviour
from safe_rl.models.bounded_actors import make_bounded_actor, make_squashed_actor
from safe_rl.models.building import build_networks
from safe_rl.models.exploring import ExploringPolicy
from safe_rl.models.networks import make_actor, make_critic
from safe_rl.models.normalising import RunningScale, take_in
from safe_rl.models.q_networks import EnsembleMLP, QEnsemble
from safe_rl.models.scaling import InputScale, input_scale_vector

__all__ = [
    "BehaviourPolicy",
    "EnsembleMLP",
    "ExploringPolicy",
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
    "take_in",
]
