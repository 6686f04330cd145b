"""MuJoCo Warp compared with MuJoCo on the CPU: single steps from equal states, and episodes.

    python benchmarks/warp_parity.py PointGoal1 CarButton2 --device cpu

The script prints the figures of docs/guides/gpu.md. Steps: the difference of positions (m, rad)
after one step, and the number of steps in which it is above 1e-5 and above 1e-3. A step of the
last kind is "sensitive" if the result of MuJoCo itself changes by more than 1e-3 when the
positions before the step are changed by 1e-7. Episodes: z of the difference of means of the
return, every cost and the goals met, with random actions.
"""

import argparse

import safe_rl  # isort: skip  # noqa: F401, before torch, for its settings of threads
import torch

from safe_rl.envs import SafetyGymEnv
from safe_rl.envs.safety_gym.suite import resolve
from safe_rl.envs.velocity import VELOCITY_SUITE, VelocityConfig, VelocityEnv, resolve_velocity

IDS = ("PointGoal1", "PointButton2", "CarGoal1", "CarPush2", "DoggoGoal1", "DoggoButton1")
NEAR, FAR = 1e-5, 1e-3
NUDGE, NUDGES = 1e-7, 8  # m or rad; how many


def make(config, *arguments, **keys):
    """An environment of either family."""
    family = VelocityEnv if isinstance(config, VelocityConfig) else SafetyGymEnv
    return family(config, *arguments, **keys)


def one_step(config, num_envs, steps, device):
    """Differences after one step, and MuJoCo's own after small changes, [steps x worlds]."""
    warp = make(config.replace(physics="warp"), num_envs, device, seed=0)
    sleepless = {} if isinstance(config, VelocityConfig) else {"sleep": False}
    cpu = make(config, num_envs, seed=0, **sleepless)
    start, on_device = cpu.reset(), warp.reset()
    torch.manual_seed(0)

    def step_from(state):
        cpu.set_state(state)
        cpu._step(start)
        return cpu._physics.qpos.clone()

    apart, nudged = [], []
    for _ in range(steps):
        state = cpu.get_state()
        warp.set_state(state.to(warp.device))
        start.set("action", cpu.action_spec.rand())
        warp._step(on_device.set("action", start["action"].to(warp.device)))
        moved = []
        for _ in range(NUDGES):
            near = state.clone()
            near["qpos"] += NUDGE * torch.randn_like(near["qpos"])
            moved.append(step_from(near))
        # last, so that the next state follows from it
        following = step_from(state)
        apart.append((following - warp._physics.qpos.double().cpu()).abs().amax(-1))
        nudged.append((following - torch.stack(moved)).abs().amax((0, 2)))
    return torch.cat(apart), torch.cat(nudged)


def episodes(config, num_envs, num_steps, device, seed):
    """Return, costs and goals of one episode of random actions in every world, name -> [N]."""
    env = make(config.replace(num_steps=num_steps), num_envs, device, seed=seed)
    torch.manual_seed(seed)
    state, sums = env.reset(), {}
    for _ in range(num_steps):
        state.set("action", env.action_spec.rand())
        following = env._step(state)
        for key in ("reward", *env.cost_keys, *env.events):
            sums[key] = sums.get(key, 0.0) + following[key].squeeze(-1).double().cpu()
    return sums


def z_of(ours, others):
    """Difference of means in standard errors; 0 where nothing ever happened."""
    error = (ours.var() / len(ours) + others.var() / len(others)).sqrt()
    return float((ours.mean() - others.mean()) / error) if error > 0 else 0.0


def z_scores(config, num_envs, num_steps, device):
    """Differences of means between the backends, of return, costs and goals, in words."""
    if not num_envs:
        return "—"
    cpu = episodes(config, num_envs, num_steps, "cpu", seed=1)
    warp = episodes(config.replace(physics="warp"), num_envs, num_steps, device, seed=2)
    return ", ".join(
        f"{key.removeprefix('cost_')} {z_of(warp[key], cpu[key]):+.1f}"
        for key in cpu
        if key != "cost_exception" or warp[key].any()
    )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("ids", nargs="*", default=IDS)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--step-worlds", type=int, default=16)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--episodes", type=int, default=64, help="0: none")
    parser.add_argument("--episode-steps", type=int, default=1000)
    arguments = parser.parse_args()
    print("| environment | median | 99 % | largest | over 1e-5 | over 1e-3 | sensitive ", end="")
    print("| z of return, costs, goals |")
    print("|---|---|---|---|---|---|---|---|")
    for name in arguments.ids:
        config = (resolve_velocity if name in VELOCITY_SUITE else resolve)(name)
        apart, nudged = one_step(config, arguments.step_worlds, arguments.steps, arguments.device)
        z = z_scores(config, arguments.episodes, arguments.episode_steps, arguments.device)
        numbers = (apart.median(), apart.quantile(0.99), apart.max())
        far = apart > FAR
        counts = (int((apart > NEAR).sum()), int(far.sum()), int((far & (nudged > FAR)).sum()))
        print(
            f"| {name} | " + " | ".join(f"{number:.0e}" for number in numbers),
            f"| {counts[0]} of {len(apart)} | {counts[1]} | {counts[2]} | {z} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
