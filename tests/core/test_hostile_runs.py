"""Checkpoints whose checksums are right and whose values are not: nothing is resumed that could not go on."""

import copy
import os
import shutil
import warnings
from unittest import mock

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.callbacks import Checkpoint
from rejeu.checkpoints.resume import like, restore_buffer
from rejeu.checkpoints.run_folder import checkpoint_files
from rejeu.core import checkpoint
from rejeu.core.errors import CheckpointError
from tests import hostile_files
from tests.agents.test_resume import BALL, OFF, SMALL, vector
from tests.sharing import shared_learners
from tests.tiers import only

CASES = {
    "replay": ("DQN", "CartPole-v1", {**OFF, "priorities": {}}),
    "rollout": ("PPO", "CartPole-v1", {**SMALL, "n_steps": 16, "batch_size": 16}),
    "episodes": ("A2C", "CartPole-v1", {**SMALL, "n_episodes": 1}),
}


def make_run(case, folder):
    """A kind of agent, a folder with one checkpoint of it in the course of an episode, and what was compiled for it."""
    name, env_id, settings = CASES[case]
    agent = rejeu.AGENTS[name]("MlpPolicy", vector(env_id, 2)(), **settings)
    agent.made_from_id = True  # its environments were made from an id
    keep = lambda agent, turn: agent.remember_best((0.5, 1.0)) if turn.step == 6 else None  # noqa: E731
    agent.learn(60, [keep, Checkpoint(folder, every=1000, keep=1), lambda agent, turn: turn.step < 24])
    return rejeu.AGENTS[name], folder, agent.learner


@pytest.fixture(scope="module")
def run(request, tmp_path_factory):
    return make_run(request.param, tmp_path_factory.mktemp("run"))


def resumed(run, tmp_path, change, **hyperparameters):
    """Resumes the run with ``change(header, values of the run, arrays)`` made to its newest file; checksums are right."""
    kind, whole, compiled = run
    folder = shutil.copytree(whole, tmp_path / "run")
    path = checkpoint_files(folder)[0]
    header, arrays = checkpoint.read(path, "run")
    change(header, header["run"]["dict"], arrays)
    checkpoint.write(path, "run", arrays, {k: v for k, v in header.items() if k not in checkpoint.RESERVED})
    with mock.patch.object(rejeu.agents.agent, "Learner", return_value=copy.copy(compiled)):
        return kind.resume(folder, **hyperparameters)


def put(name, value, place=...):
    def change(header, values, arrays):
        assert name in arrays, sorted(arrays)
        arrays[name] = np.copy(arrays[name])
        arrays[name][place] = value

    return change


def resize(name, shape):
    def change(header, values, arrays):
        arrays[name] = np.resize(arrays[name], shape)

    return change


def set_to(value, *keys):
    """Sets a value in the header, ``keys`` leading there; those of dicts within the run lead through their ``dict``."""

    def change(header, values, arrays):
        *way, last = keys
        for key in way:
            header = (
                header[key]["dict"] if isinstance(header[key], dict) and [*header[key]] == ["dict"] else header[key]
            )
        assert last in header if isinstance(header, dict) else len(header) > last
        header[last] = value

    return change


ANYWHERE = {
    "an episode without a step": (  # of which nothing could be listed or drawn
        lambda header, values, arrays: arrays.update({"run.history": np.full((1, 6), np.nan)}),
        "column 'step' of a history must be finite",
    ),
    "an unknown environment": (set_to("Nowhere-v0", "env_id"), "cannot be made again .*Nowhere"),
    "an environment of other spaces": (set_to("MountainCar-v0", "env_id"), "MountainCar-v0 as it is here has"),
    "steps that were never taken": (set_to(10**9, "run", "steps_since_update"), "at most 24"),
    "the state of a pole without a number": (put("run.envs.1.2.state", np.inf, 0), "state of CartPoleEnv cannot be"),
    "an environment that is over": (set_to(False, "run", "envs", 0, 1, "_has_reset"), "environment 0 is over"),
    "an environment without a state": (set_to(None, "run", "envs", 1, 2, "state"), "environment 1 is over"),
    "a time of an episode that is many": (
        lambda header, values, arrays: values["envs"][0][0]["dict"].update(_elapsed_steps={"array": "run.ended"}),
        "TimeLimit cannot be",
    ),
    "a best step that is text": (set_to("high", "run", "best", "step"), "step='high'"),
    "fewer episodes than environments": (resize("run.ended", 0), "ended is not of 2 environments"),
    "draws in a table": (resize("run.buffer.priorities.drawn.0.0", (4, 2)), "priorities are of another"),
    "priorities beyond all numbers together": (put("run.buffer.priorities.values", 1e308), "priorities are not finite"),
    "a largest priority of zero": (set_to(0.0, "run", "buffer", "priorities", "largest"), "not positive"),
}


@pytest.mark.parametrize("case", ANYWHERE.values(), ids=ANYWHERE)
@pytest.mark.parametrize("run", ["replay"], indirect=True)
def test_a_run_that_could_not_go_on_is_refused(run, case, tmp_path):
    change, message = case
    with pytest.raises(CheckpointError, match=message):
        resumed(run, tmp_path, change)


@pytest.mark.parametrize("run", only(["replay", "rollout"], CASES), indirect=True)
def test_the_same_run_goes_on_where_nothing_is_changed(run, tmp_path):
    """Else all would be refused for what is wrong with every one of them."""
    agent = resumed(run, tmp_path, lambda header, values, arrays: None)
    assert agent.resumed.exact
    assert agent.learn(8, reset_num_timesteps=False).run.step == agent.resumed.step + 8


@pytest.mark.parametrize("run", ["rollout"], indirect=True)
def test_a_rollout_that_is_full_is_refused(run, tmp_path):
    def fill(header, values, arrays):
        for name in [name for name in arrays if name.startswith("run.buffer.rollout.")]:
            arrays[name] = np.concatenate([arrays[name]] * 2)[:16]

    with pytest.raises(CheckpointError, match="the rollout has 16 steps"):
        resumed(run, tmp_path, fill)


def files_of(folder):
    """The files of a run with one checkpoint: the run itself, and its newest rows if it has any."""
    return [checkpoint_files(folder)[0], *sorted(folder.glob("rows_*"))[-1:]]


def replaced(run, folder, path, content, size=None):
    """What becomes of a run one of whose files is replaced; ``size`` is more than the content has where a hole follows."""
    shutil.copytree(run[1], folder, dirs_exist_ok=True)
    (folder / path.name).write_bytes(content)
    if size is not None:
        os.truncate(folder / path.name, size)
    return hostile_files.outcome_of(trained_further, run, folder)


def trained_further(run, folder):
    """Resumes the run in a folder and trains it for some steps."""
    kind, _, compiled = run
    shared = mock.patch.object(rejeu.agents.agent, "Learner", return_value=copy.copy(compiled))
    with shared, warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)  # that it is not exact
        agent = kind.resume(folder)
        try:
            agent.learn(8, reset_num_timesteps=False)
        finally:
            agent.env.close()


@pytest.mark.parametrize("run", only(["replay"], ["replay", "rollout"]), indirect=True)
def test_a_hostile_file_of_a_run_is_refused_by_our_own_error_alone(run, tmp_path):
    """A sample of the corpus; ``trials/hostile.py`` tries all of it."""
    outcomes = []
    for path in files_of(run[1]):
        content = path.read_bytes()
        variants = [*hostile_files.variants(content), *hostile_files.bad_runs(content)]
        outcomes += [replaced(run, tmp_path / "run", path, variant.content) for variant in variants[::60]]
    assert {*outcomes} <= {"refused", "read"}
    assert outcomes.count("refused") > 0.8 * len(outcomes)  # some values may be others, or missing


@pytest.mark.skipif(os.name != "posix", reason="holes in files are POSIX's")
@pytest.mark.parametrize("run", ["replay", "rollout"], indirect=True)
def test_no_array_is_read_that_the_run_does_not_have(run, tmp_path, monkeypatch):
    """Six GiB in a hole of a few KiB are refused at once, by names and shapes."""
    sizes, read = [], checkpoint.Contents.read

    def watched(file, prefix=""):
        sizes.extend(spec.nbytes for name, spec in file.specs.items() if name.startswith(prefix))
        return read(file, prefix)

    monkeypatch.setattr(checkpoint.Contents, "read", watched)
    monkeypatch.setattr(checkpoint, "physical_memory", lambda: 2**40)
    for path in files_of(run[1]):
        for one in hostile_files.sparse(path.read_bytes()):
            if one.name.startswith("run."):  # of any size, as far as there is memory
                continue
            assert replaced(run, tmp_path / "run", path, one.content, one.size) == "refused", one.name
    assert max(sizes) < 2**20


def test_environments_that_were_made_for_a_refused_run_are_closed(tmp_path):
    n_open = [0]

    class Counted(gym.Wrapper):
        def __init__(self):
            super().__init__(gym.make(BALL))
            n_open[0] += 1

        def close(self):
            n_open[0] -= 1
            super().close()

    gym.register("tests/Counted-v0", lambda: Counted())  # Gymnasium 1.3.0 takes no class of wrappers
    try:
        with shared_learners():
            agent = rejeu.SAC("MlpPolicy", rejeu.make_vector("tests/Counted-v0", 2, "gymnasium"), **OFF)
            agent.made_from_id = True
            agent.learn(10, Checkpoint(tmp_path, keep=1))
            agent.env.close()
            path = checkpoint_files(tmp_path)[0]
            header, arrays = checkpoint.read(path, "run")
            header["run"]["dict"]["logger"] = None
            checkpoint.write(path, "run", arrays, {k: v for k, v in header.items() if k not in checkpoint.RESERVED})
            with pytest.raises(CheckpointError):
                rejeu.SAC.resume(tmp_path)
    finally:
        del gym.registry["tests/Counted-v0"]
    assert n_open == [0]


def test_a_rollout_under_way_needs_what_was_remembered_at_its_beginning():
    agent = rejeu.RecurrentPPO("MlpPolicy", BALL, n_steps=4, batch_size=4, **SMALL)
    run, carry = agent.run, agent.learner.initial_carry(1)
    saved = {"rollout": run.replay.arrays(), "started": np.zeros(1, bool), "carry": []}
    with pytest.raises(ValueError, match=r"shorter|longer"):
        restore_buffer(run, saved, [], carry, begun=True)
    restore_buffer(run, saved, [], carry, begun=False)
    assert run.replay.carry == ()


def test_what_exploration_remembers_must_be_finite():
    with pytest.raises(ValueError, match="carry is not finite"):
        like([np.zeros(2, np.float32)], [np.array([0.0, np.nan], np.float32)], "carry")
