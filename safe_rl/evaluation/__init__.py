"""What a trained policy does: whole episodes, estimates with intervals, a video."""

from safe_rl.evaluation.certifying import Certificate, CertificateOptions, certify
from safe_rl.evaluation.episodes import Episodes, collect_episodes
from safe_rl.evaluation.measuring import Evaluation, evaluate
from safe_rl.evaluation.settings import EvaluationOptions
from safe_rl.evaluation.summary import summarise

__all__ = [
    "Certificate",
    "CertificateOptions",
    "Episodes",
    "Evaluation",
    "EvaluationOptions",
    "certify",
    "collect_episodes",
    "evaluate",
    "summarise",
]
