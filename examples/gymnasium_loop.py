"""Policy gradients with a Lagrange multiplier in one file, on Gymnasium's vector environments.

    python examples/gymnasium_loop.py

It shows where a loop such as CleanRL's finds costs; it is not made to learn fast.
"""

from __future__ import annotations

import safe_rl.envs  # isort: skip  # noqa: F401, registers the environments; before torch

import gymnasium
import numpy as np
import torch
from gymnasium.wrappers.vector import ClipAction, RecordEpisodeStatistics


def train(num_steps: int, updates: int, limit: float, num_envs: int = 4) -> list[float]:
    """Train on PointGoal1 with episodes of `num_steps` steps; returns λ after every update."""
    envs = gymnasium.make_vec(
        "Safexp-PointGoal1-v0", num_envs=num_envs, config={"num_steps": num_steps}
    )
    envs = RecordEpisodeStatistics(ClipAction(envs))
    actor = torch.nn.Linear(*envs.single_observation_space.shape, *envs.single_action_space.shape)
    optimizer = torch.optim.Adam(actor.parameters(), lr=3e-4)
    multipliers, multiplier, discount = [], 0.0, 0.99
    observation, _ = envs.reset(seed=0)
    ended = np.zeros(num_envs, dtype=bool)
    for _ in range(updates):
        log_probs, rewards, counts, ends, costs = [], [], [], [], []
        for _ in range(2 * (num_steps + 1)):
            policy = torch.distributions.Normal(actor(torch.as_tensor(observation)), 0.5)
            action = policy.sample()
            observation, reward, terminated, truncated, infos = envs.step(action.numpy())
            log_probs.append(policy.log_prob(action).sum(-1))
            # the step after an end only resets its row
            counts.append(torch.as_tensor(~ended))
            rewards.append(torch.as_tensor(reward - multiplier * infos["cost"]))
            ended = terminated | truncated
            ends.append(torch.as_tensor(ended))
            if ended.any():
                costs += infos["episode_cost"][ended].tolist()
        after, loss = torch.zeros(num_envs), torch.tensor(0.0)
        for log_prob, reward, count, end in zip(
            *map(reversed, (log_probs, rewards, counts, ends)), strict=True
        ):
            after = reward + discount * after * ~end
            loss = loss - (log_prob * after * count).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        multiplier = max(0.0, multiplier + 0.01 * (float(np.mean(costs)) - limit))
        multipliers.append(multiplier)
        print(f"{len(costs)} episodes, mean cost {np.mean(costs):.2f}, λ={multiplier:.3f}")
    envs.close()
    return multipliers


if __name__ == "__main__":
    train(num_steps=1000, updates=50, limit=25.0)
