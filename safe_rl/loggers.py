"""Loggers that know how to go on with a run that was interrupted."""

from __future__ import annotations

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from torchrl.record.loggers.tensorboard import TensorboardLogger as TorchRLTensorboardLogger

__all__ = ["TensorboardLogger"]


class TensorboardLogger(TorchRLTensorboardLogger):
    """TorchRL's TensorBoard logger, for runs that may be continued.

    Examples:
        >>> import tempfile
        >>> logger = TensorboardLogger(exp_name="tensorboard", log_dir=tempfile.mkdtemp())
        >>> logger.continue_from(1000)
        >>> logger.log_scalar("episode_return", 1.0, step=2000)
    """

    def continue_from(self, step: int) -> None:
        """Let TensorBoard forget what was logged after a step."""
        writer = self.experiment._get_file_writer()
        event = Event(step=step + 1, session_log=SessionLog(status=SessionLog.START))
        writer.add_event(event, step=step + 1)
