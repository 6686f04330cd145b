"""Losses whose networks keep the tensors of the loss."""

from __future__ import annotations

from typing import Any

from torch import nn
from torchrl.objectives import LossModule


class SharesTensors(LossModule):
    """Base of losses that share their tensors with their networks, also after a copy or a move.

    A loss of TorchRL stores the parameters and buffers of its networks separately. When it is
    built, loss and networks share them. After ``copy.deepcopy`` they do not: training the copy
    would not change its networks. After a move, the networks would have their old buffers.
    """

    def _apply(self, *args: Any, **kwargs: Any) -> Any:
        moved = super()._apply(*args, **kwargs)
        self._share_tensors()
        return moved

    def __setstate__(self, state: dict[str, Any]) -> None:
        super().__setstate__(state)
        self._share_tensors()

    def _share_tensors(self) -> None:
        for name, params in self._modules.items():
            network = self.__dict__.get(name.removesuffix("_params"))
            if isinstance(network, nn.Module):
                params.to_module(network)
