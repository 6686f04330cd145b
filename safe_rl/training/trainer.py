"""The training loop: collect a batch, compute episode statistics, learn, record."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from signal import Signals
from typing import Any

import numpy as np
import torch
from tensordict import TensorDictBase
from torchrl.collectors import Collector
from torchrl.envs import EnvBase

from safe_rl.algorithms.algorithm_contract import Algorithm, Stateful
from safe_rl.algorithms.processor_use import fast_products, torch_threads
from safe_rl.checks import SettingError
from safe_rl.collectors import EpisodeAccounting, Recording, WorkerCollector
from safe_rl.runs.checkpoints import CheckpointStore
from safe_rl.runs.table import read_table
from safe_rl.runs.writing import RunWriter
from safe_rl.training.checkpoint_selection import CheckpointSelection
from safe_rl.training.state import (
    EnvSnapshot,
    Progress,
    RandomGenerators,
    catching_signals,
    staggered_steps,
)

# Parts that only the newest checkpoints hold, for resuming: a replay buffer has gigabytes, the
# others are several times as large as a policy.
_FOR_RESUMING = {"memory", "policy_update", "critic_update", "env", "accounting", "rng"}


Evaluator = Callable[[int, int], dict[str, float]]
"""A periodic evaluation: steps before and after an epoch -> columns, the same ones at each call."""


class Trainer:
    """The training loop of one run.

    Args:
        env: Environment that the collector steps.
        algorithm: The algorithm to train.
        collector: Endless collector of [N, T] batches with the algorithm's policy.
        writer: Writes the files of the run; it has the configuration and the limits of costs.
        evaluation: Periodic evaluation of the policy, called after every epoch, or None.
        recording: Writes every batch to disk, or None.

    Attributes:
        components: The parts of a checkpoint by name.
        snapshot: The state of the environments, which checkpoints have; None if a resumed run
            begins new episodes.
        stopped_by: The signal that has ended the run, if any.
        callbacks: Called after every epoch with its row; one that returns False ends the run.
    """

    def __init__(
        self,
        env: EnvBase,
        algorithm: Algorithm,
        collector: Collector | WorkerCollector,
        *,
        writer: RunWriter,
        evaluation: Evaluator | None = None,
        recording: Recording | None = None,
    ) -> None:
        self.algorithm, self._config = algorithm, writer.config
        self.accounting = EpisodeAccounting(
            env.batch_size.numel(),
            env.cost_keys,
            reward_key=env.return_key,
            device=collector.storing_device,
            longest=env.max_episode_steps,
            steps_per_decision=env.steps_per_decision,
        )
        self.progress, self.writer, self.env = Progress(), writer, env
        self.stopped_by: Signals | None = None
        self.callbacks: Sequence[Callable[[Mapping[str, float]], Any]] = ()
        self.collector, self._is_continued = collector, False
        self._evaluation, self._recording = evaluation, recording
        # the environments of workers are in other processes
        self.snapshot = None
        if isinstance(collector, Collector) and env.get_state() is not None:
            self.snapshot = EnvSnapshot(env, collector)
        self._first_steps = staggered_steps(env) if self._config.get("staggered_starts") else None
        if self._first_steps is not None:
            (self.snapshot or collector).stagger(self._first_steps)
            self.accounting.ignore_open_episodes()
        self._open_checkpoints()

    def _open_checkpoints(self) -> None:
        """Name the parts of a checkpoint, choose those of a policy, and open the run's store."""
        config = self._config
        parts: dict[str, Stateful] = {
            **self.algorithm.checkpoint_components(),
            "accounting": self.accounting,
            "progress": self.progress,
            "rng": RandomGenerators(),
        }
        if self.snapshot is not None:
            parts["env"] = self.snapshot
        self._selection = CheckpointSelection(
            {name: part for name, part in parts.items() if name not in _FOR_RESUMING},
            self.writer.cost_limits,
            over=config.checkpoint.best_over,
            steps_per_epoch=config.frames_per_batch / self.env.batch_size.numel(),
            longest=self.env.max_episode_steps,
        )
        about = {"environment": config.env.name, "algorithm": config.algo.name, "seed": config.seed}
        self.components = {**parts, "candidates": self._selection}
        self._checkpoints = CheckpointStore(
            self.writer.run.checkpoints_folder,
            self.components,
            keep_last=config.checkpoint.keep_last,
            keep_best=config.checkpoint.keep_best,
            run=about,
            interface=lambda: self.env.interface,
        )

    def resume(self) -> bool:
        """Continue the run in the folder from its newest checkpoint; return whether there is one.

        Raises:
            CheckpointError: If no checkpoint can be read, or they do not fit this run.
        """
        self._is_continued = True
        restored = self._checkpoints.resume(self.writer.run.num_rows) is not None
        # a run that starts over has begun its episodes already
        if restored and self.snapshot is None:
            self._begin_episodes()
        return restored

    @property
    def is_finished(self) -> bool:
        """Whether no signal has ended the training before its last step."""
        return self.stopped_by is None or self.progress.steps >= self._config.frames

    def _begin_episodes(self) -> None:
        """Begin new episodes: the state of the environments was not saved."""
        if self._first_steps is None:
            self.accounting.forget_open_episodes()
        else:
            self.accounting.ignore_open_episodes()
        if self._recording is not None:
            self._recording.cut_after(self.progress.epoch - 1)
        self.algorithm.forget_open_episodes()
        self.env.continue_from(self.progress.steps // self.env.batch_size.numel())
        # with the old seed the first episodes of the run would be repeated; workers start later,
        # from the state of this environment
        self.env.set_seed(int(torch.randint(2**31, ())))
        if isinstance(self.collector, Collector):
            self.collector.reset()

    def run(self) -> str:
        """Train for ``frames`` steps, rounded up to whole batches.

        Ctrl-C, SIGTERM or SIGHUP ends the run after the current epoch, with a checkpoint. Then
        ``stopped_by`` is the signal. One line about the outcome is returned.
        """
        try:
            self._train()
        except BaseException:
            self.close()
            raise
        if isinstance(self.collector, WorkerCollector):
            self.collector.shutdown()
        return self.writer.summary()

    def close(self) -> None:
        """Close the collector with its workers, if any, and the environment."""
        self.collector.shutdown(timeout=0.0)
        if not self.env.is_closed:
            self.env.close()

    def _train(self) -> None:
        batches = iter(self.collector)
        saved_at = time.monotonic()
        epoch = self.progress.epoch if self._is_continued else None
        with catching_signals() as signals, self.writer.writing(epoch, self.progress.steps):
            if self._recording is not None:
                # batches after the checkpoint are removed, as rows of the table are
                self._recording.begin(self.progress.epoch)
            if not self.progress.epoch:
                self._checkpoints.begin()
            else:
                table = read_table(self.writer.run.table_file)
                for values in zip(*table.values(), strict=True):
                    self._selection.take(dict(zip(table, values, strict=True)))
                # if the run was shorter before, these were scored by fewer epochs at its end
                self._checkpoints.forget_best(policy["steps"] for policy in self._selection.waiting)
            while self.progress.steps < self._config.frames:
                row = self.epoch(batches)
                self.writer.add(row)
                for policy in self._selection.add(row):
                    self._checkpoints.save_best(**policy)
                answers = [callback(row) for callback in self.callbacks]
                # also the False of NumPy
                if any(isinstance(answer, bool | np.bool_) and not answer for answer in answers):
                    break
                if signals:  # checked after an epoch: every run has at least one
                    break
                if time.monotonic() - saved_at > self._config.checkpoint.interval:
                    self._save()
                    saved_at = time.monotonic()
            self.stopped_by = signals[0] if signals else None
            if self.is_finished:
                # before the last checkpoint is written, which marks the run as finished
                for policy in self._selection.score_all():
                    self._checkpoints.save_best(**policy)
            self._save()

    def epoch(self, batches: Iterator[TensorDictBase]) -> dict[str, float]:
        """Collect a batch [N, T] and learn from it; return the row of the table."""
        start = time.perf_counter()
        # One observation per environment is too little work for several threads, and the physics
        # needs the cores.
        with torch_threads(1):
            batch = next(batches)
            if self.snapshot is not None:
                self.snapshot.take()
        collected, begun = time.perf_counter(), self.accounting.have_begun
        episodes = self.accounting.update(batch)
        if self._recording is not None:
            self._recording.write(self.progress.epoch, batch, begun=begun)
        with fast_products():
            learned = self.algorithm.learn(batch, episodes)
        end = time.perf_counter()
        steps_before = self.progress.steps
        self.progress.epoch += 1
        self.progress.steps += episodes.steps
        self.progress.seconds += end - start
        evaluated: dict[str, float] = {}
        if self._evaluation is not None:
            with torch_threads(1):
                evaluated = self._evaluation(steps_before, self.progress.steps)
        progress = {"epoch": self.progress.epoch, "steps": self.progress.steps}
        times = {
            "time_collect": collected - start,
            "time_learn": end - collected,
            "time_total": self.progress.seconds,
            "steps_per_second": episodes.steps / (end - start),
        }
        before, after = progress | episodes.scalars(), evaluated | times
        if taken := learned.keys() & (before | after).keys():
            raise SettingError(f"algo: 'learn' returned {min(taken)}, which training measures.")
        return before | learned | after

    def _save(self) -> None:
        self._checkpoints.save(self.progress.steps)
        self.writer.draw_curves()
