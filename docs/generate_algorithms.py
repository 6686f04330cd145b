"""Makes the pages of the algorithms, and of results, from what the program itself says.

``python docs/generate_algorithms.py`` writes docs/algorithms/<name>.md and comparison.md: settings
from conf/, their meanings from the table of keys, what is logged from docs/algorithms/index.md,
figures from results/, the rest from docs/algorithms/pages.yaml; and docs/environments/velocity.md.
Runs get into results/algorithms/ by ``python -m safe_rl.report RUNS archive=results/algorithms``.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import replay_pages
import yaml
from algorithm_results import comparison, measured
from hydra import compose, initialize_config_dir
from omegaconf import DictConfig, OmegaConf
from setting_tables import own_parts, setting_table
from velocity_results import velocity_page

from safe_rl.cli.conf import CONF
from safe_rl.targets import accepted_names, locate

ROOT = Path(__file__).resolve().parents[1]
PAGES = ROOT / "docs" / "algorithms"
TEXTS: dict[str, dict[str, Any]] = yaml.safe_load((PAGES / "pages.yaml").read_text())
GENERATED = "<!-- made by docs/generate_algorithms.py: change pages.yaml, conf/ or results/ -->"
# what the live arguments are called here
LIVE = ("actor_network", "multiplier", "constraints", "cost_limits")
OPTIONAL = ("columns", "loop", "problem", "measured")  # of a page, that others can stand for
SHOWN = {"actor_network": "actor", "cost_limits": "limits"}

TEMPLATE = """{mark}
# {title}

`algo={name}` · {source}

**Problem.** {problem}

$$
{equation}
$$

{how}

{notation}

## Settings

{keys}

{shared}{limits}.

## What is logged

Besides the columns that [all algorithms](index.md#what-is-logged) have:

{columns}

## In a loop of your own

{parts}

```python
{snippet}
```

## Measured

{measured}

## Deviations from the article and from published code

{deviations}

## Known weaknesses

{weaknesses}
"""

LOSS = {
    "notation": "Notation, batches, advantages and critics: [overview](index.md#one-epoch).",
    "shared": "Shared by all algorithms: [presets](index.md#presets)",
    "parts": "The loss takes any TorchRL policy and any batch with advantages, such as those of "
    "`VectorGAE` and\n`CostGAE`.",
}
STEP = LOSS | {"parts": LOSS["parts"].replace("loss takes", "loss and the step take")}
REPLAY = {
    "notation": "Notation, targets, time-outs and multipliers: "
    "[off-policy algorithms](../off_policy.md#what-is-learned).",
    "shared": "Shared by all off-policy algorithms: [keys](../off_policy.md#keys)",
    "parts": "The loss takes any transitions, from a replay buffer or a dataset, and networks of "
    "your own.",
}


def pages() -> dict[str, str]:
    """All pages by file, below docs/."""
    written = {f"algorithms/{name}.md": _page(name) for name in TEXTS}
    # what has a text of its own learns from something else, and is not compared
    compared = [name for name, texts in TEXTS.items() if "measured" not in texts]
    written["algorithms/comparison.md"] = f"{GENERATED}\n{comparison(compared)}"
    return written | {"environments/velocity.md": velocity_page()}


def _page(name: str) -> str:
    texts = TEXTS[name]
    config, paper = (_compose(name, preset) for preset in ("default", "paper"))
    constrained = bool({"constrained", "costs"} & set(texts["columns"]))
    within = r" subject to $J_{c_i}(\pi) \le d_i$, $i = 1 \dots k$, undiscounted costs per episode"
    problem = r"$\max_\pi J_r(\pi)$" + (within if constrained else "")
    is_step = "lr" not in OmegaConf.to_yaml(config.policy_update)
    if replay_pages.learns_from_memory(config):
        snippet = replay_pages.loop(config, _by_path(config), _call, texts.get("loop", ""))
        frame = REPLAY
    else:
        snippet = _snippet(config, is_step, constrained)
        frame = STEP if is_step else LOSS
    return TEMPLATE.format(
        **frame,
        mark=GENERATED,
        name=name,
        problem=f"{texts.get('problem', problem).strip()}.",
        keys=setting_table(config, paper),
        limits=", [holding the limit](holding_the_limit.md)" if constrained else "",
        columns=_columns(texts["columns"]),
        snippet=snippet,
        measured=str(texts.get("measured") or measured(name)).strip(),
        **{key: str(texts[key]).strip() for key in texts if key not in OPTIONAL},
    )


def _compose(algo: str, preset: str) -> DictConfig:
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", [f"algo={algo}", f"preset={preset}", "env=gymnasium"])


def _by_path(config: DictConfig) -> dict[str, tuple[str, dict[str, Any]]]:
    return {path: (target, arguments) for path, target, arguments in own_parts(config)}


def _columns(names: list[str]) -> str:
    index = (PAGES / "index.md").read_text() + (PAGES.parent / "off_policy.md").read_text()
    tables = [
        re.search(rf"<!-- table: columns of {name} -->\n(.*?)\n\n", index, re.DOTALL)[1]  # type: ignore[index]
        for name in names
    ]
    rows = [row for table in tables for row in table.splitlines()[2:]]
    text = "\n".join(["| column | meaning |", "|---|---|", *rows])
    return (
        text.replace("(#", "(index.md#").replace("(algorithms/", "(").replace("(../../", "(../../")
    )


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


def _snippet(config: DictConfig, is_step: bool, constrained: bool) -> str:
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
        known = "    multiplier.update(mean_costs)\n"
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


if __name__ == "__main__":
    for file, text in pages().items():
        (ROOT / "docs" / file).write_text(text)
