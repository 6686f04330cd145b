"""Evaluation of a trained policy: whole episodes, estimates, certificates, videos."""

from typing import TYPE_CHECKING

from safe_rl.evaluation.settings import CertificateOptions, EvaluationOptions
from safe_rl.extras import import_later

if TYPE_CHECKING:
    from safe_rl.evaluation.certificate import Certificate
    from safe_rl.evaluation.certifying import certify
    from safe_rl.evaluation.episodes import Episodes, collect_episodes
    from safe_rl.evaluation.measuring import Evaluation, evaluate, summarise

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

__getattr__, __dir__ = import_later(
    __name__,
    {
        "certificate": ["Certificate"],
        "certifying": ["certify"],
        "episodes": ["Episodes", "collect_episodes"],
        "measuring": ["Evaluation", "evaluate", "summarise"],
    },
)
