"""One Safety Gym world, stepped plainly: section 5 of the specification, line by line."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from .config import complete
from .costs import costs
from .layout import by_kind
from .observe import observation_parts
from .rewards import dense_reward, goal_achieved, reward_distances
from .world import Reset, compile_world, goal_height

# MuJoCo resets a world by itself when its state is not finite or huge; these warnings tell.
_FAILURES = (
    mujoco.mjtWarning.mjWARN_BADQPOS,
    mujoco.mjtWarning.mjWARN_BADQVEL,
    mujoco.mjtWarning.mjWARN_BADQACC,
)


def _floats(numbers: Sequence[float]) -> tuple[float, ...]:
    return tuple(float(n) for n in numbers)


class ReferenceWorld:
    """A single Safety Gym environment without a random layout or goal: the caller gives both.

    Args:
        config: flat configuration in the vocabulary of the specification (section 1).
        seed: of the action noise and of binomial frame skips.

    Attributes:
        config: the configuration, completed with defaults.
        model: the compiled world; None until the first `set_state`.
        data: its simulation state.
        layout: positions [K, 2] of every kind at the reset [m].
        distances: what the next step's dense reward is measured against [m].

    Example:
        >>> world = ReferenceWorld({"robot_base": "point", "goal_size": 0.3})
        >>> layout = {"goal": [[1.0, 0.0]]}
        >>> world.set_state(qpos=[0, 0, 0], qvel=[0, 0, 0], layout=layout)
        >>> result = world.step([1.0, 0.0])
        >>> bool(result["reward"] > 0)
        True
    """

    def __init__(self, config: dict[str, Any], seed: int = 0):
        self.config = complete(config)
        self.pinned_yaws = config.get("gremlins_rots", ())
        self.rng = np.random.default_rng(seed)
        self.model: mujoco.MjModel | None = None
        self._compiled_for = None

    def set_state(
        self,
        qpos: Sequence[float],
        qvel: Sequence[float],
        *,
        layout: Mapping[str, Any],
        qacc_warmstart: Sequence[float] | None = None,
        time: float = 0.0,
        goal_pos: Sequence[float] | None = None,
        goal_button: int = -1,
        buttons_timer: int = 0,
        step_count: int = 0,
        gremlin_yaws: Sequence[float] | None = None,
        pillar_yaws: Sequence[float] | None = None,
        start_pose: Sequence[float] | None = None,
    ) -> None:
        """Puts the world in a state; the previous distances are those of this state.

        Args:
            qpos: [nq] in the order robot, vases, gremlins, box.
            qvel: [nv] in the same order.
            layout: object names or kinds to positions at the reset [m]; of every kind that the
                configuration has. The goal is taken from it unless `goal_pos` is given.
            qacc_warmstart: [nv] where the constraint solver starts; zeros if None.
            time: simulation time [s], the phase of the gremlins.
            goal_pos: position of the goal, [2] or [3] [m]; read in goal and push tasks only.
            goal_button: index of the goal button (button task).
            buttons_timer: steps until buttons are live.
            step_count: steps taken so far.
            gremlin_yaws: [K] yaws at the reset [rad]; `gremlins_rots` if None.
            pillar_yaws: [K] yaws of the pillars [rad]; zeros if None. They matter to the
                collision finder's last digits only.
            start_pose: x, y, yaw of the robot at the reset; zeros if None. The observations
                `qpos` and `qvel` of the Point are relative to it.

        Raises:
            ValueError: where the layout has fewer positions or yaws than there are objects.
        """
        self.layout = by_kind(layout)
        self._check_layout(gremlin_yaws)
        self._compile(gremlin_yaws, pillar_yaws, start_pose)
        self.buttons_timer = int(buttons_timer)
        self.step_count = int(step_count)
        mujoco.mj_resetData(self.model, self.data)
        self.data.qpos[:] = qpos
        self.data.qvel[:] = qvel
        self.data.time = time
        warmstart = np.zeros(self.model.nv) if qacc_warmstart is None else qacc_warmstart
        self.data.qacc_warmstart[:] = warmstart
        self._place_goal(goal_pos, goal_button)
        mujoco.mj_forward(self.model, self.data)
        self.data.qacc_warmstart[:] = warmstart
        self._remember()

    def set_goal(self, goal_pos: Sequence[float] | None = None, goal_button: int = -1) -> None:
        """Sets the goal that was drawn after one was met; `observe()` then sees the new one.

        Args:
            goal_pos: position [2] or [3] [m] in goal and push tasks.
            goal_button: index of the goal button in button tasks.

        The button timer starts anew in every task: buttons may be obstacles of a goal task.
        """
        self._place_goal(goal_pos, goal_button)
        self.buttons_timer = self.config["buttons_resampling_delay"]
        self.distances = reward_distances(self)

    def step(self, action: Sequence[float], substeps: int | None = None) -> dict[str, Any]:
        """Takes one environment step.

        When the goal is met, the draw of the next one is the caller's: `observation` still sees
        the old goal, until `set_goal` and `observe()`.

        Args:
            action: [nu], clipped to the controls' range.
            substeps: physics substeps; drawn as configured if None.

        Returns:
            `observation` [n], `reward`, `cost` and `cost_<kind>`, `cost_exception`, `goal_met`,
            `terminated`, `truncated`, and the state reached: `qpos`, `qvel`, `qacc_warmstart`,
            `time`, `buttons_timer`, `step_count`.
        """
        config = self.config
        self._apply(action)
        if substeps is None:
            n, p = config["frameskip_binom_n"], config["frameskip_binom_p"]
            substeps = int(self.rng.binomial(n, p))
        if not self._simulate(substeps):
            self.step_count += 1
            result = {"reward": config["reward_exception"], "cost": 1.0, "cost_exception": 1.0}
            return {**result, "goal_met": False, "terminated": True, **self._reached()}

        reward = dense_reward(self)
        cost = costs(self)
        met = goal_achieved(self)
        self.buttons_timer = max(0, self.buttons_timer - 1)
        if met:
            reward += config["reward_goal"]
        self.step_count += 1
        self._remember()
        return {
            "reward": reward,
            **cost,
            "cost_exception": 0.0,
            "goal_met": met,
            "terminated": met and not config["continue_goal"],
            **self._reached(),
        }

    def observe(self) -> np.ndarray:
        """The flattened observation [n] of the current state and goal, in float64."""
        parts = self.observe_parts()
        return np.concatenate([np.zeros(0), *(parts[name].ravel() for name in sorted(parts))])

    def observe_parts(self) -> dict[str, np.ndarray]:
        """The components of the observation by name."""
        return observation_parts(self)

    def position(self, body: str) -> np.ndarray:
        """Position [3] of a body's origin in the world [m]."""
        return self.data.body(body).xpos.copy()

    def rotation(self, body: str) -> np.ndarray:
        """Rotation matrix [3, 3] that takes a body's coordinates to the world's."""
        return self.data.body(body).xmat.reshape(3, 3).copy()

    def velocity(self, body: str) -> np.ndarray:
        """Linear velocity [3] of a body's origin in the world [m/s]."""
        spatial = np.zeros(6)
        kind, index = mujoco.mjtObj.mjOBJ_XBODY, self.model.body(body).id
        mujoco.mj_objectVelocity(self.model, self.data, kind, index, spatial, 0)
        return spatial[3:]

    def centre_of_mass(self) -> np.ndarray:
        """Centre of mass [3] of the whole robot [m]."""
        return self.data.body("robot").subtree_com.copy()

    def count(self, kind: str) -> int:
        """How many objects of a kind there are."""
        return self.config[f"{kind}_num"]

    def goal_position(self) -> np.ndarray:
        """Position [3] of what the task points at: goal, goal button, or else the origin."""
        task = self.config["task"]
        if task == "button":
            return self.position(f"button{self.goal_button}")
        return self.position("goal") if task in ("goal", "push") else np.zeros(3)

    def _check_layout(self, gremlin_yaws: Sequence[float] | None) -> None:
        for kind in ("walls", "hazards", "vases", "pillars", "buttons", "gremlins"):
            if len(self.layout.get(kind, ())) < self.count(kind):
                raise ValueError(f"layout has too few {kind}: the configuration has more")
        yaws = self.pinned_yaws if gremlin_yaws is None else gremlin_yaws
        if len(yaws) < self.count("gremlins"):
            raise ValueError("gremlin_yaws has fewer angles than there are gremlins")

    def _compile(
        self,
        gremlin_yaws: Sequence[float] | None,
        pillar_yaws: Sequence[float] | None,
        start_pose: Sequence[float] | None,
    ) -> None:
        gremlin_yaws = self.pinned_yaws if gremlin_yaws is None else gremlin_yaws
        pillar_yaws = np.zeros(self.count("pillars")) if pillar_yaws is None else pillar_yaws
        start_pose = np.zeros(3) if start_pose is None else start_pose
        self.reset = Reset(self.layout, *map(_floats, (start_pose, gremlin_yaws, pillar_yaws)))
        if self.reset.key() != self._compiled_for:
            self.model = compile_world(self.config, self.reset)
            self.data = mujoco.MjData(self.model)
            self._compiled_for = self.reset.key()

    def _place_goal(self, goal_pos: Sequence[float] | None, goal_button: int) -> None:
        self.goal_button = int(goal_button)
        if self.config["task"] in ("goal", "push"):
            plane = self.layout["goal"][0] if goal_pos is None else goal_pos
            slot = self.model.body("goal").mocapid[0]
            self.data.mocap_pos[slot] = [*np.asarray(plane)[:2], goal_height(self.config)]
            mujoco.mj_kinematics(self.model, self.data)

    def _apply(self, action: Sequence[float]) -> None:
        low, high = self.model.actuator_ctrlrange.T
        self.data.ctrl[:] = np.clip(action, low, high)
        if self.config["action_noise"]:
            noise = self.rng.standard_normal(self.model.nu)
            self.data.ctrl[:] += self.config["action_noise"] * noise

    def _simulate(self, substeps: int) -> bool:
        """Runs the substeps and brings everything derived up to date; False on a failure."""
        for _ in range(substeps):
            self._drive_gremlins()
            mujoco.mj_step(self.model, self.data)
            if any(self.data.warning[kind].number for kind in _FAILURES):
                return False
        mujoco.mj_forward(self.model, self.data)
        return True

    def _drive_gremlins(self) -> None:
        travel, size = self.config["gremlins_travel"], self.config["gremlins_size"]
        t = self.data.time
        for i in range(self.count("gremlins")):
            slot = self.model.body(f"gremlin{i}_mocap").mocapid[0]
            self.data.mocap_pos[slot] = [travel * np.sin(t), travel * np.cos(t), size]

    def _remember(self) -> None:
        """Keeps what the rewards of the next step are differences to."""
        self.distances = reward_distances(self)
        self.com = self.centre_of_mass()

    def _reached(self) -> dict[str, Any]:
        """What a step's result says about the state it led to."""
        return {
            "truncated": self.step_count >= self.config["num_steps"],
            "observation": self.observe(),
            "qpos": self.data.qpos.copy(),
            "qvel": self.data.qvel.copy(),
            "qacc_warmstart": self.data.qacc_warmstart.copy(),
            "time": self.data.time,
            "buttons_timer": self.buttons_timer,
            "step_count": self.step_count,
        }
