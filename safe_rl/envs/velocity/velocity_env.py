"""Velocity-limited locomotion as one batched TorchRL environment."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from typing import Any, ClassVar

import mujoco
import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor
from torchrl.data import Unbounded

from safe_rl.envs import rng
from safe_rl.envs.physics import RESTORED, BatchPhysics, put
from safe_rl.envs.physics.runge_kutta import runge_kutta_substep
from safe_rl.envs.simulated import SimulatedEnv
from safe_rl.envs.velocity import runner
from safe_rl.envs.velocity.velocity_config import RUNNERS, VelocityConfig, resolve_velocity


class VelocityEnv(SimulatedEnv):
    """N parallel robots of one configuration, with a reward for speed and a cost above a limit.

    Dynamics, observation, reward and termination are those of Gymnasium's environment of version 5
    (Towers et al. 2024) with the robot's own MJCF file. A step costs 1 if the velocity exceeds the
    threshold, as in Safety-Gymnasium 1.0 (Ji et al. 2023).

    Reads `action` [N, nu], clipped to the actuators' control range. Writes `observation` [N, n],
    and each [N, 1]: `reward`, `cost`, `cost_velocity` (equal to `cost`), `done`, `terminated` (the
    robot fell), `truncated` (time limit). A robot whose physics fails gets reward and cost 0, and
    its episode terminates.

    A state contains `qpos`, `qvel`, `qacc_warmstart`, `time`, `step_count`, the seeds, and `place`
    and `observation` of the last substep. The last two are computed if they are missing.

    Cameras of pictures are "track" (the model's own) and "free" (beside the robot).

    Args:
        env: Name ("SafeHopperVelocity"), mapping with `robot` and configuration keys, or
            `VelocityConfig`.
        num_envs: Number of robots, N.
        device: Device of the TensorDicts. The physics runs on the CPU, or on this device if the key
            `physics` is "warp".
        seed: Integer that determines every draw; None draws one from torch's generator. The
            episodes of row k do not depend on N or the number of threads.
        num_threads: Threads that step the physics; 0 for one per core.

    Raises:
        ConfigError: For an unknown name or key, or a value that cannot be used.

    Examples:
        >>> env = VelocityEnv("SafeHopperVelocity", num_envs=4, seed=0)
        >>> rollout = env.rollout(max_steps=5)
        >>> rollout["next", "cost_velocity"].shape
        torch.Size([4, 5, 1])
    """

    first_camera: ClassVar = "track"
    optional: ClassVar = ("place", "observation", *SimulatedEnv.optional)

    def __init__(
        self,
        env: str | Mapping[str, Any] | VelocityConfig,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        seed: int | None = None,
        num_threads: int = 0,
    ) -> None:
        super().__init__(num_envs, device, num_threads)
        self.config = resolve_velocity(env)
        self.cost_keys = ["cost", "cost_velocity"]
        self._model = model = runner.load_model(self.config)
        outputs = runner.needed_outputs(self.config)
        bodies = slice(1, model.nbody)
        self._physics = physics = self._make_physics(model, bodies, num_threads, outputs)
        self.seconds_per_step = physics.timestep * self.config.frame_skip
        self._observer = runner.Observer(self.config, model)
        shares = torch.from_numpy(model.body_mass / model.body_mass.sum())[:, None]
        place = runner.PLACES[RUNNERS[self.config.robot].place]
        self._place = partial(place.read, physics, shares.to(physics.qpos))
        self._last_place = self._place()
        shape = (num_envs, self._observer.size)
        self._observation = torch.zeros(shape, dtype=torch.float32, device=physics.device)
        self._step_count = torch.zeros(num_envs, dtype=torch.int64, device=physics.device)
        draw = partial(draw_start, self.config, model)
        self._starts = rng.DrawnAhead(draw, (num_envs, model.nq + model.nv), physics.device)
        observed = Unbounded(shape, dtype=torch.float32, device=self.device)
        self._announce(model, observed, highest=1.0, seed=seed)

    def _begin(self, mask: Tensor) -> None:
        physics = self._physics
        physics.reset(mask)
        key = rng.fold(self._row_seed, self._episode)
        start = self._starts(key, rng.fold(self._row_seed, self._episode + 1), mask)
        put(physics.qpos, mask, start[:, : self._model.nq])
        put(physics.qvel, mask, start[:, self._model.nq :])
        physics.forward(mask)
        self._start(mask)
        self._step_count.masked_fill_(mask, 0)

    def _start(self, mask: Tensor) -> None:
        """Write place and observation in the rows of a mask, whose state was not stepped to."""
        put(self._last_place, mask, self._place())
        self._observer.write_start(self._physics, self._observation, mask)

    def _observe(self) -> Tensor:
        return self._observation.clone().to(self.device)

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        action = self._checked_action(tensordict).to(self._physics.dtype)
        reward, terminated = self._move(action.clamp(*self._control_range))
        self._observer.write(self._physics, self._observation)
        self._step_count += 1
        truncated = (self._step_count >= self.config.num_steps) & ~terminated
        cost = self._has_cost.to(reward.dtype)
        flags = torch.stack([terminated | truncated, terminated, truncated])
        return self._output(flags, torch.stack([reward, cost, cost]))

    def _move(self, control: Tensor) -> tuple[Tensor, Tensor]:
        """Take one step; returns reward and termination, float and bool [N]."""
        config, physics = self.config, self._physics
        failed = self._advance(control)
        place = self._place()
        velocity = (place - self._last_place) / self.seconds_per_step
        self._last_place.copy_(place)
        is_healthy = runner.healthy(config, physics.qpos, physics.qvel)
        reward = runner.locomotion_reward(
            config, velocity[:, 0], control, is_healthy, physics.outputs
        )
        self._has_cost = (runner.limited_speed(velocity) > config.velocity_threshold) & ~failed
        terminated = failed | ~is_healthy if config.terminate_when_unhealthy else failed
        return reward.masked_fill_(failed, 0.0), terminated

    def _advance(self, action: Tensor) -> Tensor:
        physics, num_substeps = self._physics, self.config.frame_skip
        physics.ctrl.copy_(action)
        if runner.FORCES in physics.outputs and isinstance(physics, BatchPhysics):
            failed = physics.step(num_substeps - 1, refresh=False)
            return failed | runge_kutta_substep(physics)
        return physics.step(num_substeps, refresh=False)

    @cached_property
    def _renderer(self) -> runner.RobotRenderer:
        return runner.RobotRenderer(self.config, self._physics)

    def _read_state(self) -> TensorDict:
        state = {key: getattr(self._physics, key).clone() for key in RESTORED}
        state |= {"step_count": self._step_count.clone(), "place": self._last_place.clone()}
        state["observation"] = self._observation.clone()
        return TensorDict(state, batch_size=self.batch_size)

    def _write_state(self, state: TensorDictBase) -> None:
        everyone = torch.ones_like(self._begun)
        self._physics.reset(everyone)
        for key in RESTORED:
            getattr(self._physics, key).copy_(state[key])
        self._step_count.copy_(state["step_count"])
        self._physics.forward()
        self._start(everyone)
        self._last_place.copy_(state.get("place", self._last_place))
        self._observation.copy_(state.get("observation", self._observation))


def draw_start(config: VelocityConfig, model: mujoco.MjModel, key: Tensor) -> Tensor:
    """Draw initial positions and velocities [R, nq + nv] from keys [R], as Gymnasium does.

    Positions are uniform within the noise scale around the model's. Velocities have the mean 0 and
    are uniform within the noise scale, or normal with it as standard deviation. All are float64.
    """
    columns = torch.arange(model.nq + model.nv, device=key.device)
    if RUNNERS[config.robot].normal_velocities:
        positions = _symmetric(key[:, None], columns[: model.nq])
        velocities = rng.normal(key[:, None], columns[model.nq :])
    else:
        draws = _symmetric(key[:, None], columns)
        positions, velocities = draws.split([model.nq, model.nv], -1)
    initial, scale = torch.from_numpy(model.qpos0.copy()).to(key.device), config.reset_noise_scale
    return torch.cat([initial + scale * positions, scale * velocities], -1)


def _symmetric(keys: Tensor, columns: Tensor) -> Tensor:
    """Uniform in [-1, 1): [R, 1], [C] -> [R, C]."""
    return rng.uniform(keys, columns).mul_(2.0).sub_(1.0)
