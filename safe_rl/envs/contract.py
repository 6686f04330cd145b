"""What a batch of constrained environments has to be for everything else to work with it.

There is no base class: any `EnvBase` that has these members will do, whatever it simulates.
Training, evaluation and the command line know nothing else about an environment.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Protocol, runtime_checkable

import torch
from tensordict import TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, OneHot, TensorSpec
from torchrl.envs import EnvBase

from safe_rl.envs.costs import COST
from safe_rl.naming import key_name

#: Continuous or integers within bounds, choices as integers, choices as one-hot vectors.
ACTIONS = (Bounded, Categorical, OneHot)


@runtime_checkable
class ConstrainedEnv(Protocol):
    """N environments that are stepped together: an `EnvBase` of batch size [N], and more.

    It reads `action`: [N, A] bounded, or choices, [N] or [N, A] integers or [N, C] one-hot.
    Continuous ones come as policies draw them, from about -1 to 1 at first: it cuts them to its
    bounds. It writes `observation`, vectors of float32 or pictures, `reward` [N, 1], every one of
    `cost_keys` [N, 1], 0 or more, `done`, `terminated` and `truncated`. Costs stand in the reward
    spec.

    Attributes:
        cost_keys: names of the costs; the aggregate `cost` is one of them.
        max_episode_steps: the largest number of steps of an episode.
        observation_layout: columns of every named component of a flat `observation`; a nested one
            may say what its columns were if it were flat.

    If `reward` is not what returns are made of, `return_key` names what is, below "next".

    Examples:
        >>> from safe_rl.envs import SafetyGymEnv
        >>> env: ConstrainedEnv = SafetyGymEnv("PointGoal1", num_envs=2, seed=0)
        >>> env.max_episode_steps
        1000
    """

    cost_keys: list[str]

    @property
    def max_episode_steps(self) -> int:
        """The largest number of steps of an episode."""
        ...

    @property
    def observation_layout(self) -> Mapping[str, slice]:
        """Columns of every component of the observation."""
        ...

    @property
    def batch_size(self) -> torch.Size:
        """[N]."""
        ...

    @property
    def device(self) -> torch.device:
        """Where the TensorDicts live."""
        ...

    @property
    def observation_spec(self) -> Composite:
        """Shapes and types of what is observed."""
        ...

    @property
    def action_spec(self) -> TensorSpec:
        """Bounds, or numbers of choices, of the actions."""
        ...

    def reset(self, tensordict: TensorDictBase | None = None, **kwargs: Any) -> TensorDictBase:
        """Start new episodes, everywhere or where `_reset` says."""
        ...

    def step(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Take `action` in every environment."""
        ...

    def set_seed(self, seed: int | None = None, static_seed: bool = False) -> int | None:
        """Determine every draw to come; rows draw differently."""
        ...

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free what it holds."""
        ...


@runtime_checkable
class SnapshotEnv(Protocol):
    """An environment whose worlds can be stored and put back, so that runs resume in the middle.

    Without it a resumed run begins new episodes.
    """

    def get_state(self) -> TensorDictBase:
        """Return a copy of everything that determines what happens next, a TensorDict [N]."""
        ...

    def set_state(self, state: TensorDictBase) -> TensorDictBase:
        """Put the worlds into a state; returns what a reset returns."""
        ...


@runtime_checkable
class PositionedEnv(Protocol):
    """An environment that tells where things are; nothing in training asks for it."""

    def get_positions(self) -> TensorDictBase:
        """Return copies of positions by kind, a TensorDict [N] of [N, K, 3] (m)."""
        ...


class ContractError(TypeError):
    """An environment that does not fulfil the contract; the message lists what it lacks."""


def check_constrained_env(env: Any) -> None:
    """Check an environment of one's own against the contract, without stepping it.

    TorchRL's `check_env_specs` finds out whether the specs are true.

    Raises:
        ContractError: naming everything that is missing or wrong.

    Examples:
        >>> from torchrl.envs import PendulumEnv
        >>> check_constrained_env(PendulumEnv())  # doctest: +ELLIPSIS
        Traceback (most recent call last):
        ...
        safe_rl.envs.contract.ContractError: PendulumEnv is no constrained environment:
        - its batch size must be [N], got []; ...
    """
    if not isinstance(env, EnvBase):
        raise ContractError(
            f"{type(env).__name__} is no environment of TorchRL (EnvBase). Those of Gymnasium are "
            "wrapped by `safe_rl.envs.from_gymnasium`."
        )
    problems = [*_shape_problems(env), *_cost_problems(env), *_layout_problems(env)]
    if problems:
        lines = "".join(f"\n- {problem}" for problem in problems)
        raise ContractError(f"{type(env).__name__} is no constrained environment:{lines}")


def _shape_problems(env: EnvBase) -> Iterator[str]:
    if len(env.batch_size) != 1:
        yield (
            f"its batch size must be [N], got {list(env.batch_size)}; "
            "torchrl.envs.SerialEnv makes a batch of single environments."
        )
    if "observation" not in env.observation_spec.keys():  # noqa: SIM118, a spec is no mapping
        yield f"it must observe 'observation', got {sorted(map(str, env.observation_spec.keys()))}."
    if not isinstance(env.action_spec, ACTIONS):
        kind = type(env.action_spec).__name__
        yield f"its actions must be continuous and bounded, or choices, got {kind}."
    for key, part in env.observation_spec.items(True, True):
        name = key_name(key)
        is_seen = name.partition("/")[0] == "observation"
        if is_seen and len(part.shape) == 2 and part.dtype != torch.float32:
            yield f"'{name}' must be of float32, which networks take, got {part.dtype}."
    ends = [str(key) for key in env.full_done_spec.keys(True, True)]
    for key in ("done", "terminated", "truncated"):
        if key not in ends:
            yield f"its done spec must have '{key}', got {sorted(ends)}."
    steps = getattr(env, "max_episode_steps", None)
    if isinstance(steps, bool) or not isinstance(steps, int) or steps < 1:
        yield f"'max_episode_steps' must be the largest number of steps of an episode, got {steps}."
    for first, second in (("get_state", "set_state"),):
        if callable(getattr(env, first, None)) and not callable(getattr(env, second, None)):
            yield f"it has '{first}', so it needs '{second}' too."


def _cost_problems(env: EnvBase) -> Iterator[str]:
    keys = getattr(env, "cost_keys", None)
    if not isinstance(keys, list | tuple) or COST not in keys:
        yield f"'cost_keys' must be a list of names with '{COST}' among them, got {keys}."
        return
    spec, wanted = env.full_reward_spec, (*env.batch_size, 1)
    written = {str(key): spec[key] for key in spec.keys(True, True)}
    for key in ("reward", *keys):
        if key not in written:
            yield f"its reward spec must have '{key}', got {sorted(written)}."
        elif tuple(written[key].shape) != wanted:
            yield f"'{key}' must have the shape {wanted}, got {tuple(written[key].shape)}."


def _layout_problems(env: EnvBase) -> Iterator[str]:
    layout = getattr(env, "observation_layout", None)
    if not isinstance(layout, Mapping) or not all(isinstance(s, slice) for s in layout.values()):
        yield (
            "'observation_layout' must map names to columns of 'observation', such as "
            f"{{'observation': slice(0, n)}}, got {layout}."
        )
        return
    seen = env.observation_spec.get("observation", None)
    width = 0 if seen is None or isinstance(seen, Composite) else seen.shape[-1]
    for name, columns in layout.items():
        if width and len(seen.shape) == 2 and (columns.stop or 0) > width:
            yield f"'observation_layout' has {columns} for '{name}', beyond the {width} columns."
