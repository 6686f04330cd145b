"""A step that must not look at values of tensors: on a GPU the host would wait for them."""

from contextlib import contextmanager

import torch
from torch.utils._python_dispatch import TorchDispatchMode

LOOKS = ("aten._local_scalar_dense", "aten.nonzero", "aten._unique", "aten.masked_select")


class CountLooks(TorchDispatchMode):
    """Counts how often the host would wait for values of tensors."""

    def __init__(self):
        super().__init__()
        self.num_looks = 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.num_looks += str(func).startswith(LOOKS)
        return func(*args, **(kwargs or {}))


class RefuseLooks(TorchDispatchMode):
    """Raises where the host would wait for values of tensors, outside of the physics."""

    def __init__(self, physics):
        super().__init__()
        self.physics, self.num_calls = physics, 0

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        self.num_calls += 1
        if not getattr(self.physics, "inside", False):
            assert not str(func).startswith(LOOKS), f"{func} waits for the device"
            if str(func).startswith(("aten.index.", "aten.index_put")):
                masks = [i for i in args[1] if i is not None and i.dtype == torch.bool]
                assert not masks, f"{func} with a mask waits for the device"
        return func(*args, **(kwargs or {}))


@contextmanager
def no_looks(physics, monkeypatch):
    """Fail if a value is read, copied to the host, or made without naming its device."""

    def refuse(name):
        original = getattr(torch.Tensor, name)

        def method(tensor, *arguments, **keywords):
            assert getattr(physics, "inside", False), f"Tensor.{name} in a step"
            return original(tensor, *arguments, **keywords)

        monkeypatch.setattr(torch.Tensor, name, method)

    with monkeypatch.context() as monkeypatch:
        for name in ("numpy", "cpu", "item", "tolist", "__array__"):
            refuse(name)
        # a tensor that is made without a device has no values here, so computing with it fails
        with RefuseLooks(physics) as mode, torch.device("meta"):
            yield mode
