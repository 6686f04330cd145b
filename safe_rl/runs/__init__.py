"""The files of a run: folder, table, checkpoints, loggers, curves."""
