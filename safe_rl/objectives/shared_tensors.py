"""Losses whose networks keep the tensors of the loss."""

from __future__ import annotations

from typing import Any

from torch import nn
from torchrl.objectives import LossModule


class SharesTensors(LossModule):
    """Base of losses whose networks share the loss's tensors, also after a copy or a move.

    A loss of TorchRL has parameters and buffers apart from its networks, which share them when it
    is built. After ``copy.deepcopy`` they no longer do, so that the copy would train tensors that
    its networks don't have. After a move the networks would keep their earlier buffers.
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
