"""Load the environment and the trained policy of a run from its folder.

A run is continued and evaluated with the robot that it began with, even if the user's file, which
the configuration names, has changed.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from tensordict.nn import TensorDictModuleBase
from torchrl.checkpoint import CheckpointError
from torchrl.envs import EnvBase

from safe_rl.algorithms.algorithm_contract import find_algorithm
from safe_rl.envs import ConfigError, ConstrainedEnv, make_env
from safe_rl.envs.safety_gym.robots import copy_robot, fingerprint, is_robot, own_robot
from safe_rl.files import check_no_links, printable, read_json, replace_json
from safe_rl.naming import did_you_mean
from safe_rl.runs.checkpoints import CheckpointStore, check_interface
from safe_rl.runs.run import Run


def override_env(config: DictConfig, overrides: Mapping[str, Any]) -> dict[str, Any]:
    """The run's environment with some keys changed; in a mapping, only the named entries change.

    Raises:
        ValueError: If a custom environment lacks a key, which it would ignore. The package's own
            environments check their keys later.
    """
    target = str(config.env.get("_target_", "safe_rl."))
    known = [key for key in config.env if key not in ("_target_", "name")]
    for key in () if target.startswith("safe_rl.") else overrides:
        if key not in config.env:
            raise ValueError(
                f"env.{key}: {target} has no such key.{did_you_mean(key, known)} The run has "
                f"{', '.join(known) or 'none'}."
            )
    changed = OmegaConf.merge(config.env, dict(overrides))
    return OmegaConf.to_container(changed)  # type: ignore[return-value]


def transforms_of(config: DictConfig) -> dict[str, Any]:
    """Configuration of the run's transforms, by name; runs of older versions have none."""
    return OmegaConf.to_container(config.get("transforms") or OmegaConf.create(), resolve=True)  # type: ignore[return-value]


def keep_robot(run: Run, env: Mapping[str, Any]) -> None:
    """Note which custom robot a run begins with, and copy its files.

    If the files cannot be copied, the note has their hash only, and the reason is printed.
    """
    robot = own_robot(env)
    if robot is None:
        return
    shutil.rmtree(run.robot_folder, ignore_errors=True)
    note = {"robot_base": env["robot_base"], "sha256": fingerprint(robot), "file": None}
    try:
        note["file"] = str(copy_robot(robot, run.robot_folder).relative_to(run.robot_folder))
    except ConfigError as error:
        shutil.rmtree(run.robot_folder, ignore_errors=True)
        reason = printable(str(error))
        print(f"{reason} The run keeps no copy of its robot: it needs that file as it is now.")
    replace_json(run.robot_file, note)


def robot_of(run: Run, env: DictConfig | Mapping[str, Any]) -> dict[str, Any]:
    """Return an environment's node, resolved, with the robot that a run began with.

    A node that names another robot, or a run that has not begun, changes nothing.

    Raises:
        ConfigError: If the file of the robot is gone, or has changed.
    """
    node: Any = OmegaConf.to_container(env, resolve=True) if OmegaConf.is_config(env) else {**env}
    if not run.robot_file.is_file():
        return node
    note = read_json(run.robot_file)
    if not (isinstance(note, dict) and {"robot_base", "sha256", "file"} <= note.keys()):
        raise ConfigError(f"{run.robot_file} is not as a run writes it.")
    if note["robot_base"] != node.get("robot_base"):
        return node
    original, content = own_robot(node), note["sha256"]
    path = run.robot_folder / str(note["file"]) if note["file"] else original
    if path is None or not path.is_file():
        raise ConfigError(f"'robot_base': there is no file {path}, with which the run began.")
    if note["file"]:
        check_no_links(run.robot_folder)  # MuJoCo would wait for a pipe
    home = run.robot_folder if note["file"] else Path(path.anchor or ".")
    if not is_robot(path, home, content):
        raise ConfigError(f"'robot_base': {path} has changed since the run began.")
    return {**node, "robot_base": str(path)}


def maker_of(run: Run) -> Callable[..., ConstrainedEnv]:
    """`safe_rl.make_env` for evaluations of a run, with its robot and its transforms."""
    given: dict[str, Any] = {"transforms": transforms_of(run.config), "evaluating": True}
    return lambda node, **options: make_env(robot_of(run, node), **given, **options)


def load_policy(
    config: DictConfig, env: EnvBase, checkpoint: Path, device: torch.device
) -> TensorDictModuleBase:
    """Build the run's policy and give it the weights of a checkpoint.

    Only weights are read: neither the checkpoint nor the configuration can make code run. No weight
    requires gradients, so that rollouts can be converted to NumPy arrays directly.

    Raises:
        CheckpointError: If the file is no checkpoint, its policy does not fit the environment, or
            has weights that are not finite.
    """
    policy, networks = find_algorithm(config).build_policy(config, env, device)
    try:
        CheckpointStore.load(checkpoint, networks)
    except CheckpointError as error:
        if "size mismatch" not in str(error):
            raise
        raise CheckpointError(
            f"The policy in {checkpoint} was trained on other observations or actions than this "
            "environment's: undo the env.… override that changes them."
        ) from error
    check_interface(checkpoint, env.interface)
    for network in networks.values():
        if not all(weight.isfinite().all() for weight in network.parameters()):
            raise CheckpointError(
                f"The policy in {checkpoint} has weights that are NaN or infinite: its training "
                "has diverged."
            )
    return policy.eval().requires_grad_(False)
