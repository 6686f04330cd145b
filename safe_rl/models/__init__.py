"""Networks: actors, critics, and the fast policy that explores."""

from safe_rl.models.behaviour import BehaviourPolicy, make_behaviour
from safe_rl.models.networks import make_actor, make_critic
from safe_rl.models.scaling import InputScale, input_scale_vector

__all__ = [
    "BehaviourPolicy",
    "InputScale",
    "input_scale_vector",
    "make_actor",
    "make_behaviour",
    "make_critic",
]
