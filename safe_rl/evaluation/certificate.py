"""The result of certifying a run, and how it is told."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from safe_rl.evaluation.settings import CertificateOptions
from safe_rl.runs.folder import checkpoint_steps
from safe_rl.scores.bounds import rounded_up
from safe_rl.scores.certificate import Verdict


@dataclass(frozen=True)
class Certificate:
    """The result of certifying a run.

    Attributes:
        checkpoint: The policy that is certified, or None.
        episode_return: Its mean return in further episodes.
        verdict: Bounds, tests and shortfalls.
        options: Options of the test.
        means: Name -> mean in further episodes, of which none has decided when the test ended.
        further: Number of these episodes.
        test: Number of this test of the run; the level holds for all of them together.
        fewest: Number of episodes below which no test with these options can succeed.
    """

    checkpoint: Path | None
    episode_return: float
    verdict: Verdict
    options: CertificateOptions
    means: Mapping[str, float] = field(default_factory=dict)
    further: int = 0
    test: int = 1
    fewest: float = 1

    def __str__(self) -> str:
        """What is certified, and what the bounds do not cover: a line for every bound."""
        verdict = self.verdict
        level = f"at {100 * self.options.level:.12g}%"
        actions = f"with {'mean' if self.options.deterministic else 'sampled'} actions"
        episodes = f"{verdict.episodes:,} new episodes"
        if self.test > 1:
            episodes += f", test {self.test} of this run; the level is that of all its tests"
        if not verdict.tested:
            return f"Not tested {level} {actions}: {self._episodes_needed_text()}"
        if self.checkpoint is None:
            missing = "; ".join(self._bound_text(name) for name in verdict.shortfalls)
            return (
                f"Not certified {level} {actions}: no checkpoint's bound is within its limit "
                f"({missing}; {episodes})."
            )
        head = f"Certified {level} {actions}"
        if set(verdict.by_construction) == set(verdict.bounds):
            head = f"Limit kept {actions}"
        elif len(verdict.bounds) > 1:
            head += ", all bounds together"
        lines = [self._bound_text(name) for name in verdict.bounds]
        after = f"{checkpoint_steps(self.checkpoint):,} steps, return {self.episode_return:.2f}"
        if len(lines) == 1:
            mean_cost = next(iter(self.means.values()), math.nan)
            mean = f", mean {mean_cost:.3g} in {self.further} further episodes, at {after}"
            return f"{head}: {lines[0]} ({episodes}){mean}. {self._not_covered_text()}"
        rows = [
            f"  {line}, mean {self.means.get(name, math.nan):.3g}"
            for name, line in zip(verdict.bounds, lines, strict=True)
        ]
        head += f" ({episodes}; means of {self.further} further episodes; at {after}):"
        return "\n".join([head, *rows, self._not_covered_text()])

    @property
    def may_need_training(self) -> bool:
        """Whether a policy of more training could be certified: every mean can have a bound."""
        bounds = [bound for bound, _ in self.verdict.bounds.values()]
        return bool(self.verdict.tested) and all(map(math.isfinite, bounds))

    def _bound_text(self, name: str) -> str:
        bound, limit = self.verdict.bounds[name]
        if math.isinf(bound):
            return f"{name} has no bound: costs are NaN, or above those that the specs allow"
        why = " by construction" if name in self.verdict.by_construction else ""
        return f"{name} ≤ {rounded_up(bound):.3g}{why}, limit {limit:g}"

    def _episodes_needed_text(self) -> str:
        if math.isinf(self.fewest):
            return "no number of episodes can show this: the limit leaves no room below it."
        return (
            f"{self.options.episodes:,} episodes never suffice: at least {self.fewest:,.0f} are "
            "needed, even if none costs anything, and several times that as a rule "
            "(certificate.episodes=…)."
        )

    def _not_covered_text(self) -> str:
        sentences = []
        for name in self.verdict.bounds:
            if name.startswith("beyond_"):
                cap, _, key = name.removeprefix("beyond_").partition("_")
                sentences.append(
                    f"The mean of {key} is that of costs up to {cap}; {name} is the share of "
                    "episodes that cost more."
                )
        if not sentences:
            most = ", ".join(f"{value:,.4g}" for value in self.verdict.highest.values())
            sentences.append(f"The bound includes rare episodes that cost up to {most}.")
        return " ".join([*sentences, "Not covered: single episodes, other environments."])


def has_options(content: Mapping[str, Any], options: CertificateOptions) -> bool:
    """Whether a test with these options wrote this content of ``certificate.json``.

    Options that the file of an earlier version lacks count as equal.
    """
    # in the file ``episodes`` is the number that the test needed
    written = {**content, "episodes": content.get("most_episodes", options.episodes)}
    return all(written.get(name, value) == value for name, value in asdict(options).items())
