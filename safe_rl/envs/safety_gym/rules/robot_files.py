"""Files of a robot, read before MuJoCo sees them: what belongs to it, and how large it would get.

Somebody else's file must not stop the process: what would take MuJoCo hours or all memory is
refused from its text.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

from safe_rl.envs.errors import ConfigError

MOST_ELEMENTS = 100_000  # with all copies that are asked for
MOST_CELLS = 1 << 24  # of a height field or a texture
_FOLDERS = ("assetdir", "meshdir", "texturedir")
_CELLS = (("nrow", "ncol"), ("width", "height"))


def fingerprint(path: Path) -> str:
    """Return a hash of the contents of a robot's files.

    Raises:
        ConfigError: if one cannot be read, or asks for too much.
    """
    digest = hashlib.sha256()
    for file in robot_files(path):
        content = file.read_bytes()
        digest.update(f"{len(content)} ".encode() + content)
    return digest.hexdigest()


def robot_files(path: Path) -> list[Path]:
    """Return an MJCF file and all files that it names and that exist, each once.

    Raises:
        ConfigError: if one cannot be read, or asks for too much.
    """
    found: dict[Path, int] = {}
    if _weigh(path, [path.parent], found) > MOST_ELEMENTS:
        raise _refused(path, f"describes more than {MOST_ELEMENTS:,} elements: 'count' is too high")
    return list(found)


def _refused(path: Path, what: str) -> ConfigError:
    return ConfigError(f"'robot_base': {path} {what}.")


def _weigh(path: Path, folders: list[Path], found: dict[Path, int]) -> float:
    """Number of elements of a file with its copies; notes the files that it names.

    The first folder is that of the robot's own file, from which all paths go.
    """
    if path in found:
        return 0
    found[path] = 1
    try:
        root = ElementTree.fromstring(path.read_bytes())
    except (ElementTree.ParseError, OSError, ValueError, RecursionError) as error:
        message = f"'robot_base': MuJoCo cannot load {path}: {error}"
        raise ConfigError(message) from error
    # what is included finds its files where those that include it do
    folders = list(dict.fromkeys([*folders, *_asset_folders(root, folders[0])]))
    return _weight(root, path, folders, found)


def _asset_folders(root: ElementTree.Element, home: Path) -> Iterator[Path]:
    for compiler in root.iter("compiler"):
        for key in _FOLDERS:
            if key in compiler.attrib:
                yield home / compiler.attrib[key]


def _weight(
    element: ElementTree.Element, path: Path, folders: list[Path], found: dict[Path, int]
) -> float:
    """Number of elements that one stands for, itself and copies included."""
    for pair in _CELLS:
        if math.prod(_number(element.get(key, "1")) for key in pair) > MOST_CELLS:
            raise _refused(path, f"has a '{element.tag}' with too large {' and '.join(pair)}")
    inside = 1 + sum(_weight(child, path, folders, found) for child in element)
    for file in [folder / element.get("file", "") for folder in folders if element.get("file")]:
        if file.is_file() and file.suffix == ".xml":
            inside += _weigh(file, folders, found)
        elif file.is_file():
            found.setdefault(file, 1)
    return inside * max(1.0, math.prod(map(_number, element.get("count", "1").split())))


def _number(text: str) -> float:
    """An attribute as a number; what is none is left to MuJoCo to complain about."""
    try:
        number = float(text)
    except ValueError:
        return 1.0
    return math.inf if math.isnan(number) else abs(number)
