"""MuJoCo Warp beside MuJoCo on the CPU: one step from equal states, random policies.

    python benchmarks/warp_parity.py PointGoal1 CarButton2 --device cpu

prints the tables of docs/environments.md. The first: how far positions (m, rad) are apart after one
step from identical states, in float32 and in float64, and in how many steps by more than
1e-3. The second: z of the difference of means, of the return, every cost and the goals met by
random actions.
"""

import argparse

import torch

import safe_rl  # noqa: F401  # before torch, so that idle threads sleep
from safe_rl.envs import SafetyGymEnv
from safe_rl.envs.safety_gym.suite import resolve

IDS = ("PointGoal1", "PointButton2", "CarGoal1", "CarPush2", "DoggoGoal1", "DoggoButton1")
FAR = 1e-3


def one_step(config, num_envs, steps, device):
    """How far positions are apart after one step from equal states, [steps x worlds]."""
    cpu = SafetyGymEnv(config, num_envs, seed=0, sleep=False)
    warp = SafetyGymEnv(config.replace(physics="warp"), num_envs, device, seed=0)
    start, on_device = cpu.reset(), warp.reset()
    apart = []
    for _ in range(steps):
        warp.set_state(cpu.get_state().to(warp.device))
        action = cpu.action_spec.rand()
        cpu._step(start.set("action", action))
        warp._step(on_device.set("action", action.to(warp.device)))
        following = warp._physics.qpos.double().cpu()
        apart.append((cpu._physics.qpos - following).abs().amax(-1))
    return torch.cat(apart)


def episodes(config, num_envs, num_steps, device, seed):
    """Return, costs and goals of one episode of random actions in every world, name -> [N]."""
    env = SafetyGymEnv(config.replace(num_steps=num_steps), num_envs, device, seed=seed)
    torch.manual_seed(seed)
    state, sums = env.reset(), {}
    for _ in range(num_steps):
        state.set("action", env.action_spec.rand())
        following = env._step(state)
        for key in ("reward", *env.cost_keys, "goal_met"):
            sums[key] = sums.get(key, 0.0) + following[key].squeeze(-1).double().cpu()
    return sums


def z_of(ours, others):
    """Difference of means in standard errors; 0 where nothing ever happened."""
    error = (ours.var() / len(ours) + others.var() / len(others)).sqrt()
    return float((ours.mean() - others.mean()) / error) if error > 0 else 0.0


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("ids", nargs="*", default=IDS)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--step-worlds", type=int, default=16)
    parser.add_argument("--steps", type=int, default=20)
    parser.add_argument("--episodes", type=int, default=64)
    parser.add_argument("--episode-steps", type=int, default=200)
    arguments = parser.parse_args()
    print("| environment | median | 99 % | largest | over 1e-3 | z of return, costs, goals |")
    print("|---|---|---|---|---|---|")
    for name in arguments.ids:
        config = resolve(name)
        apart = one_step(config, arguments.step_worlds, arguments.steps, arguments.device)
        sizes = (arguments.episodes, arguments.episode_steps)
        cpu = episodes(config, *sizes, "cpu", seed=1)
        warp = episodes(config.replace(physics="warp"), *sizes, arguments.device, seed=2)
        z = ", ".join(
            f"{key.removeprefix('cost_')} {z_of(warp[key], cpu[key]):+.1f}"
            for key in cpu
            if key != "cost_exception" or warp[key].any()
        )
        numbers = (apart.median(), apart.quantile(0.99), apart.max())
        print(
            f"| {name} | " + " | ".join(f"{number:.0e}" for number in numbers),
            f"| {int((apart > FAR).sum())} of {len(apart)} | {z} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
