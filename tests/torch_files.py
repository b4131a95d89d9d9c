"""Files of PyTorch and of Stable-Baselines3, made without either, to test what reads them."""

import base64
import io
import json
import pickle
import struct
import sys
import types
import zipfile
from collections import OrderedDict
from collections.abc import Callable, Mapping
from typing import Any
from unittest import mock

import numpy as np


def torch_modules() -> dict[str, types.ModuleType]:
    """Returns modules with the names that a file of tensors mentions, so that pickle can write them."""
    torch, utils = types.ModuleType("torch"), types.ModuleType("torch._utils")

    def _rebuild_tensor_v2() -> None: ...

    _rebuild_tensor_v2.__module__, _rebuild_tensor_v2.__qualname__ = "torch._utils", "_rebuild_tensor_v2"
    utils._rebuild_tensor_v2, torch._utils = _rebuild_tensor_v2, utils
    torch.FloatStorage = type("FloatStorage", (), {"__module__": "torch"})
    return {"torch": torch, "torch._utils": utils}


class Tensor:
    """An array that is written as a tensor."""

    def __init__(self, array: Any) -> None:
        self.array = np.ascontiguousarray(array, np.float32)


def pickled(
    content: Any, stream: io.BytesIO, name_storage: Callable[[str, int], tuple[Any, ...]], **options: Any
) -> list[bytes]:
    """Pickles ``content`` as PyTorch does and returns the storages of its ``Tensor`` objects, each with one of its own.

    ``name_storage`` returns the name of a storage in the file, by its number and its size.
    """
    storages: list[bytes] = []

    class Writer(pickle.Pickler):
        def persistent_id(self, obj: Any) -> Any:
            return obj[1] if isinstance(obj, tuple) and obj[:1] == ("a storage",) else None

        def reducer_override(self, obj: Any) -> Any:
            if not isinstance(obj, Tensor):
                return NotImplemented
            array = obj.array
            storage = ("a storage", name_storage(str(len(storages)), array.size))
            storages.append(array.tobytes())
            strides = tuple(n // 4 for n in array.strides)
            arguments = (storage, 0, array.shape, strides, False, OrderedDict())
            return sys.modules["torch._utils"]._rebuild_tensor_v2, arguments

    Writer(stream, **options).dump(content)
    return storages


def torch_file(content: Any, storages: Mapping[str, bytes] | None = None) -> bytes:
    """Returns a file of PyTorch; ``storages`` replaces those of the ``Tensor`` objects in ``content``, by number."""
    stream, modules = io.BytesIO(), torch_modules()
    name_storage = lambda key, size: ("storage", modules["torch"].FloatStorage, key, "cpu", size)  # noqa: E731
    with mock.patch.dict(sys.modules, modules):
        tensors = pickled(content, stream, name_storage, protocol=2)
    members = {"data.pkl": stream.getvalue(), "byteorder": b"little"}
    members |= {f"data/{i}": storage for i, storage in enumerate(tensors)}
    members |= {f"data/{key}": storage for key, storage in (storages or {}).items()}
    return zipped({f"archive/{name}": value for name, value in members.items()}, zipfile.ZIP_STORED)


def zipped(members: Mapping[str, bytes], compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Returns a zip file."""
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", compression) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return stream.getvalue()


def members_of(content: bytes) -> dict[str, bytes]:
    """Returns the members of a zip file."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def changed(content: bytes, data: Mapping[str, Any] | None = None, **files: bytes) -> bytes:
    """Returns a model file with other values in ``data``, and other files; ``policy_pth`` stands for ``policy.pth``."""
    members = members_of(content)
    members["data"] = json.dumps({**json.loads(members["data"]), **(data or {})}).encode()
    return zipped({**members, **{name.replace("_pth", ".pth"): value for name, value in files.items()}})


def serialized(value: Any) -> dict[str, str]:
    """Returns a value as Stable-Baselines3 writes it if it is not JSON."""
    content = value if isinstance(value, bytes) else pickle.dumps(value)
    return {":type:": str(type(value)), ":serialized:": base64.b64encode(content).decode()}


def old_torch_file(content: Any, storage_type: str = "FloatStorage", size: int | None = None) -> bytes:
    """Returns a file of PyTorch before 1.6 with the arrays of a dict; ``size`` replaces the number of values of storages."""
    stream, modules = io.BytesIO(), torch_modules()
    modules["torch"].__dict__[storage_type] = type(storage_type, (), {"__module__": "torch"})
    name_storage = lambda key, n: ("storage", getattr(modules["torch"], storage_type), key, "cpu", size or n, None)  # noqa: E731
    with mock.patch.dict(sys.modules, modules):
        for value in (0x1950A86A20F9469CFC6C, 1001, {"protocol_version": 1001, "little_endian": True}):
            pickle.dump(value, stream, protocol=2)
        storages = pickled(content, stream, name_storage, protocol=2)
        pickle.dump([str(key) for key in range(len(storages))], stream, protocol=2)
    return stream.getvalue() + b"".join(struct.pack("<q", len(storage) // 4) + storage for storage in storages)


def vecnormalize_file(obs_rms: Any, protocol: int = 4, **attributes: Any) -> bytes:
    """Returns a file of ``VecNormalize``; ``obs_rms`` is ``(mean, variance, count)``, or a dict of them by key."""
    names = ["stable_baselines3", "stable_baselines3.common", "stable_baselines3.common.running_mean_std"]
    names += ["stable_baselines3.common.vec_env", "stable_baselines3.common.vec_env.vec_normalize"]
    modules = {name: types.ModuleType(name) for name in names}
    classes = {}
    for name, module in (("RunningMeanStd", names[2]), ("VecNormalize", names[4])):
        classes[name] = type(name, (), {"__module__": module})
        setattr(modules[module], name, classes[name])

    def rms(value: Any) -> Any:
        statistics = classes["RunningMeanStd"]()
        statistics.mean, statistics.var = (np.asarray(moment, np.float64) for moment in value[:2])
        statistics.count = value[2]
        return statistics

    scaler = classes["VecNormalize"]()
    obs_statistics = (
        {key: rms(moments) for key, moments in obs_rms.items()} if isinstance(obs_rms, dict) else rms(obs_rms)
    )
    defaults = {"norm_obs": True, "norm_reward": True, "clip_obs": 10.0, "clip_reward": 10.0, "epsilon": 1e-8}
    more = {"gamma": 0.99, "training": True, "obs_rms": obs_statistics, "ret_rms": rms((0.5, 4.0, 100.0))}
    scaler.__dict__.update({**defaults, **more, **attributes})
    with mock.patch.dict(sys.modules, modules):
        return pickle.dumps(scaler, protocol)
