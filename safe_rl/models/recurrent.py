"""Memory: a recurrent layer that tells steps from sequences by the shape of a batch."""

from __future__ import annotations

import torch
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torchrl.modules import GRUModule, set_recurrent_mode

__all__ = ["FEATURES", "FIRST", "MEMORY", "GatedMemory"]

FEATURES, MEMORY, FIRST = "features", "memory", "is_init"


class GatedMemory(TensorDictModuleBase):
    """Gated recurrent units (Cho et al. 2014) between the features of a network.

    A batch [N] is a step of N environments: the state that it leaves goes to ``("next", "memory")``
    and comes back with the next step. A batch [N, T] holds sequences in order of time, of which the
    first steps' states are read, and 0 wherever ``is_init`` says that an episode begins.

    Args:
        num_features: Numbers that come in.
        size: Numbers that are remembered, and go out.
        device: Of the parameters.

    Examples:
        >>> import torch
        >>> from tensordict import TensorDict
        >>> memory = GatedMemory(3, 4)
        >>> steps = TensorDict(
        ...     features=torch.ones(2, 5, 3),
        ...     memory=torch.zeros(2, 5, 4),
        ...     is_init=torch.zeros(2, 5, 1, dtype=torch.bool),
        ...     batch_size=[2, 5],
        ... )
        >>> memory(steps)["features"].shape
        torch.Size([2, 5, 4])
    """

    def __init__(self, num_features: int, size: int, *, device: torch.device | None = None) -> None:
        super().__init__()
        self.in_keys = [FEATURES, MEMORY, FIRST]
        self.out_keys = [FEATURES, ("next", MEMORY)]
        self.recurrent = GRUModule(
            num_features,
            size,
            in_keys=self.in_keys,
            out_keys=self.out_keys,
            device=device,
        )

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Replace the features; after a step, also leave what is remembered."""
        inputs = {key: tensordict.get(key) for key in self.in_keys}
        inputs[MEMORY] = inputs[MEMORY].unsqueeze(-2)  # of its one layer
        steps = TensorDict(inputs, batch_size=tensordict.batch_size)
        is_sequence = tensordict.ndim > 1
        with set_recurrent_mode(is_sequence):
            self.recurrent(steps)
        tensordict.set(FEATURES, steps.get(FEATURES))
        if not is_sequence:
            tensordict.set(("next", MEMORY), steps.get(("next", MEMORY)).squeeze(-2))
        return tensordict
