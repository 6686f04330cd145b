"""Where environments of Safety-Gymnasium come from: this Python, or another one."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium

from safe_rl.envs.errors import ConfigError
from safe_rl.envs.safety_gymnasium.other_python import Server, open_server
from safe_rl.envs.safety_gymnasium.serve import episode_length
from safe_rl.envs.safety_gymnasium.six_values import SixValues, kinds_of
from safe_rl.envs.safety_gymnasium.where import missing, other_python


def make_single(config: Mapping[str, Any]) -> gymnasium.Env:
    """Make one environment in this process, with its cost in `info`.

    Raises:
        ConfigError: if the package cannot be imported.
    """
    try:
        import safety_gymnasium
    except ImportError as error:
        raise missing(error) from error
    kwargs = dict(config["kwargs"] or {})
    if config["render_mode"] is not None:
        kwargs["render_mode"] = config["render_mode"]
    if config["num_steps"] is not None:
        kwargs["max_episode_steps"] = config["num_steps"]
    return SixValues(safety_gymnasium.make(config["id"], **kwargs))


def serve_some(config: Mapping[str, Any], python: str, num_envs: int) -> tuple[Server, Any]:
    """Start a process of another Python with so many environments.

    Raises:
        ConfigError: if they cannot be made.
    """
    kwargs = dict(config["kwargs"] or {})
    if config["render_mode"] is not None:
        kwargs["render_mode"] = config["render_mode"]
    try:
        return open_server(python, config["id"], num_envs, config["num_steps"], kwargs)
    except RuntimeError as error:
        if "No module named 'safety_gymnasium'" in str(error):
            raise missing(f"{python}: {error}") from error
        raise ConfigError(f"env.id={config['id']}: {error}") from error


def describe(config: Mapping[str, Any]) -> tuple[list[str], int | None]:
    """Return the kinds of costs and the length of episodes of an id, by taking a step.

    Raises:
        ConfigError: if there is no such environment, or the package is missing.
    """
    python = other_python()
    if python is not None:
        server, said = serve_some(config, python, 1)
        server.close()
        return said["kinds"], said["num_steps"]
    try:
        env = make_single(config)
    except (AssertionError, gymnasium.error.Error, TypeError, ValueError) as error:
        if isinstance(error, ConfigError):
            raise
        raise ConfigError(f"env.id={config['id']}: {error}") from error
    steps = config["num_steps"] or episode_length(env)
    return probe_kinds(env), steps


def probe_kinds(env: gymnasium.Env) -> list[str]:
    """Return the kinds of costs that a step reports, and close the environment."""
    try:
        env.reset(seed=0)
        return kinds_of(env.step(env.action_space.sample())[-1])
    finally:
        env.close()
