"""What is on disk: folder, table, checkpoints, loggers, curves."""
