"""Layouts: where the objects of each kind stand at the reset."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np

_PLURAL = {name: name + "s" for name in ("wall", "button", "hazard", "vase", "pillar", "gremlin")}


def by_kind(layout: Mapping[str, object]) -> dict[str, np.ndarray]:
    """Groups the positions of a layout by kind.

    Args:
        layout: object names (`vase0`, `goal`, ...; one position each) or kinds (`vases`, `goal`,
            ...; [K, 2]) to positions in the plane [m].

    Returns:
        Kind (`walls`, `vases`, `goal`, ...) to positions [K, 2] in the order of the numbers.
    """
    found: dict[str, list[tuple[int, np.ndarray]]] = {}
    for name, position in layout.items():
        kind, number = re.fullmatch(r"([a-z]+)(\d*)", name).groups()
        rows = np.asarray(position, dtype=float).reshape(-1, 2)
        numbered = [(int(number or 0) + i, row) for i, row in enumerate(rows)]
        found.setdefault(_PLURAL.get(kind, kind), []).extend(numbered)
    return {
        kind: np.array([row for _, row in sorted(rows, key=lambda r: r[0])]).reshape(-1, 2)
        for kind, rows in found.items()
    }
