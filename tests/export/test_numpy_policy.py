"""``rejeu.load_policy``: exported policies act in NumPy, in processes without JAX. See also ``test_export``."""

import copy
import io
import json
import subprocess
import sys
import zipfile

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax import lax

from rejeu import load_policy
from rejeu.core.errors import CheckpointError
from rejeu.export import PRIMITIVES, numpy_policy
from rejeu.export.npz_file import described
from rejeu.export.numpy_policy import FUNCTIONS, POLICY, NumpyProgram
from rejeu.export.program import trace
from tests.export.policies import agent_of, observations

X = np.array([[-2.5, -0.5, 0.25], [0.5, 1.5, 3.0]], np.float32)
Y = np.array([[2.0, -1.5, 0.5], [0.75, 1.0, -2.0]], np.float32)
UNIT, ABOVE = ("acos", "asin"), ("log", "sqrt", "pow")
TWO = ("add", "add_any", "atan2", "div", "eq", "ge", "gt", "le", "lt", "max", "min", "mul", "pow", "rem", "sub")
BITS = ("and", "or", "xor", "not")


@pytest.mark.parametrize("name", sorted(PRIMITIVES))
def test_a_primitive_has_the_results_of_jax(name):
    primitive = {"add_any": lax.add, "and": jnp.bitwise_and, "or": jnp.bitwise_or, "not": jnp.bitwise_not}
    primitive |= {"xor": jnp.bitwise_xor, "select_n": lambda x: lax.select_n(x > 0, x, -x), "round": jnp.rint}
    function = primitive.get(name) or getattr(lax, name)
    x = X / 4 if name in UNIT else np.abs(X) if name in ABOVE else X > 0 if name in BITS else X
    y = Y > 0 if name in BITS else Y
    arguments = (x, y) if name in (*TWO, "and", "or", "xor") else (x,)
    (result,) = in_numpy(function, *arguments)
    expected = np.asarray(function(*map(jnp.asarray, arguments)))
    assert result.dtype == expected.dtype
    np.testing.assert_allclose(result, expected, rtol=1e-6, atol=1e-7)


@pytest.mark.parametrize(
    "function",
    [
        lambda x, y: x.reshape(3, 2).T @ y.T.reshape(3, 2),
        lambda x, y: jnp.einsum("ab,ac->abc", x, y),
        lambda x, y: jnp.einsum("abc,acd->bad", x[None], y[None].transpose(0, 2, 1)),
        lambda x, y: (x[:, ::2], y[1:, 1:], jnp.split(x, [1], axis=1), jnp.squeeze(y[:1])),
        lambda x, y: (x.sum(0), x.max(1), y.min((0, 1)), x.argmax(1), jnp.concatenate([x, y], 0)),
        lambda x, y: lax.select_n(jnp.int32([[0, 1, 2]]) + jnp.zeros((2, 1), jnp.int32), x, y, x + y),
        lambda x, y: jnp.broadcast_to(y[0, 0], x.shape) + x,
    ],
)
def test_operations_on_whole_arrays_have_the_results_of_jax(function):
    expected = [np.asarray(one) for one in jax.tree.leaves(function(jnp.asarray(X), jnp.asarray(Y)))]
    for result, one in zip(in_numpy(function, X, Y), expected, strict=True):
        assert result.dtype == one.dtype
        np.testing.assert_allclose(result, one, rtol=1e-6)


def in_numpy(function, *arrays):
    program = trace(function, *(jax.ShapeDtypeStruct(one.shape, one.dtype) for one in arrays))
    return NumpyProgram(*described(program), arrays)(len(arrays[0]), arrays)


def test_every_elementwise_primitive_has_a_function():
    assert PRIMITIVES.keys() <= FUNCTIONS.keys()


def test_batches_and_masks(tmp_path):
    agent = agent_of("MaskablePPO", "Discrete")
    policy = load_policy(agent.export(tmp_path / "policy.npz").path)
    obs, masks = np.stack(observations(agent, 3, seed=0)), np.eye(3, dtype=bool)
    assert policy.predict(obs, action_masks=masks)[0].tolist() == [1, 2, 3]
    assert policy.predict(obs, "kept")[1] == "kept"
    np.testing.assert_array_equal(policy.predict(obs)[0], agent.predict(obs, deterministic=True)[0])
    with pytest.raises(ValueError, match=r"has shape \(3,\), expected \(4,\), or a batch of it"):
        policy.predict(np.zeros(3))
    with pytest.raises(ValueError, match="deterministic"):
        policy.predict(np.zeros(4), deterministic=False)
    for name in ("missing", "missing.npz"):
        with pytest.raises(FileNotFoundError):
            load_policy(tmp_path / name)


def test_a_model_acts_as_its_exported_file(tmp_path):
    agent = agent_of("SAC", "Box", "small Dict", normalize=True)
    model, file = agent.save(tmp_path / "model"), agent.export(tmp_path / "policy.npz").path
    for one in observations(agent, 5, seed=1):
        np.testing.assert_array_equal(load_policy(model).predict(one)[0], load_policy(file).predict(one)[0])


def test_memory_goes_from_call_to_call_and_starts_again_with_an_episode(tmp_path):
    agent = agent_of("RecurrentPPO", "Box")
    policy = load_policy(agent.export(tmp_path / "policy.npz").path)
    obs, memory, state = np.stack(observations(agent, 8, seed=2)).reshape(4, 2, 4), None, None
    for i, one in enumerate(obs):
        starts = np.array([i == 0, i in (0, 2)])
        expected, memory = agent.predict(one, memory, starts, deterministic=True)
        action, state = policy.predict(one, state, None if i == 0 else starts)
        np.testing.assert_allclose(action, expected, atol=1e-5)
    assert np.abs(action - policy.predict(obs[-1])[0]).max() > 0.01  # memory matters


def test_observations_are_clipped_as_in_training(tmp_path):
    agent = agent_of("SAC", "Box", normalize={"norm_obs": True, "norm_reward": False, "clip_obs": 0.5})
    policy = load_policy(agent.save(tmp_path / "model"))
    for obs in (np.full(4, 50, np.float32), np.full(4, -50, np.float32)):
        np.testing.assert_allclose(policy.predict(obs)[0], agent.predict(obs, deterministic=True)[0], atol=1e-5)


def test_no_jax_is_imported(tmp_path):
    path = agent_of("SAC", "Box").export(tmp_path / "policy.npz").path
    code = (
        f"import sys, rejeu, numpy; policy = rejeu.load_policy({str(path)!r}); "
        "policy.predict(numpy.zeros(4, numpy.float32)); print('jax' in sys.modules, 'equinox' in sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stdout.split() == ["False", "False"]


def test_a_model_without_jax_is_an_error_that_says_what_to_do(tmp_path, monkeypatch):
    path = agent_of("SAC", "Box").save(tmp_path / "model")
    monkeypatch.setitem(sys.modules, "rejeu.agents", None)
    with pytest.raises(CheckpointError, match=r"is a model, and .* is not installed; .*rejeu export .* --to npz"):
        load_policy(path)


def replaced(description, operations):
    return {**description, "program": {**description["program"], "operations": operations}}


HOSTILE = {
    "no JSON": lambda content: b"{",
    "deep JSON": lambda content: b"[" * 10**5,
    "no program": lambda content: {},
    "another shape": lambda content: {**content, "action_space": {"Discrete": {"n": 3, "start": 0}}},
    "an unknown operation": lambda content: replaced(content, [["system", [0], [99], {}]]),
    "an unknown array": lambda content: replaced(content, [["tanh", [10**9], [99], {}]]),
    "too few operations": lambda content: replaced(content, content["program"]["operations"][:-1]),
    "a huge array": lambda content: replaced(
        content, [["broadcast_in_dim", [0], [99], {"shape": [10**6] * 3, "broadcast_dimensions": []}]]
    ),
    "a huge space": lambda content: {**content, "observation_space": {"Discrete": {"n": 10**12, "start": 0}}},
    "many large arrays": lambda content: replaced(
        content,
        [
            ["broadcast_in_dim", content["program"]["inputs"], [98], {"shape": [2**23, 4], "broadcast_dimensions": [0, 1]}],
            *(["add", [98, 98], [98], {}] for _ in range(9)),
        ],
    ),
}  # fmt: skip


def test_a_file_of_pickles_is_refused_in_our_words(tmp_path):
    np.savez(tmp_path / "policy.npz", **{POLICY: np.array([{}], object)})
    with pytest.raises(CheckpointError, match=r"\(it holds pickles, which are not read\); export the model again"):
        load_policy(tmp_path / "policy.npz")


@pytest.mark.parametrize("kind", HOSTILE)
def test_a_file_that_is_not_valid_is_refused(kind, tmp_path):
    path = agent_of("PPO", "Box").export(tmp_path / "policy.npz").path
    with np.load(path) as arrays:
        parts = dict(arrays)
    content = HOSTILE[kind](json.loads(parts[POLICY].tobytes()))
    content = content if isinstance(content, bytes) else json.dumps(content).encode()
    np.savez(path, **{**parts, POLICY: np.frombuffer(content, np.uint8)})
    with pytest.raises(
        CheckpointError, match=r"is damaged, or not written by rejeu export --to npz \(.*export the model again"
    ):
        load_policy(path)


def test_a_damaged_compressed_or_pickled_file_is_refused(tmp_path):
    path = agent_of("PPO", "Box").export(tmp_path / "policy.npz").path
    content = path.read_bytes()
    with np.load(path) as arrays:
        parts = dict(arrays)
    np.savez_compressed(compressed := io.BytesIO(), **parts)
    np.savez(pickled := io.BytesIO(), **{**parts, POLICY: np.array([{}], object)})
    flipped = bytearray(content)
    with zipfile.ZipFile(path) as file:
        flipped[file.getinfo("c0.npy").header_offset + 200] ^= 1
    for other in (content[:-30], b"", b"text", bytes(flipped), compressed.getvalue(), pickled.getvalue()):
        path.write_bytes(other)
        with pytest.raises(CheckpointError, match="is damaged"):
            load_policy(path)


def test_an_operation_that_numpy_lacks_is_named():
    with pytest.raises(ValueError, match=r"cannot be exported to npz: JAX's primitive 'cumsum' .*no translation"):
        described(trace(lambda x: jnp.cumsum(x, 1), jax.ShapeDtypeStruct((2, 3), np.float32)))


def test_numbers_are_counted_before_they_are_computed():
    x = np.zeros((10, 1000), np.float32)
    assert numpy_policy.count("add", {}, [x, x[:, :1]]) == 10_000
    assert numpy_policy.count("broadcast_in_dim", {"shape": [-1, 7, 8]}, [x]) == 56
    assert numpy_policy.count("concatenate", {}, [x, x]) == 20_000
    assert numpy_policy.count("matmul", {}, [x, x.T]) == 10 * 10 * 1000 // 256


def test_members_that_overlap_are_not_read():
    """The table of contents names one array of 1 MiB a hundred times."""
    file = io.BytesIO()
    with zipfile.ZipFile(file, "w") as archive:
        archive.writestr("c0.npy", bytes(2**20))
        for i in range(1, 100):
            archive.filelist.append(copy.copy(archive.filelist[0]))
            archive.filelist[-1].filename = f"c{i}.npy"
    with pytest.raises(ValueError, match="its members overlap"):
        numpy_policy.parse(file.getvalue())
