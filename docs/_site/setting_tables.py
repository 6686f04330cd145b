"""Tables of an algorithm's settings for its page: key, values in the presets, meaning."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any

import replay_loops
from omegaconf import DictConfig, OmegaConf

from safe_rl.parameters import read_part

# nodes of a configuration that are an algorithm's own
NODES = ("loss", "policy_update", "lagrangian", "then.projection.loss")
NODES += ("then.projection.policy_update", *replay_loops.NODES)


def own_parts(config: DictConfig) -> Iterator[tuple[str, str, dict[str, Any]]]:
    """Path, class and arguments of every part that is the algorithm's own."""
    for path in NODES:
        node = OmegaConf.select(config, path)
        if node is not None:
            plain = OmegaConf.to_container(node, resolve=True)
            target = plain.pop("_target_")
            yield path, target, plain


def setting_table(config: DictConfig, paper: DictConfig) -> str:
    """Table of an algorithm's settings; the paper has none for off-policy ones."""
    if not replay_loops.is_off_policy(config):
        head = ("key", "`preset=default`", "`preset=paper`", "meaning")
        return _table(head, _settings(config, paper))
    rows = [(path, own, meaning) for path, own, _, meaning in _settings(config, config)]
    rows += [(f"`{key}`", _cell(own), what) for key, own, what in replay_loops.settings(config)]
    return _table(("key", "default", "meaning"), rows)


def _settings(config: DictConfig, paper: DictConfig) -> Iterator[tuple[str, str, str, str]]:
    """Path, value in both presets and meaning of all keys of the algorithm's own parts."""
    for path, target, arguments in own_parts(config):
        name = target.rpartition(".")[2]
        other = str(OmegaConf.select(paper, f"{path}._target_"))
        yield f"`{path}._target_`", f"`{name}`", f"`{other.rpartition('.')[2]}`", "the class"
        lacking = _cell(None) if other == target else "—"
        known = read_part(target).settings
        known |= {} if other == "None" else read_part(other).settings
        node = OmegaConf.to_container(
            OmegaConf.select(paper, path) or OmegaConf.create(), resolve=True
        )
        both = [_named(arguments), _named(node)]
        for key in dict.fromkeys([*both[0], *both[1]]):
            meaning = known[key].meaning if key in known else "learning rate of Adam"
            own, theirs = (_cell(part[key]) if key in part else lacking for part in both)
            yield f"`{path}.{key}`", own, theirs, meaning


def _named(arguments: Mapping[str, Any]) -> dict[str, Any]:
    """Arguments as tables show them: of an optimiser its rate, of another part its class."""
    shown: dict[str, Any] = {}
    for key, value in arguments.items():
        if key == "optimizer":
            shown["optimizer.lr"] = value["lr"]
        elif key != "_target_":
            is_part = isinstance(value, Mapping) and "_target_" in value
            shown[key] = value["_target_"].rpartition(".")[2] if is_part else value
    return shown


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(row)} |" for row in (head, *rows)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])


def _cell(value: Any) -> str:
    written = {None: "null", True: "true", False: "false"}
    return f"`{written[value] if value is None or isinstance(value, bool) else value}`"
