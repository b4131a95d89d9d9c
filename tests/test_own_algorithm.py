"""An algorithm outside of the package, ``examples/awac.py``, gets everything that rejeu's own algorithms have."""

import importlib
import json
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.agents import modules_of, presets
from rejeu.algorithms.config import OffPolicyConfig, to_json
from rejeu.callbacks import Checkpoint
from rejeu.core.algorithm import TD_ERROR, Transition
from rejeu.core.errors import CheckpointError
from rejeu.lab.experiments.folder import Plan, open_folder
from rejeu.lab.experiments.plan import PlanError, read_plan
from rejeu.lab.experiments.sweep import imports_of
from rejeu.lab.experiments.work import Job
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.read import RunSummary
from tests.environments import Reach

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / "examples" / "awac.py"
SMALL = {"learning_starts": 20, "batch_size": 8, "buffer_size": 500, "policy_kwargs": {"net_arch": [8]}, "seed": 0}
HER = {"replay_buffer_class": "HerReplayBuffer", "priorities": {}, "normalize": True}


class CarriedReach(Reach):
    """Its state can be saved, so that a run in it resumes exactly."""

    def get_state(self):
        return {
            "position": self.position,
            "goal": self.goal,
            "time": self.time,
            "rng": self.np_random.bit_generator.state,
        }

    def set_state(self, state):
        self.position, self.goal, self.time = state["position"], state["goal"], state["time"]
        self.np_random.bit_generator.state = state["rng"]


@pytest.fixture
def site(tmp_path):
    """A folder as pip would install the algorithm into, with its entry point."""
    folder = tmp_path / "site"
    info = folder / "awac-1.0.dist-info"
    info.mkdir(parents=True)
    (folder / "awac.py").write_text(SOURCE.read_text())
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: awac\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[rejeu.algorithms]\nAWAC = awac:AWAC\n")
    return folder


@pytest.fixture
def awac(site, monkeypatch):
    """The installed module, imported."""
    monkeypatch.syspath_prepend(site)
    yield importlib.import_module("awac")
    sys.modules.pop("awac", None)


def reach(n_envs=2):
    return rejeu.make_vec(CarriedReach, n_envs, "gymnasium", seed=0)


def test_the_page_shows_the_file():
    block = re.search(r"```python\n(.*?)```", (ROOT / "docs" / "own-algorithm.md").read_text(), re.DOTALL)[1]
    assert block == SOURCE.read_text()
    assert len(block.splitlines()) <= 120


def test_losses_equal_their_equations(awac):
    env = gym.make("Pendulum-v1")
    config = awac.Config(policy_kwargs={"net_arch": [8]}, beta=0.7)
    algorithm = awac.make(config, env.observation_space, env.action_space)
    state = algorithm.init(jax.random.PRNGKey(0))
    rng, key = np.random.default_rng(0), jax.random.PRNGKey(1)
    normal = lambda *shape: rng.normal(size=shape).astype(np.float32)  # noqa: E731
    batch = Transition(
        normal(6, 3), np.tanh(normal(6, 1)), normal(6), normal(6, 3), np.float32([0.9, 0, 0.9, 0.9, 0, 0.9])
    )

    def q(obs, action):
        return np.asarray(awac.action_values(state.critics, obs, action))

    def mean(obs):
        return np.tanh(np.asarray(state.actor.network(obs)))

    noise = np.asarray(jax.random.normal(key, (6, 1)))
    next_action = np.clip(mean(batch.next_obs) + noise, -1, 1)  # the standard deviation is 1 at first
    target = batch.reward + batch.discount * q(batch.next_obs, next_action).min(0)
    np.testing.assert_allclose(awac.td_target(state.actor, state.critics, batch, key), target, rtol=1e-5)

    error = q(batch.obs, batch.action) - target
    loss, _ = awac.critics_loss(state.critics, batch, jnp.asarray(target))
    np.testing.assert_allclose(loss, (error[0] ** 2).mean() + (error[1] ** 2).mean(), rtol=1e-5)

    advantage = q(batch.obs, batch.action).min(0) - q(batch.obs, np.clip(mean(batch.obs) + noise, -1, 1)).min(0)
    weight = np.exp(advantage / 0.7) / np.exp(advantage / 0.7).sum()
    log_prob = -0.5 * ((batch.action - mean(batch.obs)) ** 2)[:, 0] - 0.5 * np.log(2 * np.pi)
    loss = awac.actor_loss(state.actor, state.critics, batch, 0.7, key)
    np.testing.assert_allclose(loss, -(weight * log_prob).sum(), rtol=1e-5)


def test_training_saving_and_exact_resume_with_hindsight_priorities_and_normalization(awac, tmp_path):
    make = lambda: awac.AWAC("MultiInputPolicy", reach(), beta=2.0, **SMALL, **HER)  # noqa: E731
    whole = make().learn(120)
    assert whole.n_updates > 0
    stopped = make().learn(120, [Checkpoint(tmp_path / "checkpoints", every=20), lambda agent, turn: turn.step < 70])
    assert stopped.num_timesteps < 120
    resumed = awac.AWAC.resume(tmp_path / "checkpoints", reach())
    assert resumed.resumed.exact
    resumed.learn()
    for name, array in whole.get_parameters().items():
        np.testing.assert_array_equal(resumed.get_parameters()[name], array)

    loaded = rejeu.load(whole.save(tmp_path / "model"))
    assert type(loaded) is awac.AWAC
    assert loaded.config.beta == 2.0
    obs = Reach().reset(seed=1)[0]
    np.testing.assert_array_equal(loaded.predict(obs, deterministic=True)[0], whole.predict(obs, deterministic=True)[0])


def test_a_file_imports_nothing_and_the_error_says_what_to_import(awac, tmp_path):
    path = awac.AWAC("MlpPolicy", "Pendulum-v1", **SMALL).save(tmp_path / "model")
    del rejeu.AGENTS["AWAC"], sys.modules["awac"]
    with pytest.raises(CheckpointError, match=r"'AWAC', which is not registered; import awac \(--import awac\)"):
        rejeu.load(path)
    assert "awac" not in sys.modules


def test_plans_and_sweeps_import_no_installed_algorithm_that_they_name(site, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(site)
    plan = {"environments": "Pendulum-v1", "algorithms": ["awac"]}
    refused = r"not registered, and no file may name what is imported; import awac \(--import awac\)"
    with pytest.raises(PlanError, match=refused):
        read_plan(plan)
    job = Job(name="a", run=RunConfig(env="Pendulum-v1", algorithm="AWAC", seed=0))
    folder = open_folder(tmp_path / "sweep", Plan(jobs=(job,), threads=1), None, RunConfig(env=""))
    with pytest.raises(ValueError, match=refused):
        imports_of(folder, RunConfig(env=""))
    assert "awac" not in sys.modules
    importlib.import_module("awac")  # as --import does
    del rejeu.AGENTS["AWAC"]  # a package that offers an entry point need not register it too
    assert [job.run.algorithm for job in read_plan(plan)[0].jobs] == ["AWAC"]
    assert imports_of(folder, RunConfig(env="")) == ("awac",)
    del sys.modules["awac"]


def test_a_preset_is_registered_with_the_algorithm(awac):
    assert presets.find("Pendulum-v1", "AWAC").hyperparameters["beta"] == 2.0
    assert "beta: Temperature of the advantage weights." in awac.AWAC.__doc__
    assert presets.find("Pendulum-v1").algorithm != "AWAC"  # rejeu's own stays the first


def test_a_later_registration_replaces_the_earlier_one_but_not_rejeus_own(awac):
    class Other(rejeu.OffPolicyAgent):
        algorithm = awac.AWAC.algorithm

    assert rejeu.register(Other) is Other
    assert rejeu.AGENTS["AWAC"] is Other
    assert presets.find("Pendulum-v1", "AWAC") is None

    class Own(rejeu.OffPolicyAgent):
        algorithm = rejeu.SAC.algorithm

    with pytest.raises(ValueError, match="rejeu has an algorithm 'SAC'; choose another"):
        rejeu.register(Own)


@pytest.mark.parametrize("algorithm", [None, SimpleNamespace(Config=OffPolicyConfig, make=None)])
def test_an_agent_without_a_named_configuration_is_refused(algorithm):
    class Nameless(rejeu.OffPolicyAgent):
        pass

    if algorithm is not None:
        Nameless.algorithm = algorithm
    with pytest.raises(ValueError, match=r"Nameless needs a class attribute algorithm .* name: ClassVar"):
        rejeu.register(Nameless)


def test_other_processes_are_told_what_to_import(awac):
    assert modules_of("SAC", ()) == modules_of("sac", ()) == ()
    assert modules_of("AWAC", ()) == ("awac",)  # its entry point
    assert modules_of("AWAC", ["my_awac.py"]) == ("my_awac.py",)
    with pytest.raises(ValueError, match="no algorithm is called 'Own'"):
        modules_of("Own", ())
    rejeu.AGENTS["Own"] = awac.AWAC
    with pytest.raises(ValueError, match=r"Own is registered in this program only, .*--import my_algorithm\.py"):
        modules_of("Own", ())


def test_a_report_shows_what_differs_and_the_command_that_repeats_the_run(awac):
    saved = to_json(awac.Config(beta=3.0, gamma=0.9))
    run = RunSummary(
        path=Path("run"),
        name="run",
        config=RunConfig(env="Pendulum-v1", algorithm="AWAC", seed=1, imports=("my awac.py",), hyperparameters=saved),
    )
    assert run.changed == {"gamma": (0.9, 0.99), "beta": (3.0, 1.0)}
    words = "--import 'my awac.py' --algo AWAC --seed 1 --set gamma=0.9 beta=3.0"
    assert run.command == f"rejeu train Pendulum-v1 {words}"


def with_update(awac, change):
    """An agent whose updates return what ``change`` makes of the state and the metrics."""

    def make(*arguments):
        algorithm = awac.make(*arguments)
        return algorithm._replace(update=lambda *inputs: change(*algorithm.update(*inputs)))

    class Changed(rejeu.OffPolicyAgent):
        algorithm = SimpleNamespace(Config=awac.Config, make=make)

    return Changed


def test_prioritized_replay_without_td_errors_is_refused(awac):
    kind = with_update(awac, lambda state, metrics: (state, {"critic_loss": metrics["critic_loss"]}))
    with pytest.raises(ValueError, match=r"prioritized replay needs the absolute TD error .* it returned none"):
        kind("MlpPolicy", "Pendulum-v1", priorities={}, **SMALL).learn(40)
    kind = with_update(awac, lambda state, metrics: (state, metrics | {TD_ERROR: jnp.float32(1)}))
    with pytest.raises(ValueError, match=r"TD_ERROR of shape \(batch,\); it returned \(\)"):
        kind("MlpPolicy", "Pendulum-v1", priorities={}, **SMALL).learn(40)


def test_the_file_works_as_a_notebook_cell():
    pytest.importorskip("IPython")
    from IPython.core.interactiveshell import InteractiveShell

    shell = InteractiveShell()
    try:
        for _ in range(2):  # a cell is run again after a change
            shell.run_cell(SOURCE.read_text()).raise_error()
        agent = shell.user_ns["AWAC"]("MlpPolicy", "Pendulum-v1", **SMALL).learn(30)
        assert agent.n_updates == 10
    finally:
        InteractiveShell.clear_instance()


def command(site, folder, *arguments):
    """Runs the command in a process in which the package is installed."""
    program = f"import sys; sys.path.insert(0, {str(site)!r}); from rejeu.lab.cli import main; sys.exitmainsys.argv[1:]"
    return subprocess.run(
        [sys.executable, "-c", program, *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=300,
        check=False,
    )


def test_the_command_line_finds_an_installed_algorithm_by_its_name_only_where_it_is_typed(site, tmp_path):
    tiny = ["--evaluate-episodes", "1", "--no-report", "--no-video"]
    tiny += ["--set", "policy_kwargs.net_arch=[8]", "batch_size=8", "learning_starts=20"]
    done = command(site, tmp_path, "train", "Pendulum-v1", "--algo", "awac", "--steps", "60", "--out", "run", *tiny)
    assert done.returncode == 0, done.stderr
    assert "AWAC, preset, seed" in done.stdout
    config = json.loads((tmp_path / "run" / "config.json").read_text())
    assert (config["algorithm"], config["hyperparameters"]["beta"], config["n_envs"]) == ("AWAC", 2.0, 2)

    refused = command(site, tmp_path, "evaluate", "run", "--episodes", "1")
    assert refused.returncode == 2
    assert "--import awac" in refused.stderr
    done = command(site, tmp_path, "evaluate", "run", "--episodes", "1", "--import", "awac")
    assert done.returncode == 0, done.stderr
