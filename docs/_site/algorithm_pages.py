"""What the pages of the algorithms show of the program itself: settings, columns, a loop.

A page is written by hand and has marks where these go: `<!-- made: settings cpo -->`.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import replay_loops
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from setting_tables import own_parts, setting_table

from safe_rl.algorithms.build_part import find_algorithm
from safe_rl.files import CONF
from safe_rl.parameters import accepted_names
from safe_rl.trust import locate

DOCS = Path(__file__).resolve().parents[1]
# what the live arguments are called here
LIVE = ("actor_network", "multiplier", "constraints", "cost_limits")
SHOWN = {"actor_network": "actor", "cost_limits": "limits"}


def settings(algo: str) -> str:
    """Keys of the algorithm's own parts, their values in the presets and their meanings."""
    return setting_table(*(_compose(algo, preset) for preset in ("default", "paper")))


def listed(recipe: str) -> str:
    """Problem, policy step and source of the algorithms of a recipe, as their pages say."""
    rows = []
    for page in sorted((DOCS / "algorithms").glob("*.md")):
        algo, text = page.stem, page.read_text()
        short = re.search(r"^<!-- row: (.*) -->$", text, re.M)
        if short and find_algorithm(_compose(algo, "default")).__name__ == recipe:
            source = re.search(r"^`algo=\w+` · (.*)$", text, re.M)[1]  # type: ignore[index]
            rows.append(f"| [`{algo}`]({page.name}) | {short[1]} | {source} |")
    heads = "| `algo=` | problem it solves | policy step | source |\n|---|---|---|---|"
    return "\n".join([heads, *rows])


def columns(names: str) -> str:
    """Rows of the tables of columns.md, named by `<!-- table: columns of … -->`."""
    text = (DOCS / "algorithms" / "columns.md").read_text() + "\n"
    tables = [
        re.search(rf"<!-- table: columns of {name} -->\n(.*?)\n\n", text, re.DOTALL)[1]  # type: ignore[index]
        for name in names.split()
    ]
    rows = [row for table in tables for row in table.splitlines()[2:]]
    return "\n".join(["| column | meaning |", "|---|---|", *rows])


def loop(told: str) -> str:
    """A training loop of one's own: the algorithm's name, then a line that its loss needs."""
    algo, _, line = told.partition(": ")
    config = _compose(algo, "default")
    if replay_loops.is_off_policy(config):
        made = replay_loops.loop(config, _by_path(config), _call, line)
    else:
        made = _snippet(config)
    return f"```python\n{made}\n```"


def _compose(algo: str, preset: str) -> DictConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", [f"algo={algo}", f"preset={preset}", "env=gymnasium"])


def _by_path(config: DictConfig) -> dict[str, tuple[str, dict[str, Any]]]:
    return {path: (target, arguments) for path, target, arguments in own_parts(config)}


def _call(target: str, arguments: Mapping[str, Any], first: tuple[str, ...] = ()) -> str:
    names = accepted_names(locate(target))
    live = [SHOWN.get(name, name) for name in LIVE if name in names and not first]
    if first and "cost_limits" in names and "limits" not in first:
        first = (*first, "limits")
    settings = [f"{key}={value!r}" for key, value in arguments.items()]
    inside = [*first, *live, *settings]
    line = f"{target.rpartition('.')[2]}({', '.join(inside)})"
    if len(line) < 88:
        return line
    cut = "\n".join(f"    {entry}," for entry in inside)
    return f"{target.rpartition('.')[2]}(\n{cut}\n)"


def _snippet(config: DictConfig) -> str:
    constrained = config.get("cost_advantage") is not None
    is_step = "lr" not in OmegaConf.to_yaml(config.policy_update)
    parts = _by_path(config)
    targets = [parts["loss"][0]]
    lines = ['limits = {"cost": 25.0}'] if constrained else []
    names = accepted_names(locate(parts["loss"][0]))
    lines.append(
        "actor = make_actor(3, 2, hidden_sizes=[64, 64], initial_log_std=-0.5)  # or yours"
    )
    known, violated = "", "mean_costs - torch.tensor(list(limits.values()))"
    if "lagrangian" in parts:
        target, arguments = parts["lagrangian"]
        targets.append(target)
        lines.append(f"multiplier = {_call(target, arguments, ('limits',))}")
        known = "    multiplier.update(mean_costs - multiplier.limits)\n"
    elif "constraints" in names:
        targets.append("safe_rl.algorithms.Constraints")
        lines.append("constraints = Constraints(limits)")
        known = (
            "    constraints.violation.copy_(mean_costs - constraints.limits)\n"
            "    constraints.episode_length.fill_(1000.0)\n"
        )
    losses = [("loss", "optimizer")]
    lines.append(f"loss = {_call(*parts['loss'])}")
    if "then.projection.loss" in parts:
        targets.append(parts["then.projection.loss"][0])
        lines.append(f"projection = {_call(*parts['then.projection.loss'])}")
        losses.append(("projection", "back"))
    if is_step:
        target, arguments = parts["policy_update"]
        targets.append(target)
        lines.append(f"step = {_call(target, arguments, ('loss',))}")
        given = (
            f", {violated}, torch.tensor(1000.0)"
            if constrained and "lagrangian" not in parts
            else ""
        )
        body = f"{known}    return step(batch{given})"
    else:
        lr = parts["policy_update"][1]["optimizer"]["lr"]
        lines += [f"{adam} = torch.optim.Adam({of}.parameters(), lr={lr})" for of, adam in losses]
        body = known + "\n".join(_passes(of, adam) for of, adam in losses) + "\n    return losses"
    imports = _imports(targets)
    costs = ', batch["cost_advantage"]' if constrained else ""
    values = ", torch.randn(1000, 1)" if constrained else ""
    arguments_of_learn = "batch, mean_costs" if constrained else "batch"
    given_to_learn = "batch, mean_costs=torch.tensor([30.0])" if constrained else "batch"
    setting = "\n".join(lines)
    # the package first: it tells torch's threads not to spin
    return f"""{imports}

import torch
from tensordict import TensorDict

{setting}


def learn({arguments_of_learn}):
{body}


with torch.no_grad():  # a collector's batch
    batch = actor(TensorDict(observation=torch.randn(1000, 3), batch_size=[1000]))
batch["advantage"]{costs} = torch.randn(1000, 1){values}
assert learn({given_to_learn})["kl"] < 0.1"""


def _passes(loss: str, optimizer: str) -> str:
    anchored = f"    {loss}.anchor(batch)  # from where the first step has led\n"
    first = anchored if optimizer == "back" else ""
    return f"""{first}    for minibatch in batch.split(250):
        losses = {loss}(minibatch)
        {optimizer}.zero_grad()
        sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
        {optimizer}.step()"""


def _imports(targets: list[str]) -> str:
    rooms: dict[str, set[str]] = {"safe_rl.models": {"make_actor"}}
    for target in targets:
        room, _, name = target.rpartition(".")
        rooms.setdefault(room, set()).add(name)
    return "\n".join(
        f"from {room} import {', '.join(sorted(rooms[room]))}" for room in sorted(rooms)
    )
