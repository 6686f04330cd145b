"""Golden transitions of the 2019 reference environments, see golden/README.md."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np

FOLDER = Path(__file__).parent / "golden"
NAMES = sorted(path.stem for path in FOLDER.glob("*.json"))


@dataclass(frozen=True)
class Golden:
    """One pinned configuration and the steps recorded in it; row t + 1 follows from row t."""

    name: str
    config: dict
    components: dict[str, slice]  # columns of the observation
    layout: dict[str, list[float]]  # (x, y) of every object at the reset
    arrays: dict[str, np.ndarray]

    def __getitem__(self, key):
        return self.arrays[key]


def load(name):
    described = json.loads((FOLDER / f"{name}.json").read_text())
    with np.load(FOLDER / f"{name}.npz") as archive:
        arrays = {key: archive[key] for key in archive.files}
    rows = described["observation_layout"]
    return Golden(
        name=name,
        config=described["config"],
        components={row["key"]: slice(row["start"], row["stop"]) for row in rows},
        layout=described["reset_layout"],
        arrays=arrays,
    )
