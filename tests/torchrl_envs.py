"""What somebody could write for TorchRL: an environment with a cost as an entry, and costs."""

import torch
from tensordict import TensorDict
from torchrl.data import Bounded, Composite, Unbounded
from torchrl.envs import EnvBase, PendulumEnv, RenameTransform, TransformedEnv


class Runner(EnvBase):
    """A point on a line that earns its speed and observes it; N of them, or one without a batch."""

    def __init__(self, num_envs=2, top=1.0, device="cpu", seed=None):
        super().__init__(device=device, batch_size=[num_envs])
        shape, self._top = (num_envs, 1), top
        self.observation_spec = Composite(
            place=Unbounded(shape), cost_effort=Unbounded(shape), shape=[num_envs]
        )
        self.action_spec = Bounded(0.0, top, shape)
        self.reward_spec = Unbounded(shape)
        self._places = torch.zeros(shape)

    def _reset(self, tensordict=None, **_):
        begins = None if tensordict is None else tensordict.get("_reset", None)
        begins = torch.ones(self._places.shape, dtype=bool) if begins is None else begins
        self._places = torch.where(begins.view_as(self._places), torch.rand(1), self._places)
        return self._said(torch.zeros_like(self._places))

    def _step(self, tensordict):
        speed = tensordict["action"]
        assert speed.min() >= 0
        assert speed.max() <= self._top
        self._places = self._places + speed
        return self._said(speed**2).update({"reward": speed})

    def _said(self, cost):
        done = torch.zeros(self._places.shape, dtype=bool)
        values = {"place": self._places.clone(), "cost_effort": cost, "done": done}
        return TensorDict({**values, "terminated": done.clone()}, self.batch_size)

    def _set_seed(self, seed):
        torch.manual_seed(seed)


class Charged(Runner):
    """The same, with its cost beside the reward."""

    def __init__(self, **kwargs):
        super().__init__(**kwargs)
        cost = self.observation_spec["cost_effort"]
        del self.observation_spec["cost_effort"]
        rewards = Composite(reward=Unbounded(cost.shape), cost_effort=cost, shape=self.batch_size)
        self.reward_spec = rewards

    def _reset(self, tensordict=None, **_):
        return super()._reset(tensordict).exclude("cost_effort")


class Ends(EnvBase):
    """One that ends after two steps, says it by one flag alone, and has rewards of integers."""

    def __init__(self, flag="done", silent=False):
        super().__init__()
        self._flag, self._silent = flag, silent
        self.observation_spec = Composite(place=Unbounded(1), cost_effort=Unbounded(1))
        self.action_spec = Bounded(0.0, 1.0, (1,))
        self.reward_spec = Unbounded(1, dtype=torch.int64)

    def _reset(self, tensordict=None, **_):
        self._place = torch.zeros(1)
        return TensorDict(place=self._place, cost_effort=torch.zeros(1))

    def _step(self, tensordict):
        self._place = self._place + 1
        step = TensorDict(place=self._place, reward=torch.ones(1, dtype=torch.int64))
        if not (self._silent and self._place >= 2):
            step["cost_effort"] = torch.ones(1)
        return step.set(self._flag, self._place >= 2)

    def _set_seed(self, seed): ...


def renamed():
    """One whose own transform renames an entry."""
    return TransformedEnv(Ends(), RenameTransform(["place"], ["spot"]))


class Alone(PendulumEnv):
    """A pendulum that cannot be reset with others."""

    def _reset(self, tensordict, **keys):
        assert tensordict is None or not tensordict.batch_size, "one at a time"
        return super()._reset(tensordict, **keys)


def upright(step, limit=1.0):
    """A cost for being within a range of the top, [N]."""
    return step["next", "th"].abs() < limit


def kinds(step):
    """Two costs by name, [N, 1]; one of the action as the environment takes it."""
    effort = step["action"].abs()
    return {"cost_effort": effort, "cost_fast": step["next", "thdot"].abs().unsqueeze(-1) > 4}


def wrong(step, **cost):
    return cost or torch.zeros(7)
