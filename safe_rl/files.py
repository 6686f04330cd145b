"""Files of a run: read without trusting them, written atomically. All functions may raise OSError.

This is directly in ``safe_rl/``, because several folders write files of a run.
"""

from __future__ import annotations

import csv
import gzip
import json
import os
import re
import secrets
import stat
import sys
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any
from zipfile import ZipFile

import yaml

_PACKAGED = Path(__file__).parent / "conf"
CONF = _PACKAGED if _PACKAGED.is_dir() else Path(__file__).parents[1] / "conf"
"""Folder of ``config.yaml`` and the groups: of a checkout, or the copy in an installed package."""

PROGRAM = "safe-rl train" if CONF == _PACKAGED else "python train.py"
"""The command that trains: of an installed package, or in the folder of a checkout."""

# Largest size of a configuration or notes [bytes]; those of a run have about ten thousand.
_MOST_BYTES = 1_000_000
# Largest depth of a configuration; a run's is six. The C parser overflows the stack at about ten
# thousand.
_MOST_LEVELS = 100


_CONTROLS = re.compile(r"[\x00-\x08\x0b-\x1f\x7f-\x9f]")


def printable(text: str) -> str:
    r"""A text of unknown origin for the terminal, which control characters could change.

    Examples:
        >>> printable("red\x1b[31m")
        'red?[31m'
    """
    return _CONTROLS.sub("?", text)


def all_printable(content: Any) -> Any:
    r"""Plain containers whose texts, also keys, are `printable`.

    Examples:
        >>> all_printable({"a\x1b": ["\x07", 3]})
        {'a?': ['?', 3]}
    """
    if isinstance(content, dict):
        return {all_printable(key): all_printable(value) for key, value in content.items()}
    if isinstance(content, list | tuple):
        return type(content)(map(all_printable, content))
    return printable(content) if isinstance(content, str) else content


class _Loader(getattr(yaml, "CSafeLoader", yaml.SafeLoader)):  # type: ignore[misc]
    """Reads YAML in a tenth of OmegaConf's time, and 1e-4 as a number, as OmegaConf does.

    By default PyYAML takes a number with an exponent for a text unless it has a point and a sign.
    """


_WITH_EXPONENT = re.compile(r"[-+]?\d+(_\d+)*(\.[\d_]*)?[eE][-+]?\d+$")
_Loader.add_implicit_resolver("tag:yaml.org,2002:float", _WITH_EXPONENT, [*"-+0123456789"])


def read_bounded(path: Path, most: int = _MOST_BYTES, *, packed: bool = False) -> bytes:
    """Read a regular file of at most ``most`` bytes; if it is ``packed`` by gzip, unpack it.

    Raises:
        ValueError: If it is larger, also after unpacking, or not a regular file: reading a pipe
            could wait forever.
    """
    # without O_NONBLOCK, opening a pipe waits for a writer
    with open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK)) as file:
        about = os.fstat(file.fileno())
        if not stat.S_ISREG(about.st_mode):
            raise ValueError(f"{path.name} is no regular file")
        content = b""
        if about.st_size <= most:
            content = (gzip.GzipFile(fileobj=file) if packed else file).read(most + 1)
    if max(about.st_size, len(content)) > most:
        raise ValueError(f"{path.name} has more than {most:,} bytes")
    return content


def read_text(path: Path) -> str:
    """Read a text file of bounded size, without control characters; errors as `read_bounded`."""
    return printable(read_bounded(path).decode("utf-8", errors="replace"))


def read_json(path: Path) -> Any:
    """Read a JSON file of bounded size, its texts without control characters.

    Raises:
        ValueError: If it is not JSON, is too large, or nested too deeply.
    """
    try:
        return all_printable(json.loads(read_bounded(path)))
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path.name} cannot be read ({error})") from error


def read_yaml(path: Path) -> Any:
    """Read a YAML file as plain dictionaries, lists and values, without aliases.

    Raises:
        ValueError: If it is not YAML, is too large or nested too deeply, or has aliases, with which
            a small file could fill the memory.
    """
    try:
        text, level = read_bounded(path).decode("utf-8"), 0
        # the parser's events need no recursion
        for event in yaml.parse(text, Loader=_Loader):
            if isinstance(event, yaml.AliasEvent):
                raise ValueError("it has YAML aliases, which no run writes")
            level += isinstance(event, yaml.CollectionStartEvent)
            level -= isinstance(event, yaml.CollectionEndEvent)
            if level > _MOST_LEVELS:
                raise ValueError(f"it is nested in more than {_MOST_LEVELS} levels")
        return yaml.load(text, Loader=_Loader)
    # PyYAML looks up a value such as `!!bool perhaps`, which raises a KeyError
    except (yaml.YAMLError, ValueError, LookupError, RecursionError) as error:
        reason = (str(error) or type(error).__name__).splitlines()[0]
        raise ValueError(f"{path.name} cannot be read ({reason})") from error


def read_config(path: Path) -> dict[str, Any]:
    r"""Read a run's configuration, which was resolved before it was saved.

    Interpolations are refused: ``${oc.env:…}`` in a file of another person could copy a secret of
    this machine into a report.

    Raises:
        ValueError: If it is not a mapping whose keys are texts, or has interpolations, control
            characters or aliases.

    Examples:
        >>> path = getfixture("tmp_path") / "config.yaml"
        >>> _ = path.write_text("seed: 3\nmodel: {hidden_sizes: [64, 64]}")
        >>> read_config(path)
        {'seed': 3, 'model': {'hidden_sizes': [64, 64]}}
    """
    config = read_yaml(path)
    if not isinstance(config, dict) or not is_plain(config):
        raise ValueError(
            f"{path.name} is not that of a run: it has to be a mapping without interpolations, "
            "${…}, and without control characters"
        )
    return config


def is_plain(value: Any) -> bool:
    """Whether all texts in a value of YAML have no interpolations and no control characters."""
    if isinstance(value, dict):
        keys_are_texts = all(isinstance(key, str) and is_plain(key) for key in value)
        return keys_are_texts and all(map(is_plain, value.values()))
    if isinstance(value, list):
        return all(map(is_plain, value))
    # control characters could change what a terminal shows, or control it
    return not (isinstance(value, str) and ("${" in value or _CONTROLS.search(value)))


@contextmanager
def replacing(path: Path) -> Iterator[Path]:
    """Yield the path of a new file to write, which replaces ``path`` at the end of the block.

    Readers see the old or the new content, also after an interruption.
    """
    unfinished = path.with_name(f".{path.stem}.{secrets.token_hex(8)}{path.suffix}")
    # must be a new file: a prepared link could lead to another file
    os.close(os.open(unfinished, os.O_CREAT | os.O_EXCL | os.O_WRONLY | os.O_NOFOLLOW, 0o666))
    try:
        yield unfinished
        unfinished.replace(path)
    finally:
        with suppress(OSError):  # if the folder is gone, the error of the block is reported
            unfinished.unlink(missing_ok=True)


def replace_text(path: Path, text: str) -> None:
    """Write a text file by `replacing`."""
    with replacing(path) as unfinished:
        unfinished.write_text(text, encoding="utf-8")


def replace_json(path: Path, content: Any) -> None:
    """Write a JSON file by `replacing`; numbers that are not finite become null."""
    plain = json.loads(json.dumps(content, default=dict), parse_constant=lambda _: None)
    replace_text(path, json.dumps(plain, indent=2, ensure_ascii=False) + "\n")


def replace_csv(path: Path, rows: Iterable[Iterable[Any]]) -> None:
    """Write a CSV file by `replacing`; the first row is the header."""
    with replacing(path) as unfinished, unfinished.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def save_tensors(path: Path, content: Mapping[str, Any]) -> None:
    """Write tensors, numbers, texts and plain containers by `torch.save` and `replacing`."""
    import torch  # imported here: help and configurations are shown without torch

    try:
        with replacing(path) as unfinished:
            torch.save(content, unfinished)
    except RuntimeError as error:  # torch raises it for any failure to write
        reason = str(error).splitlines()[0]
        raise OSError(f"{path} cannot be written; is the disk full? ({reason})") from error


def load_tensors(path: Path, *, lazy: bool = False) -> Any:
    """Read a file of `save_tensors` into main memory, also of another person; no code in it is run.

    With `lazy`, tensors are read only when they are used, without a check of the file.

    Raises:
        ValueError: If the file cannot be read.

    Examples:
        >>> path = getfixture("tmp_path") / "state.pt"
        >>> save_tensors(path, {"steps": 3})
        >>> load_tensors(path)
        {'steps': 3}
    """
    import torch

    try:
        if not path.is_file():
            raise ValueError("there is no such file")
        with ZipFile(path) as archive:
            parts = archive.filelist
            if any(p.compress_type or p.file_size > p.compress_size for p in parts):
                raise ValueError("it has compressed parts, which could fill the memory")
            if not lazy and (part := archive.testzip()) is not None:
                raise ValueError(f"its part {part} is damaged")
        # who loads a state copies it to a device of this machine; the writer's may not exist here
        return torch.load(path, map_location="cpu", weights_only=True, mmap=lazy)
    except Exception as error:  # a file of unknown origin can be wrong in any way
        words = " ".join(str(error).split()) or type(error).__name__
        if "weights_only" in words:  # torch's message advises to turn off this protection
            words = "it holds more than tensors, numbers and plain containers"
        raise ValueError(words) from error


def check_no_links(folder: Path) -> None:
    """Refuse a folder that holds anything but files and folders.

    Files written or removed through links could lie anywhere, and opening a pipe waits. The path of
    the folder itself may have links. ``wandb/`` may hold links, because Weights & Biases makes
    some, and nothing else writes there. A ValueError names the first link or pipe.
    """
    for place, folders, files in os.walk(folder):
        for path in (Path(place, name) for name in (*folders, *files)):
            with suppress(FileNotFoundError):  # removed meanwhile
                mode = path.lstat().st_mode
                if stat.S_ISLNK(mode):
                    raise ValueError(
                        f"{path} is a link: nothing is written or removed where links could lead "
                        "out of the folder. Replace it by what it points to, or remove it."
                    )
                if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
                    raise ValueError(f"{path} is no regular file: remove it.")
        if "wandb" in folders and Path(place) == folder:
            folders.remove("wandb")


def check_place(path: Path, otherwise: str) -> None:
    """Raise an OSError, which ends with the advice `otherwise`, if a file cannot be written."""
    if path.is_dir():
        raise IsADirectoryError(f"{path} is a folder, where a file is to be written. {otherwise}")
    above = next(folder for folder in path.parents if folder.exists())
    if not above.is_dir():
        raise NotADirectoryError(f"{path} cannot be written: {above} is no folder. {otherwise}")
    if not os.access(above, os.W_OK | os.X_OK):
        raise PermissionError(f"{path} cannot be written: {above} is read-only. {otherwise}")


def print_line(line: object) -> None:
    """Print a line, unless nobody reads it: a closed terminal, or `| head`, ends no command."""
    try:
        print(line, flush=True)
    except OSError:
        # Python would flush the buffered line again at exit, and change the exit status
        sys.stdout = open(os.devnull, "w")  # noqa: SIM115
