"""What a trained policy does: whole episodes, estimates with intervals, a video."""

from safe_rl.evaluation.episodes import Episodes, collect_episodes
from safe_rl.evaluation.measuring import Evaluation, evaluate
from safe_rl.evaluation.settings import EvaluationOptions
from safe_rl.evaluation.summary import summarise

__all__ = [
    "Episodes",
    "Evaluation",
    "EvaluationOptions",
    "collect_episodes",
    "evaluate",
    "summarise",
]
