"""Exported policies act as ``predict`` does, in every format, and so do model files in NumPy."""

import hashlib
import json
import math
import os
import shutil
import subprocess
import zipfile
from types import SimpleNamespace

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from gymnasium.wrappers import FrameStackObservation
from jax import lax

from rejeu.agents import exporting
from rejeu.algorithms.sac.continuous import policy as sac_policy
from rejeu.core import spaces
from rejeu.core.spaces import parts
from rejeu.export import FORMATS, c_file, check, contract, onnx_file, stablehlo_file, web_file
from rejeu.export.npz_file import described
from rejeu.export.numpy_policy import NumpyProgram
from rejeu.export.program import trace
from rejeu.lab.cli import main
from rejeu.lab.policies import load_policy
from tests.environments import Sampled, Timed
from tests.export.policies import KINDS, agent_of, made, observations
from tests.tiers import crossed, exhaustive, only

onnxruntime = pytest.importorskip("onnxruntime")
has_compiler = any(map(shutil.which, c_file.COMPILERS))
NAMES = ("onnx", "c", "stablehlo")
POLICIES = {
    "squashed Gaussian": ("onnx", "SAC", "Box", {"normalize": True}),
    "Dict": ("c", "A2C", "Box", {"observation": "small Dict", "normalize": True}),
    "goals that share statistics": ("stablehlo", "DDPG", "Box", {"observation": "goals Dict", "normalize": {"clip_obs": 1.0}}),
    "GRU": ("onnx", "RecurrentPPO", "Box", {"policy_kwargs": {"lstm_hidden_size": 8, "cell": "gru"}}),
    "MultiDiscrete": ("c", "PPO", "MultiDiscrete", {}),
    "MultiDiscrete with masks": ("stablehlo", "MaskablePPO", "MultiDiscrete", {}),
    "MultiBinary": ("onnx", "A2C", "MultiBinary", {}),
    "whole numbers": ("c", "SAC", "whole numbers", {}),
    "unbounded": ("stablehlo", "PPO", "unbounded", {}),
    "squashed": ("onnx", "PPO", "Box", {"policy_kwargs": {"squash_output": True, "net_arch": [16]}}),
    "SimBa": ("c", "SAC", "Box", {"policy_kwargs": {"architecture": "simba", "width": 16}}),
    "layer norm": (
        "stablehlo", "TD3", "Box", {"policy_kwargs": {"net_arch": [16], "layer_norm": True, "activation_fn": "elu"}},
    ),
    "branches": (
        "onnx", "SAC", "Box",
        {"policy_kwargs": {"state_layers": [8], "actor_layers": [8], "activation_fn": "gelu"}},
    ),
    "dueling": ("c", "DQN", "Discrete", {"policy_kwargs": {"net_arch": [16], "activation_fn": "silu"}}),
    "categorical": ("stablehlo", "DQN", "Discrete", {"distribution": "categorical"}),
    "quantiles": ("onnx", "QRDQN", "Discrete", {"observation": "small Dict"}),
    "IQN": ("c", "IQN", "Discrete", {}),
    "linear": ("stablehlo", "ARS", "Box", {"policy_kwargs": {"net_arch": []}, "zero_policy": False}),
    "batch renormalization": ("onnx", "CrossQ", "Box", {}),
    "FlashSAC": ("c", "FlashSAC", "Box", {"normalize": True}),
    "XQC": ("stablehlo", "XQC", "Box", {}),
    "IQL": ("onnx", "IQL", "Box", {}),
    "masks of SAC": ("c", "SAC", "Discrete", {"action_masks": True}),
    "CNN with layer norm": ("onnx", "PPO", "Box", {"observation": "CNN", "policy_kwargs": {"cnn_layer_norm": True}}),
}  # fmt: skip
"""Every code path of policies, by default each in one format. The others are in the exhaustive tier."""
FORMS = [(o, n) for o in ("MLP", "CNN", "Dict", "small Dict") for n in (False, True)]
CASES = [
    *(pytest.param(*given, [target], id=f"{one}-{target}") for one, (target, *given) in POLICIES.items()),
    *(
        pytest.param(*given, [other for other in NAMES if other != target], id=one, marks=exhaustive)
        for one, (target, *given) in POLICIES.items()
    ),
    *(
        pytest.param(*kind, {"observation": observation, "normalize": normalize}, NAMES, marks=exhaustive)
        for kind in KINDS
        for observation, normalize in FORMS
    ),
    pytest.param("PPO", "Box", {"use_sde": True}, NAMES, marks=exhaustive),
    pytest.param("DQN", "Discrete", {"action_masks": True}, NAMES, marks=exhaustive),
    pytest.param("QRDQN", "Discrete", {"observation": "large CNN"}, NAMES, marks=exhaustive),
]


@pytest.fixture(autouse=True)
def fewer(monkeypatch):
    monkeypatch.setattr(check, "OBSERVATIONS", 100)


def skip_without_compiler(target):
    if target == "c" and not has_compiler:
        pytest.skip("there is no C compiler")


def inputs_of(agent, samples):
    """The observations as a file takes them, by name."""
    leaves = spaces.leaves(agent.observation_space)
    rows = [parts(agent.observation_space, one) for one in samples]
    return {
        leaf.path or "observation": np.stack([np.asarray(row[i], leaf.dtype) for row in rows])
        for i, leaf in enumerate(leaves)
    }


@pytest.mark.parametrize(("name", "action", "settings", "targets"), CASES)
def test_files_and_numpy_act_as_predict(name, action, settings, targets, tmp_path):
    agent = agent_of(name, action, **settings)
    for target in targets:
        if target == "c" and not has_compiler:
            continue
        found = agent.export(tmp_path / f"policy{FORMATS[target].suffix}")
        assert found.check.n == 100
        assert found.check.difference <= 1e-5
        assert found.bytes == found.path.stat().st_size > 1000
    policy, samples = load_policy(agent.export(tmp_path / "policy.npz").path), observations(agent, 40, seed=5)
    expected = np.stack([agent.predict(one, deterministic=True)[0] for one in samples])
    found = np.stack([policy.predict(one)[0] for one in samples])
    assert found.dtype == expected.dtype
    assert len(np.unique(expected)) > 1  # else any constant would do
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-5 if expected.dtype.kind == "f" else 0)


def test_a_batch_of_observations_has_the_actions_of_predict(tmp_path):
    agent = agent_of("SAC", "Box", "small Dict", normalize=True)
    path = agent.export(tmp_path / "policy.onnx").path
    samples = observations(agent, 50, seed=3)
    (action,) = onnxruntime.InferenceSession(path).run(["action"], inputs_of(agent, samples))
    expected = np.stack([agent.predict(one, deterministic=True)[0] for one in samples])
    np.testing.assert_allclose(action, expected, atol=1e-5)
    assert np.ptp(expected, axis=0).min() > 0.1  # else any constant would do


def test_memory_and_masks_are_inputs_that_matter(tmp_path):
    agent = agent_of("RecurrentPPO", "Box")
    session = onnxruntime.InferenceSession(agent.export(tmp_path / "policy.onnx").path)
    state, memory = None, {one.name: np.zeros((1, 8), np.float32) for one in session.get_inputs()[1:-1]}
    for i, one in enumerate(observations(agent, 30, seed=3)):
        start = np.array([i % 10 == 0])
        action, state = agent.predict(one[None], state, start, deterministic=True)
        given = {"observation": one[None], "episode_start": start, **memory}
        found = session.run(None, given)
        np.testing.assert_allclose(found[0], action, atol=1e-5)
        memory = dict(zip(memory, found[1:], strict=True))
    masked = agent_of("MaskablePPO", "Discrete")
    session = onnxruntime.InferenceSession(masked.export(tmp_path / "masked.onnx").path)
    obs = np.zeros((3, 4), np.float32)
    (action,) = session.run(None, {"observation": obs, "action_mask": np.eye(3, dtype=bool)})
    assert action.tolist() == [1, 2, 3]


class Counting(Timed):
    """Images, or vectors, that hold the number of the step; episodes of 7 steps."""

    action_space = gym.spaces.Box(-2, 2, (2,), np.float32)
    length, ends = 7, "terminated"

    def __init__(self, shape=(3, 40)):
        self.observation_space = gym.spaces.Box(0, 255, shape, np.uint8)

    def observe(self):
        noise = self.np_random.integers(0, 5, self.observation_space.shape, np.uint8)
        return np.full(self.observation_space.shape, 20 * self.time + 5, np.uint8) + noise


@pytest.mark.parametrize(("padding", "target"), crossed(["reset", "zero"], ["onnx", "c"]))
def test_frames_are_stacked_inside_of_a_file(padding, target, tmp_path, monkeypatch):
    skip_without_compiler(target)
    make = lambda: FrameStackObservation(Counting(), 4, padding_type=padding)  # noqa: E731
    agent = made("PPO", "MlpPolicy", make(), policy_kwargs={"net_arch": [16]})
    monkeypatch.setattr(exporting, "environment", lambda *_: (agent.make_envs(make(), 1, seed=0), None))
    path = tmp_path / f"policy{FORMATS[target].suffix}"
    found = agent.export(path, frame_stack=4)
    assert found.check.difference <= 1e-5
    card = json.loads(found.card.read_text())
    assert card["frame_stack"] == {"n": 4, "padding": padding}
    assert [(one["name"], one.get("shape")) for one in card["inputs"]] == [
        ("observation", [3, 40]), ("state_0", [4, 3, 40]), ("episode_start", []),
    ]  # fmt: skip


def test_the_frames_of_replay_and_of_channels_are_stacked_too(tmp_path):
    env = DiscreteActions(FrameStackObservation(Counting((3, 8)), 4))
    images = made("DQN", "MlpPolicy", env, frame_stack=4, buffer_size=500, policy_kwargs={"net_arch": [8]})
    assert images.export(tmp_path / "policy.onnx").check.difference <= 1e-5
    session = onnxruntime.InferenceSession(tmp_path / "policy.onnx")
    frames, stack, start = np.zeros((5, 3, 8), np.uint8), np.zeros((5, 4, 3, 8), np.uint8), np.zeros(5, bool)
    assert session.run(None, {"observation": frames, "state_0": stack, "episode_start": start})[1].shape == stack.shape
    vectors = agent_of("SAC", "Box")
    skip_without_compiler("c")
    found = vectors.export(tmp_path / "vectors.c", frame_stack=2)
    assert found.check.difference <= 1e-5
    assert "_OBSERVATION_SIZE 2" in (tmp_path / "vectors.h").read_text()
    with pytest.raises(ValueError, match=r"frame_stack=3 does not fit observations of the shape \[4\]"):
        vectors.export(tmp_path / "other.c", frame_stack=3)


class DiscreteActions(gym.ActionWrapper):
    """Actions of no effect."""

    def __init__(self, env):
        super().__init__(env)
        self.action_space = gym.spaces.Discrete(3)

    def action(self, action):
        return np.zeros(2, np.float32)


def test_noise_is_an_input(tmp_path):
    agent = agent_of("SAC", "Box")
    session = onnxruntime.InferenceSession(agent.export(tmp_path / "policy.onnx", noise=True).path)
    rng = np.random.default_rng(0)
    obs, noise = rng.normal(size=(20, 4)).astype(np.float32), rng.normal(size=(20, 2)).astype(np.float32)
    (action,) = session.run(None, {"observation": obs, "noise_0": noise})
    drawn = sac_policy(agent.state.actor, obs)
    low, high = agent.action_space.low, agent.action_space.high
    expected = low + (np.tanh(drawn.mean + np.exp(drawn.log_std) * noise) + 1) * (high - low) / 2
    np.testing.assert_allclose(action, expected, atol=1e-5)


@pytest.mark.parametrize(
    ("name", "action"),
    [
        ("PPO", "Discrete"),
        *(pytest.param(*one, marks=exhaustive) for one in (("DQN", "Discrete"), ("RecurrentPPO", "Box"))),
    ],
)
def test_uniform_noise_samples_the_policy(name, action, tmp_path):
    agent = agent_of(name, action)
    session = onnxruntime.InferenceSession(agent.export(tmp_path / "policy.onnx", noise=True).path)
    rng, given = np.random.default_rng(0), {}
    for one in session.get_inputs():
        shape = [4000, *one.shape[1:]]
        kind = rng.normal if name == "RecurrentPPO" else rng.random
        given[one.name] = kind(size=shape).astype(np.float32) if one.type == "tensor(float)" else np.ones(shape, bool)
    given["observation"] = np.repeat(np.ones((1, 4), np.float32), 4000, axis=0)
    actions = session.run(None, given)[0]
    again = agent.predict(given["observation"], deterministic=False)[0]
    if action == "Discrete":
        counts, expected = (np.bincount(one, minlength=4) for one in (actions, again))
        np.testing.assert_allclose(counts, expected, atol=200)  # four standard deviations are 130
    else:
        np.testing.assert_allclose(actions.std(axis=0), again.std(axis=0), rtol=0.1)


@pytest.mark.parametrize(
    ("space", "expected"),
    [
        (gym.spaces.Discrete(3, start=-1), (-1, 1)),
        (gym.spaces.MultiDiscrete([3, 2], start=[1, 5]), ([1, 5], [3, 6])),
        (gym.spaces.MultiBinary(3), (0, 1)),
        (gym.spaces.Box(np.array([-2, 0], np.float32), np.array([2, 5], np.float32)), ([-2, 0], [2, 5])),
    ],
)
def test_bounds_are_the_smallest_and_the_largest_values(space, expected):
    assert contract.bounds(space) == expected


def test_the_duration_of_a_step_is_that_of_the_environment():
    durations = [
        exporting.seconds_per_step(SimpleNamespace(unwrapped=SimpleNamespace(**given)))
        for given in ({"config": {"policy_frequency": 5}}, {"tau": 0.02}, {"dt": 0.05, "config": {}}, {"dt": "slow"})
    ]
    assert durations == [0.2, 0.02, 0.05, None]


def test_the_contract_is_in_the_file_and_beside_it(tmp_path):
    agent = made("SAC", "MlpPolicy", "Pendulum-v1", seed=3, policy_kwargs={"net_arch": [8]}).learn(
        12
    )  # none learns yet
    found = agent.export(tmp_path / "policy.onnx", batch=2)
    session = onnxruntime.InferenceSession(found.path)
    card = json.loads(session.get_modelmeta().custom_metadata_map["rejeu"])
    beside = json.loads(found.card.read_text())
    assert {key: beside[key] for key in card} == card
    assert (card["algorithm"], card["env_id"], card["seed"], card["steps"]) == ("SAC", "Pendulum-v1", 3, 12)
    assert card["seconds_per_step"] == 0.05
    assert card["inputs"][0]["high"] == [1.0, 1.0, 8.0]
    assert (card["outputs"][0]["low"], card["outputs"][0]["dtype"]) == (-2.0, "float32")
    assert session.get_inputs()[0].shape == [2, 3]
    assert beside["check"]["source"] == "Pendulum-v1"


@pytest.mark.skipif(os.name != "posix", reason="the compiler is a script of a shell")
def test_what_a_compiler_says_in_another_encoding_is_passed_on(tmp_path, monkeypatch):
    compiler = tmp_path / "compiler"
    compiler.write_text("#!/bin/sh\nprintf '\\377: no space left' >&2\nexit 1\n")
    compiler.chmod(0o755)
    monkeypatch.setattr(c_file, "main_of", lambda policy, stem: b"")
    run = c_file.c_run(None, b"", b"", "policy", str(compiler))
    with pytest.raises(RuntimeError, match=r"does not compile the C file: .*: no space left"):
        run({})


@pytest.mark.skipif(not has_compiler, reason="needs a C compiler")
@pytest.mark.parametrize("compiler", only(["gcc"], ["gcc", "clang"]))
def test_c_compiles_as_c_and_is_included_by_cpp(compiler, tmp_path, monkeypatch):
    monkeypatch.setattr(c_file, "COMPILERS", (compiler,))
    agent = agent_of("RecurrentPPO", "Box", "small Dict", normalize=True)
    found = agent.export(tmp_path / "my-policy.c")
    if shutil.which(compiler):
        assert found.check.difference <= 1e-5
    header = (tmp_path / "my-policy.h").read_text()
    card = json.loads((tmp_path / "my-policy.c.json").read_text())
    assert card["sha256"] == hashlib.sha256((tmp_path / "my-policy.c").read_bytes()).hexdigest()
    assert "#define MY_POLICY_SPEED_SIZE 3" in header
    assert "void my_policy_act(const uint8_t nested_0[16], const int32_t nested_1[1], const float speed[3]" in header
    assert "void my_policy_reset(void);" in header
    if shutil.which("g++"):
        (tmp_path / "main.cc").write_text('#include "my-policy.h"\nint main() { my_policy_reset(); }')
        subprocess.run(["g++", "-Wall", "-Wextra", "-Werror", "-c", "main.cc"], cwd=tmp_path, check=True)


def test_stablehlo_is_for_every_kind_of_device(tmp_path):
    path = agent_of("PPO", "Discrete").export(tmp_path / "policy.stablehlo").path
    with zipfile.ZipFile(path) as file:
        content = jax.export.deserialize(bytearray(file.read(stablehlo_file.EXPORTED)))
    assert content.platforms == ("cpu", "cuda", "tpu")


def test_a_file_that_differs_is_not_kept(tmp_path, monkeypatch):
    agent, path = agent_of("SAC", "Box"), tmp_path / "policy.onnx"
    path.write_bytes(b"older")
    scaler = spaces.action_scaler
    wrong = lambda space, xp=np: lambda action: (1 if xp is np else 1.001) * scaler(space, xp)(action)  # noqa: E731
    monkeypatch.setattr(spaces, "action_scaler", wrong)
    with pytest.raises(ValueError, match=r"differs from predict by .* and was not kept"):
        agent.export(path)
    assert path.read_bytes() == b"older"
    assert [*tmp_path.iterdir()] == [path]


def test_choices_that_differ_must_be_equally_good():
    agent = agent_of("PPO", "Discrete")
    one = exporting.policy_for(agent, False, 1)
    recording, *_ = exporting.record(agent, one, None)
    seconds = 1e-6 * np.linspace(1, 101, 100)
    run = lambda inputs: (recording.actions % 3 + 1, seconds)  # noqa: E731
    found = check.compare(one, recording, run)
    assert (found.difference, found.ties, found.n) == (1.0, 0, 100)
    assert (found.p50, found.p99) == pytest.approx((51, 100))  # microseconds
    equal = jax.tree.map(np.zeros_like, agent.state)
    agent.run.state = agent.learner.pack(equal)
    one = exporting.policy_for(agent, False, 1)
    found = check.compare(one, recording, run)
    assert (found.difference, found.ties) == (0.0, 100)
    if has_compiler:  # of equally good choices predict takes the first
        run = c_file.c_run(one, *c_file.write(one, exporting.card_of(agent, one, "c", "", None), "policy"), "policy")
        assert check.compare(one, recording._replace(actions=np.ones(100, np.int64)), run)[2:4] == (0.0, 0)


def test_invalid_arguments_are_one_line(tmp_path):
    agent = agent_of("PPO", "Box")
    for name, arguments, message in (
        ("policy.txt", {}, r"no format that a policy can be exported to; there are onnx \(.onnx\), c"),
        ("policy.onnx", {"to": "tflite"}, "to='tflite' is no format"),
        ("policy.onnx", {"batch": 0}, "batch=0 must be a number of observations"),
        ("policy.c", {"batch": 2}, "c takes one observation at a time"),
        ("policy.npz", {"batch": 2}, "npz takes any number of observations"),
        ("policy.npz", {"noise": True}, "npz contains the deterministic policy"),
        ("policy.npz", {"frame_stack": 2}, "npz takes observations as predict does"),
        ('x"y.c', {}, "cannot be included by a C program"),
        ("x\\y.c", {}, "cannot be included by a C program"),
        ("x\ny.c", {}, "cannot be included by a C program"),
    ):
        with pytest.raises(ValueError, match=message):
            agent.export(tmp_path / name, **arguments)
    with pytest.raises(ValueError, match="always returns the same action"):
        agent_of("TD3", "Box").export(tmp_path / "policy.onnx", noise=True)
    assert not [*tmp_path.iterdir()]


def test_the_command_exports_a_run(tmp_path, capsys):
    made("PPO", "MlpPolicy", "CartPole-v1", policy_kwargs={"net_arch": [8]}).save(tmp_path / "model.safetensors")
    assert main(["export", str(tmp_path / "model.safetensors"), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert (found["target"], found["check"]["source"]) == ("onnx", "CartPole-v1")
    assert (tmp_path / "model.onnx").is_file()
    assert main(["export", str(tmp_path / "missing"), "--to", "c"]) == 2
    assert main(["export", str(tmp_path / "model.safetensors"), "--out", str(tmp_path / "policy.exe")]) == 2
    errors = capsys.readouterr().err.splitlines()
    assert "there is no run folder or model file" in errors[0]
    assert "is no format that a policy can be exported to" in errors[1]


WORDS = ("int", "double", "for", "static", "tanhf", "INFINITY", "v0", "c1", "int8_t", "A", "a", "action", "sum", "main")


@pytest.mark.skipif(not has_compiler, reason="needs a C compiler")
@pytest.mark.parametrize("name", only(["-o.c"], ["main.c", "-o.c", "int.c", "model.onnx", "model.stablehlo"]))
def test_keys_may_be_words_of_c_and_names_of_outputs(name, tmp_path):
    space = gym.spaces.Dict({word: gym.spaces.Box(-1, 1, (1 + i % 3,)) for i, word in enumerate(WORDS)})
    env = Sampled(space, gym.spaces.Discrete(2))
    agent = made("PPO", "MultiInputPolicy", env, policy_kwargs={"net_arch": [4], "activation_fn": "tanh"})
    found = agent.export(tmp_path / name)
    assert found.check.n == check.OBSERVATIONS


def test_observations_with_practically_infinite_bounds_are_sampled_near_0():
    """The space of CartPole had float32's largest number as a bound, and values were infinite for samples of it."""
    most = np.finfo(np.float32).max
    x = exporting.moderate(np.array([[0.9 * most, -most, 3.0, 0.0]], np.float32), np.random.default_rng(0))
    assert np.abs(x).max() < 10
    assert x[0, 2:].tolist() == [3.0, 0.0]


def rounded(x):
    """Whole numbers, their quotients and remainders, the nearest whole numbers, and which numbers are not 0, as floats.

    Each is used once, so no array of whole numbers rounds it in the place of the expression.
    """
    by = jnp.int32([[3, -3, 2, -2]])
    parts = x.astype(jnp.int32), lax.div(x.astype(jnp.int32), by), lax.rem(x.astype(jnp.int32), by), jnp.rint(x), x != 0
    return (jnp.concatenate([one.astype(jnp.float32) for one in (*parts, x.astype(bool))], axis=1),)


def run_rounded(target, x):
    """The results of :func:`rounded` in a format, one row at a time."""
    program = trace(rounded, jax.ShapeDtypeStruct((1, 4), np.float32))
    if target == "npz":
        return [NumpyProgram(*described(program), [row])(1, [row])[0][0] for row in x[:, None]]
    if target == "web":
        code = (web_file.TEMPLATES / "web.js").read_text(encoding="utf-8") + web_file.function("f", program)
        call = 'const rows = JSON.parse(require("fs").readFileSync(0, "utf8")); console.log(JSON.stringify('
        return web_file.node(code + call + "rows.map((row) => Array.from(f(row)[0]))));", x.tolist())
    ports = (
        contract.Port("observation", "observation", (4,), "float32"),
        contract.Port("action", "action", (24,), "float32"),
    )
    policy = contract.Policy(program, ports[:1], ports[1:], 1)
    if target == "c":
        return c_file.c_run(policy, *c_file.write(policy, {"rejeu": "", "weights": ""}, "p"), "p")({"observation": x})[
            0
        ]
    return onnx_file.onnx_run(policy, onnx_file.write(policy, {}))({"observation": x})[0]


@pytest.mark.parametrize("target", ["npz", "onnx", "c", "web"])
def test_every_format_rounds_towards_zero_and_halves_to_even(target):
    if (target == "c" and not has_compiler) or (target == "web" and shutil.which("node") is None):
        pytest.skip("nothing runs it")
    x = np.random.default_rng(0).permutation(np.arange(-24, 24) / 2).astype(np.float32).reshape(12, 4)
    expected = []
    for row in x.tolist():
        whole = [int(one) for one in row]
        quotients = [int(math.copysign(abs(n) // abs(by), n * by)) for n, by in zip(whole, (3, -3, 2, -2), strict=True)]
        rests = [n - q * by for n, q, by in zip(whole, quotients, (3, -3, 2, -2), strict=True)]
        expected.append([*whole, *quotients, *rests, *map(round, row), *(one != 0 for one in row), *map(bool, row)])
    np.testing.assert_array_equal(run_rounded(target, x), expected)
