"""Where the configurations are: ``conf/`` of a checkout, or the copy in an installed package."""

from pathlib import Path

__all__ = ["CONF"]

_PACKAGED = Path(__file__).parents[1] / "conf"

CONF = _PACKAGED if _PACKAGED.is_dir() else Path(__file__).parents[2] / "conf"
"""Folder of ``config.yaml`` and the groups."""
