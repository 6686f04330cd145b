"""Export of trained policies: as small folders, such as those in the package, and as ONNX."""

from __future__ import annotations

import json
import logging
import shutil
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf
from tensordict import TensorDict
from tensordict.nn import ProbabilisticTensorDictSequential, TensorDictModuleBase
from torch import Tensor, nn
from torchrl.data import Bounded
from torchrl.envs import EnvBase

from safe_rl.evaluation.episodes import exploration
from safe_rl.evaluation.loading import load_policy, transforms_of
from safe_rl.extras import import_extra
from safe_rl.files import check_no_links, read_yaml, replace_json, replacing, save_tensors
from safe_rl.models import BehaviourPolicy, ExploringPolicy, make_behaviour
from safe_rl.naming import did_you_mean
from safe_rl.runs.checkpoints import read_facts, read_states
from safe_rl.runs.folder import checkpoint_name, checkpoint_steps, is_unfinished
from safe_rl.runs.identity import changed_settings, config_dirs, repeating
from safe_rl.runs.run import Run

POLICIES = Path(__file__).parents[1] / "policies"
"""A folder per environment, each with a configuration, a certificate and the policy's weights."""
_PREFIX = "certified"


def find_run(name: str | Path) -> Path:
    """The folder of a run, or of one of the package's policies: ``certified/PointGoal1``.

    Raises:
        FileNotFoundError: If the package has no such policy.
    """
    path = Path(name).expanduser()
    if path.exists() or len(path.parts) != 2 or path.parts[0] != _PREFIX:
        return path
    known = sorted(folder.name for folder in POLICIES.iterdir() if folder.is_dir())
    if path.name not in known:
        hint = did_you_mean(path.name, known) or f" It has {', '.join(known)}."
        raise FileNotFoundError(f"The package has no policy for {path.name}.{hint}")
    return POLICIES / path.name


def writable_copy(directory: Path | str) -> Path:
    """The folder itself, or, if it is part of the package, a copy in the working directory."""
    directory = Path(directory)
    if directory.parent != POLICIES:
        return directory
    copy = Path(_PREFIX, directory.name)
    if not Run(copy).is_run:  # an earlier copy may have results and certificates of the user's own
        shutil.copytree(directory, copy, dirs_exist_ok=True)
    return copy


def pack_policy(run: Path, folder: Path, checkpoint: str = "certified") -> Path:
    """Write what is needed to use a run's policy into a folder of a few dozen kB.

    The folder gets the configuration, the command, the commit, the certificate of a certified
    checkpoint, a custom robot, and the actor's weights. They have the format of all checkpoints,
    which is read without unpickling objects. Returns the file of the weights.

    Raises:
        FileNotFoundError: If there is no such checkpoint.
        FileExistsError: If the folder has other files than an exported policy's.
    """
    check_no_links(run)  # or files that they lead to would be given away
    source, target = Run(run), Run(folder)
    path, config = source.find_checkpoint(checkpoint), source.config
    is_exported = (folder / "policy.json").is_file() and folder.resolve() != run.resolve()
    others = [path for path in folder.glob("*") if not is_unfinished(path)]
    if others and not is_exported:
        raise FileExistsError(f"{folder} has other files: give a new folder for the policy.")
    steps = checkpoint_steps(path)
    is_certified = source.certificate_of(path) is not None
    kept = target.checkpoints_folder / ("certified" if is_certified else "last")
    kept /= checkpoint_name(steps or 0)
    overrides, hydra, composed = (
        read_yaml(file) if file.is_file() else None
        for file in (source.overrides_file, source.hydra_file, source.composed_file)
    )
    changed = changed_settings(composed, source.settings)
    about = {"environment": config.env.get("name", ""), "algorithm": config.algo.name}
    about |= {"steps": steps, "command": repeating(overrides or [], config_dirs(hydra), changed)}
    about["commit"] = source.commit
    # first: an export that was killed can be repeated into its folder
    folder.mkdir(parents=True, exist_ok=True)
    replace_json(folder / "policy.json", about)
    for former in (target.checkpoints_folder, target.robot_folder):
        shutil.rmtree(former, ignore_errors=True)
    kept.parent.mkdir(parents=True)
    for former in target.evaluation_files:  # of a policy that was exported there before
        former.unlink()
    for name in ("config_file", "code_file", "robot_file", "certificate_file"):
        before, copy = getattr(source, name), getattr(target, name)
        copy.unlink(missing_ok=True)
        if before.is_file() and (is_certified or name != "certificate_file"):
            shutil.copyfile(before, copy)
    if source.robot_folder.is_dir() and not source.robot_folder.is_symlink():
        shutil.copytree(source.robot_folder, target.robot_folder, symlinks=True)
    facts = {name: value for name, value in read_facts(path).items() if name != "run"}
    save_tensors(kept, {"facts": facts, "parts": read_states(path, ["actor"])})
    return kept


class _Deployed(nn.Module):
    """Module from observations [N, D] to actions in the environment's own units, [N, A]."""

    _bounds: Tensor

    def __init__(self, policy: TensorDictModuleBase, bounds: Sequence[Tensor]) -> None:
        super().__init__()
        self._policy = policy
        # of the policy's actions, then of the environment's: [4, A]
        self.register_buffer("_bounds", torch.stack(list(bounds)))

    def forward(self, observation: Tensor) -> Tensor:
        low, high, env_low, env_high = self._bounds
        given = TensorDict({"observation": observation}, batch_size=observation.shape[:1])
        action: Tensor = self._policy(given)["action"]
        action = torch.minimum(torch.maximum(action, low), high)
        return env_low + (action - low) * ((env_high - env_low) / (high - low))


def export_onnx(
    run: Run, env: EnvBase, checkpoint: Path, file: Path, *, sampled: bool = False
) -> None:
    """Write a policy as a function from the observation to the action that the environment takes.

    The input ``observation`` is float32 [N, D] for any N, before any scaling. The output ``action``
    [N, A] has the units and bounds of the environment itself. The file's metadata describe both,
    and have the certificate if it covers these actions; their values are JSON. The actions are
    sampled, or else the mean ones.

    Raises:
        ModuleNotFoundError: If the extra ``onnx`` is not installed.
        ValueError: If observations are no vectors, if actions are not numbers within bounds, if the
            policy is recurrent, or if its samples cannot be drawn in a graph.
        CheckpointError: If the checkpoint does not fit the environment.
    """
    onnx = import_extra("onnx", "onnx")
    observation, action = env.observation_spec["observation"], env.action_spec
    if len(observation.shape) != 2 or not isinstance(action, Bounded):
        raise ValueError(
            "Only policies with a vector as observation and bounded numbers as action can be "
            "exported."
        )
    policy = load_policy(run.config, env, checkpoint, torch.device("cpu"))
    if isinstance(policy, ProbabilisticTensorDictSequential):
        policy = make_behaviour(policy)
    if len(policy.in_keys) != 1:
        raise ValueError(f"Policies that read {policy.in_keys} cannot be exported, only vectors.")
    is_plain = isinstance(policy, BehaviourPolicy | ExploringPolicy) and policy.network is not None
    if sampled and not is_plain:
        raise ValueError(
            "The samples of this policy's distribution cannot be drawn in an ONNX graph. Export "
            "the mean of its actions, actions=mean; a certificate of sampled actions does not "
            "cover it."
        )
    bounds = [action.space.low[0], action.space.high[0], *env.action_bounds]
    about = _about(run, env, checkpoint, sampled=sampled)
    with (
        exploration(deterministic=not sampled),
        torch.no_grad(),
        warnings.catch_warnings(),
        replacing(file) as unfinished,
    ):
        warnings.simplefilter("ignore")
        logging.getLogger("torch.onnx").setLevel(logging.ERROR)
        torch.onnx.export(
            _Deployed(policy, bounds).eval(),
            (torch.zeros(2, observation.shape[-1]),),
            str(unfinished),
            input_names=["observation"],
            output_names=["action"],
            dynamic_axes={"observation": {0: "N"}, "action": {0: "N"}},
            dynamo=False,
        )
        model = onnx.load(str(unfinished))
        onnx.helper.set_model_props(model, {name: json.dumps(v) for name, v in about.items()})
        onnx.save(model, str(unfinished))


def _about(run: Run, env: EnvBase, checkpoint: Path, *, sampled: bool) -> dict[str, Any]:
    """What a program must know to use a policy: columns, units, where it comes from."""
    config, certificate = run.config, run.certificate_of(checkpoint)
    if certificate is not None and is_sampled(certificate) != sampled:
        certificate = None  # it is about other actions
    kept = ("level", "bounds", "bound", "episodes", "checkpoint")
    covered = {key: certificate.get(key) for key in kept} if certificate else None
    transforms, (low, high) = transforms_of(config), env.action_bounds
    return {
        "observation": env.column_names,
        "costs": list(env.cost_keys),
        "action_low": low.tolist(),
        "action_high": high.tolist(),
        "steps_per_action": env.steps_per_decision,
        "environment": OmegaConf.to_container(config.env, resolve=True),
        "transforms": transforms,
        "cost_limits": OmegaConf.to_container(config.cost_limits, resolve=True),
        "algorithm": run.algorithm,
        "steps": checkpoint_steps(checkpoint),
        "commit": run.commit,
        # the tested environment had these transforms, and the file has none of them
        "certificate": covered and {**covered, "transforms": list(transforms)},
        "actions": "sampled" if sampled else "mean",
    }


def is_sampled(certificate: Mapping[str, Any]) -> bool:
    """Whether the content of ``certificate.json`` is about sampled actions, not their mean."""
    return not certificate.get("deterministic", False)
