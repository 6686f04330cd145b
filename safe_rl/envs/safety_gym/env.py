"""The Safety Gym environments as one batched TorchRL environment."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property, partial
from typing import Any, ClassVar

import torch
from tensordict import TensorDict, TensorDictBase
from torch import Tensor

from safe_rl.envs import rng
from safe_rl.envs.physics import put
from safe_rl.envs.safety_gym import episodes
from safe_rl.envs.safety_gym.building import build_scene
from safe_rl.envs.safety_gym.config import SafetyGymConfig
from safe_rl.envs.safety_gym.costs import EXCEPTION_KEY, active_costs, compute_costs
from safe_rl.envs.safety_gym.layouts import plan_placements
from safe_rl.envs.safety_gym.observations import Privileged, make_observer, observation_spec
from safe_rl.envs.safety_gym.renderer import Display, WorldRenderer, vision_block
from safe_rl.envs.safety_gym.suite import resolve
from safe_rl.envs.safety_gym.tasks import TASKS, dense_reward
from safe_rl.envs.simulated import SimulatedEnv

_LIDAR = ("lidar_type", "lidar_max_dist", "lidar_exp_gain", "lidar_alias")


class SafetyGymEnv(SimulatedEnv):
    """N parallel worlds of one Safety Gym configuration, stepped together on a thread pool.

    Reads `action` [N, nu], clipped to the actuators' control range ([-1, 1] in the suite). Writes
    `observation` [N, n], or nested `("observation", name)` [N, …] where the configuration sets
    `observation_flatten` False, with `observe_privileged` also `privileged` [N, m], see
    `Privileged`, and each [N, 1]:
    `reward`, `cost` (the aggregate), one `cost_<kind>` per constrained kind, `cost_exception`,
    `goal_met`, `done`, `terminated`, `truncated`. Time-outs are truncations. Where the physics of
    a world fails, that world gets `reward_exception`, `cost_exception` 1 and termination.

    A state has `qpos`, `qvel`, `qacc_warmstart`, `time`, `goal_pos` [N, 3], `goal_button`,
    `buttons_timer`, `step_count`, and keys that may be missing in a state that is set: `ctrl`,
    `act`, `history`, `target_quat`, `layout`, `start_pose`, `fixed_layout`, `seed`, `episode`, with
    `observe_privileged` also `last_costs`, `cost_traces` and `since_goal`, and with ranges of
    factors on the dynamics also `dynamics`, the factors of every world.
    `set_state` wakes sleeping bodies; with `sleep` False the continuation is identical to the last
    digit.

    The cameras of pictures are "fixedfar", "fixednear", "track" (behind the robot), "vision" (the
    robot's) and "free" (above). Pictures also show lidar halos.

    Args:
        env: Name in the suite ("PointGoal1", "Safexp-PointGoal1-v0"), mapping of configuration
            keys, or `SafetyGymConfig`.
        num_envs: Number of worlds, N.
        device: Device of the TensorDicts. The physics runs on the CPU, or on this device if the key
            `physics` is "warp".
        seed: Integer that determines every random draw; None takes one from torch's generator. Row
            k has the same episodes for any N and any number of threads.
        num_threads: Threads that step the physics; 0 for one per core.
        sleep: Let resting objects sleep until touched, which is faster and changes no statistics;
            with `physics` "warp" they never sleep.

    Raises:
        ConfigError: For an unknown name or key, or a value that cannot be used.
        LayoutError: At a reset, if the objects do not fit.

    Examples:
        >>> env = SafetyGymEnv("PointGoal1", num_envs=4, seed=0)
        >>> rollout = env.rollout(max_steps=10)
        >>> rollout["next", "cost_hazards"].shape
        torch.Size([4, 10, 1])
    """

    events = ("goal_met",)
    flags: ClassVar = (*events, *SimulatedEnv.flags)
    first_camera: ClassVar = "fixedfar"
    # without the last control, sensors that depend on actuators differ until the next step
    optional: ClassVar = (
        *(*SimulatedEnv.optional, *episodes.LAYOUT_KEYS, "fixed_layout", "target_quat"),
        *("ctrl", "act", "history", "last_costs", "cost_traces", "since_goal"),
    )

    def __init__(
        self,
        env: str | Mapping[str, Any] | SafetyGymConfig,
        num_envs: int = 1,
        device: torch.device | str = "cpu",
        seed: int | None = None,
        num_threads: int = 0,
        sleep: bool = True,
    ) -> None:
        super().__init__(num_envs, device, num_threads)
        self.config = resolve(env)
        scene = build_scene(self.config, sleep and self.config.physics == "cpu")
        bodies = slice(1, scene.free_bodies.start)
        self._physics = physics = self._make_physics(scene.model, bodies, num_threads)
        self.seconds_per_step = physics.timestep * self.config.frameskip_binom_n
        self._world = episodes.make_world(scene, physics)
        self._plan = plan_placements(scene, physics.device)
        draw = partial(episodes.draw_layouts, self._plan, physics)
        shape = (num_envs, self._plan.num_columns, 2)
        self._fixed_layout = torch.zeros_like(self._world.step_count)
        self._layouts = rng.DrawnAhead(draw, shape, physics.device)
        self._camera = Display(self.config) if self.config.observe_vision else None
        vision = [] if self._camera is None else [vision_block(scene, self._camera)]
        self._observer = make_observer(scene, physics.device, vision)
        self._task = TASKS[self.config.task]
        self._measured = self._task.measure(self._world).detach().clone()
        self._costs = active_costs(self.config)
        self.cost_keys = ["cost", *(row.key for row in self._costs), EXCEPTION_KEY]
        self._privileged, self._remembered = None, dict[str, Tensor]()
        if self.config.observe_privileged:
            self._privileged = Privileged(self._world, len(self.cost_keys))
            self.privileged_layout = self._privileged.columns
            self._remembered = self._privileged.past
        observed = observation_spec(self.config, self._observer, num_envs, self.device)
        highest = 1.0 if self.config.constrain_indicator else torch.finfo(torch.float32).max
        self._announce(scene.model, observed, highest, seed)

    @property
    def object_names(self) -> tuple[str, ...]:
        """Names of the objects, in the order of a state's `layout`, where the robot is first."""
        return self._world.scene.names

    @property
    def sensor_keys(self) -> dict[str, Any]:  # type: ignore[override]
        """Keys that change readings of lidars and the shape of pictures, but not their number."""
        has_lidar = any(name.endswith("_lidar") for name in self.observation_layout)
        keys = {key: getattr(self.config, key) for key in _LIDAR if has_lidar}
        if self.config.observe_vision:  # as a list, which JSON has
            keys["vision_size"] = [*self.config.vision_size]
        return keys

    def _set_seed(self, seed: int | None, rows: slice = slice(None)) -> None:
        super()._set_seed(seed, rows)
        if seed is not None:  # without `randomize_layout`, all rows have one layout
            layout_seed = torch.tensor(seed, device=self._physics.device)
            self._fixed_layout[rows] = rng.fold(layout_seed, episodes.Purpose.LAYOUT)

    def _layout_key(self, ahead: int = 0) -> Tensor:
        """Return random keys of the layouts of the `ahead`-th next episodes, [N].

        With `layout_seeds` they depend on one of these seeds only. So environments with other
        seeds, and evaluations on the same set, have the same layouts.
        """
        config, key = self.config, self._fixed_layout
        if config.randomize_layout:
            key = rng.fold(self._row_seed, self._episode + ahead)
        if config.layout_seeds is None:
            return key
        purpose = episodes.Purpose.LAYOUT_SEED
        index = (rng.uniform(key, purpose) * config.layout_seeds).to(torch.int64)
        return rng.fold(config.layout_seeds_first + index, purpose)

    def _step_key(self) -> Tensor:
        """Return random keys of the step that is being taken, [N]."""
        return rng.fold(self._row_seed, self._episode, self._world.step_count + 1)

    def _begin(self, mask: Tensor) -> None:
        key = self._layout_key()
        layouts = self._layouts(key, self._layout_key(ahead=1), mask)
        episodes.start_episodes(self._world, layouts, key, mask)
        if self._privileged is not None:
            self._privileged.begin(mask)
        put(self._measured, mask, self._task.measure(self._world))

    def _observe(self) -> Tensor | TensorDict:
        flat = self._observer.read(self._world).to(self.device)
        if self.config.observation_flatten:
            return flat
        return TensorDict(
            self._observer.split(flat), batch_size=self.batch_size, device=self.device
        )

    def _observe_privileged(self) -> Tensor:
        assert self._privileged is not None
        return self._privileged.read().to(self.device)

    @torch.no_grad()
    def _step(self, tensordict: TensorDictBase) -> TensorDictBase:
        world, config = self._world, self.config
        action = self._checked_action(tensordict)
        failed = self._advance(action)
        now = self._task.measure(world)
        reward = dense_reward(self._task, world, self._measured, now, failed)
        costs = compute_costs(self._costs, world, failed)
        torch.gt(costs[0], 0.0, out=self._has_cost)
        world.buttons_timer.sub_(1).clamp_(min=0)
        met, stuck = self._handle_goals(now, failed)
        if self._privileged is not None:
            self._privileged.update(costs, met)
        reward = reward + config.reward_goal * met
        reward.masked_fill_(failed, config.reward_exception)
        world.step_count.add_(1)
        time_out = world.step_count >= config.num_steps
        terminated = failed if config.continue_goal else failed | met
        truncated = (time_out if stuck is None else time_out | stuck) & ~terminated
        flags = torch.stack([met, terminated | truncated, terminated, truncated])
        return self._output(flags, torch.cat([reward.unsqueeze(0), costs]))

    def _advance(self, action: Tensor) -> Tensor:
        config, physics = self.config, self._physics
        control = action.clamp(*self._control_range)
        counts = None
        if config.action_noise > 0.0:
            control = control + episodes.control_noise(config, self._step_key(), control.shape[-1])
        if config.frameskip_binom_p < 1.0:
            counts = episodes.draw_substeps(config, self._step_key())
        physics.ctrl.copy_(control)
        path = None
        if self._world.scene.num_targets:
            path = episodes.gremlin_path(self._world, physics.time, config.frameskip_binom_n)
        failed = physics.step(config.frameskip_binom_n, path, counts=counts)
        episodes.refresh(self._world)
        return failed

    def _handle_goals(self, now: Tensor, failed: Tensor) -> tuple[Tensor, Tensor | None]:
        """Draw new goals in the worlds that meet their goals; return these worlds, bool [N].

        Also return the worlds without a place for a new goal; None if no goals were drawn.
        """
        self._measured.copy_(now)
        if self._task.met is None:
            return torch.zeros_like(failed), None
        met = self._task.met(self.config, self._world, now)
        met = (self._world.require(f"'met' of task '{self.config.task}'", met) > 0) & ~failed
        if not (self.config.continue_goal and self._physics.maybe_any(met)):
            return met, None
        stuck = episodes.next_goals(self._world, self._plan, self._step_key(), met)
        self._measured.copy_(self._task.measure(self._world))
        return met, stuck

    def get_positions(self) -> TensorDict:
        """Return the positions of robot and objects, for shields, privileged critics and plots.

        Returns:
            TensorDict [N] of copies, [N, K, 3] each (m, in the world's frame): `robot` (its root
            body, K = 1), and the centres of the objects of every kind that exists, by kind: `goal`
            (K = 1; in a button task, the position of the goal button), `hazards`, …
        """
        places = {"robot": self._world.robot_pos.unsqueeze(1), **self._world.objects}
        return TensorDict(places, self.batch_size).clone().to(self.device)

    @cached_property
    def _renderer(self) -> WorldRenderer:
        return WorldRenderer(self._world)

    def close(self, *, raise_if_closed: bool = True) -> None:
        """Free the resources of OpenGL."""
        if self._camera is not None:
            self._camera.close()
        super().close(raise_if_closed=raise_if_closed)

    def _read_state(self) -> TensorDict:
        world = self._world
        state = episodes.stored_tensors(world) | self._remembered
        state["goal_pos"] = (
            world.at("goal")[:, 0] if "goal" in world.scene.slots else torch.zeros_like(world.com)
        )
        state["target_quat"] = world.physics.mocap_quat[:, : world.scene.num_targets]
        if not self.config.randomize_layout:
            state["fixed_layout"] = self._fixed_layout
        return TensorDict(state, batch_size=self.batch_size).clone()

    def _write_state(self, state: TensorDictBase) -> None:
        button, number = state["goal_button"], self.config.buttons_num
        if self._task.goal_at_button and not ((button >= 0) & (button < number)).all():
            raise ValueError(f"State 'goal_button' must be between 0 and {number - 1}: {button}.")
        self._fixed_layout = state.get("fixed_layout", self._fixed_layout).clone()
        if "layout" not in state and not self._episode.any():
            self.reset()
        world, scene, physics = self._world, self._world.scene, self._physics
        target_quat = state.get("target_quat", physics.mocap_quat[:, : scene.num_targets].clone())
        everywhere = torch.ones_like(world.step_count, dtype=torch.bool)
        physics.reset(everywhere)
        for key, tensor in episodes.stored_tensors(world).items():
            if key in state:
                tensor.copy_(state[key])
        physics.mocap_quat[:, : scene.num_targets] = target_quat
        world.positions[:, scene.num_free :, :2] = world.layout[:, 1 + scene.num_free :]
        if self._task.goal_at_button:
            episodes.point_goal_at_button(world, everywhere)
        elif "goal" in scene.slots:
            goal = scene.slots["goal"].start
            world.positions[:, goal] = state["goal_pos"]
            world.layout[:, 1 + goal] = state["goal_pos"][:, :2]
        episodes.place_mocaps(world)
        physics.forward()
        episodes.refresh(world)
        for name, tensor in self._remembered.items():
            tensor.copy_(state.get(name, torch.zeros_like(tensor)))
        self._measured.copy_(self._task.measure(self._world))
