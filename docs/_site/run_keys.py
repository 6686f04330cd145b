"""Every key of a run: what it may hold, its default and its meaning, from what checks a command."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator, Mapping
from typing import Any

import yaml
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from tables import table

from safe_rl.cli.schema import KEYS
from safe_rl.envs import store_configs
from safe_rl.files import CONF
from safe_rl.parameters import Parameter, read_part
from safe_rl.ranges import Options, Values, values_of

_HEAD = ("key", "allowed values", "default", "meaning")
# an algorithm of either kind: between them they have every key that is no part's
_OPTIMISER = "torch.optim.Adam"
_ALGORITHMS = ("ppo_lagrangian", "sac_lagrangian")
Defaults = Mapping[str, Mapping[str, Any]]


def run_keys() -> str:
    """Keys with their full paths, then those of the parts, by class."""
    store_configs()
    with initialize_config_dir(str(CONF), version_base="1.3"):
        configs = [compose("config", [f"algo={algo}"]) for algo in _ALGORITHMS]
    general = [
        (f"`{path}`", _words(key.values), _default(configs, path), key.meaning)
        for path, key in KEYS.items()
    ]
    found = _part_defaults()
    parts = [
        f"### {_title(target)}\n\n" + table(_HEAD, _part_rows(keys, found[target]))
        for target in sorted(found, key=_title)
        if (keys := read_part(target).settings)
    ]
    return "\n".join([table(_HEAD, general), "## Parts\n", *parts])


def _words(values: Values) -> str:
    return values.words.replace(values_of(Options).words, "further keys")


def _default(configs: list[DictConfig], path: str) -> str:
    """What the first configuration that has a key holds; nothing for what holds other keys."""
    for config in configs:
        node, _, name = path.rpartition(".")
        within = OmegaConf.select(config, node) if node else config
        if isinstance(within, DictConfig) and name in within:
            value = OmegaConf.select(config, path)
            is_section = any(key.startswith(f"{path}.") for key in KEYS) or path == "replay"
            is_part = isinstance(value, DictConfig) and "_target_" in value
            return "" if is_section or is_part else _cell(value)
    return ""


def _title(target: str) -> str:
    return "torch.optim" if target == _OPTIMISER else target.rpartition(".")[2]


def _part_rows(
    keys: Mapping[str, Parameter], defaults: Defaults
) -> Iterator[tuple[str, str, str, str]]:
    for key, row in keys.items():
        files: dict[str, list[str]] = defaultdict(list)
        for file, node in defaults.items():
            if key in node:
                files[_cell(node[key])].append(file)
        several = len(files) > 1
        shown = ", ".join(
            f"{value} ({', '.join(where)})" if several else value for value, where in files.items()
        )
        yield f"`{key}`", _words(row.values), shown, row.meaning


def _part_defaults() -> Mapping[str, dict[str, Mapping[str, Any]]]:
    """Target -> file of conf/, without its end -> the node that names it; optimisers as one."""
    found: dict[str, dict[str, Mapping[str, Any]]] = defaultdict(dict)
    for path in sorted(CONF.rglob("*.yaml")):
        file = path.relative_to(CONF).with_suffix("").as_posix()
        for node in _nodes(yaml.safe_load(path.read_text())):
            target = str(node["_target_"])
            found[_OPTIMISER if target.startswith("torch.optim.") else target][file] = node
    return found


def _nodes(tree: Any) -> Iterator[Mapping[str, Any]]:
    """All that name a class, from outside to inside."""
    if isinstance(tree, Mapping):
        if tree.get("_target_") not in (None, "???"):
            yield tree
        for value in tree.values():
            yield from _nodes(value)


def _cell(value: Any) -> str:
    if isinstance(value, Mapping | DictConfig) and "_target_" in value:
        return f"`{str(value['_target_']).rpartition('.')[2]}`"
    if isinstance(value, DictConfig) or OmegaConf.is_list(value):
        value = OmegaConf.to_container(value, resolve=True)
    written = {None: "null", True: "true", False: "false"}
    return f"`{written[value] if value is None or isinstance(value, bool) else value}`"
