"""The memory that tensors take."""

import weakref

import torch
from torch.utils._python_dispatch import TorchDispatchMode


class Memory(TorchDispatchMode):
    """Counts the bytes of the storages that operations make, while they live."""

    alive = most = 0

    def __init__(self):
        super().__init__()
        self.known = weakref.WeakSet()

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        made = func(*args, **(kwargs or {}))
        storage = made.untyped_storage() if isinstance(made, torch.Tensor) else None
        if storage is not None and storage not in self.known:
            self.known.add(storage)
            self.alive += storage.nbytes()
            weakref.finalize(storage, self.freed, storage.nbytes())
        self.most = max(self.most, self.alive)
        return made

    def freed(self, size):
        self.alive -= size
