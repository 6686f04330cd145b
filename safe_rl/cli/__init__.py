"""The commands: training, evaluation, export and reports, and the same functions for Python."""
