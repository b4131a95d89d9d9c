"""Simulation of a full disk: files can be opened, but only half of the bytes are written."""

import errno
import io
import os
import pathlib


class FullDisk:
    """While ``full``, every write of ``rejeu.core.atomic`` fails after half of its bytes, as on a real disk."""

    def __init__(self, monkeypatch):
        self.full = False
        self.failures = 0
        opened = pathlib.Path.open

        def open_(path, mode="r", *arguments, **keywords):
            if self.full and mode in ("xb", "r+b"):
                return _Half(path, mode, self)
            return (open if "opener" in keywords else opened)(path, mode, *arguments, **keywords)

        monkeypatch.setattr(pathlib.Path, "open", open_)
        monkeypatch.setattr("rejeu.core.atomic.open", open_, raising=False)


class _Half(io.FileIO):
    def __init__(self, path, mode, disk):
        super().__init__(path, mode)
        self._disk = disk

    def write(self, content):
        super().write(memoryview(content)[: len(content) // 2])
        self._disk.failures += 1
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
