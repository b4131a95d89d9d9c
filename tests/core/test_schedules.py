"""Schedules: their values, and the ways to write them."""

import dataclasses
import json
from types import SimpleNamespace
from typing import ClassVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

import rejeu
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.algorithms.rollout_config import RolloutConfig
from rejeu.callbacks import Checkpoint
from rejeu.core.algorithm import TD_ERROR, Algorithm
from rejeu.core.schedules import Exponential, Linear, at, parse, to_json
from rejeu.replay.prioritized import PriorityConfig
from rejeu.training.run import TrainingCall
from tests.environments import Counter
from tests.helpers import small_sac

pytestmark = pytest.mark.usefixtures("learners_are_shared")


@pytest.mark.parametrize(("progress", "value"), [(-0.5, 1.0), (0.0, 1.0), (0.25, 0.55), (0.5, 0.1), (1.5, 0.1)])
def test_linear_is_a_line_to_its_fraction_and_constant_after(progress, value):
    assert Linear(1.0, 0.1, fraction=0.5)(progress) == pytest.approx(value)
    assert at(Linear(1.0, 0.1, fraction=0.5), progress) == pytest.approx(value)
    assert at(0.3, progress) == 0.3


@pytest.mark.parametrize(("progress", "value"), [(0.0, 1.0), (0.25, 0.1), (0.5, 0.01), (1.0, 0.01)])
def test_exponential_falls_by_the_same_factor_for_the_same_stretch(progress, value):
    assert Exponential(1.0, 0.01, fraction=0.5)(progress) == pytest.approx(value)


@pytest.mark.parametrize("schedule", [Linear(3e-4, 1e-5, 0.7), Exponential(3e-4, 1e-5, 0.7)])
def test_traced_progress_gives_what_a_number_gives(schedule):
    progress = np.linspace(-0.1, 1.1, 13, dtype=np.float32)
    traced = jax.jit(jax.vmap(schedule))(progress)
    np.testing.assert_allclose(traced, [schedule(float(p)) for p in progress], rtol=1e-5)


@pytest.mark.parametrize(
    ("given", "meant"),
    [
        (3e-4, 3e-4),
        (1, 1.0),
        ("lin_3e-4", Linear(3e-4, 0.0)),
        (Exponential(1.0, 0.1), Exponential(1.0, 0.1)),
        ({"schedule": "linear", "start": 1, "end": 0, "fraction": 0.5}, Linear(1.0, 0.0, 0.5)),
        ({"schedule": "exponential", "start": 1, "end": 0.1}, Exponential(1.0, 0.1)),
    ],
)
def test_everything_that_may_be_written_is_read(given, meant):
    assert parse("learning_rate", given) == meant


@pytest.mark.parametrize("schedule", [Linear(1.0, 0.25, 0.5), Exponential(1.0, 0.1)])
def test_a_schedule_survives_json(schedule):
    assert parse("x", json.loads(json.dumps(to_json(schedule)))) == schedule


@pytest.mark.parametrize(
    ("given", "error", "words"),
    [
        (lambda progress_remaining: 3e-4, ValueError, "learning_rate: functions are called with the progress"),
        (lambda progress: float(progress), TypeError, "learning_rate: the function must use jax.numpy"),
        (lambda progress: jnp.ones(2) * progress, TypeError, "learning_rate: the function must return one number"),
        *((value, TypeError, "learning_rate=.* must be a number") for value in (True, None, "3e-4")),
        *((value, ValueError, "learning_rate") for value in ("lin_fast", "lin_inf", float("nan"), float("inf"))),
        ({"schedule": "cosine", "start": 1}, TypeError, "learning_rate="),
        ({"schedule": "linear", "stop": 1}, TypeError, "learning_rate="),
        ({"schedule": "linear", "start": "nan"}, ValueError, "learning_rate="),
    ],
)
def test_what_is_no_schedule_is_refused_by_name(given, error, words):
    with pytest.raises(error, match=words):
        parse("learning_rate", given)


@pytest.mark.parametrize("make", [lambda: Linear(1.0, 0.0, fraction=0.0), lambda: Linear(1.0, 0.0, fraction=1.5)])
def test_a_fraction_outside_the_run_is_refused(make):
    with pytest.raises(ValueError, match=r"fraction=.* must be a finite number, above 0 and at most 1"):
        make()


@pytest.mark.parametrize("ends", [(0.0, 1.0), (1.0, 0.0), (-1.0, 1.0)])
def test_an_exponential_needs_positive_ends(ends):
    with pytest.raises(ValueError, match="must be a finite number, above 0"):
        Exponential(*ends)


def progress_of_updates(agent, *calls):
    """Returns for each call of ``learn``, given by its arguments, the progress that every update was told."""
    update, told = agent.learner.update, []

    def updating(state, batches, clock):
        told[-1].append(float(clock.progress))
        return update(state, batches, clock)

    agent.learner.update = updating
    for arguments in calls:
        told.append([])
        agent.learn(**arguments)
    return told


def test_schedules_continue_over_learn_as_in_stable_baselines3():
    """Its ``_setup_learn`` adds the steps taken to the total: progress = num_timesteps / (steps at the start + total)."""
    more = {"total_timesteps": 60, "reset_num_timesteps": False}
    told = progress_of_updates(
        small_sac(Counter(), learning_starts=0), {"total_timesteps": 20}, more, more, {"total_timesteps": 10}, more
    )
    expected = [
        np.arange(1, 21) / 20,
        (20 + np.arange(1, 61)) / 80,
        (80 + np.arange(1, 61)) / 140,
        np.arange(1, 11) / 10,
        (10 + np.arange(1, 61)) / 70,
    ]
    for got, wanted in zip(told, expected, strict=True):
        np.testing.assert_allclose(got, wanted[-len(got) :], rtol=1e-6)
        assert len(got) >= len(wanted) - 1  # nothing can be drawn in the first turn


def test_schedules_follow_training_time_likewise(monkeypatch):
    monkeypatch.setattr("time.perf_counter", lambda: 100.0)
    call = TrainingCall(None, None, 60.0, 0, 0, 4, 0, None, seconds_before=20.0)
    assert call.progress(5, 1) == 20 / 80
    monkeypatch.setattr("time.perf_counter", lambda: 130.0)
    assert call.progress(5, 1) == 50 / 80
    monkeypatch.setattr("time.perf_counter", lambda: 160.0)
    assert call.progress(5, 1) == 1.0
    rejeu.core.xla.enable_cache()
    jax.monitoring.record_event_duration_secs("/jax/core/compile/backend_compile_duration", 40.0)
    assert call.progress(5, 1) == pytest.approx(40 / 80)  # compilation takes none of it
    agent = small_sac(Counter()).learn(8)
    spent = agent.seconds["total"]
    agent.learn(minutes=1, callback=lambda *_: False, reset_num_timesteps=False)
    assert agent.call.training_call.seconds_before == spent


def test_a_resumed_call_keeps_its_progress_and_its_schedules_continue_after_it(tmp_path):
    make = lambda: rejeu.make_vector("Pendulum-v1", 1, "gymnasium", seed=0)  # noqa: E731
    agent = small_sac(make(), learning_starts=0).learn(20)
    stop = lambda agent, turn: turn.step < 50  # noqa: E731
    agent.learn(60, [stop, Checkpoint(tmp_path, every=1000)], reset_num_timesteps=False)
    agent = rejeu.SAC.resume(tmp_path, make())
    more = {"total_timesteps": 20, "reset_num_timesteps": False}
    rest, after = progress_of_updates(agent, {}, more)
    np.testing.assert_allclose(rest, np.arange(51, 81) / 80, rtol=1e-6)
    np.testing.assert_allclose(after, np.arange(81, 101) / 100, rtol=1e-6)


def test_schedules_of_a_loaded_agent_continue_by_the_steps_and_episodes_of_its_file(tmp_path):
    agent = small_sac(Counter(lengths=(1,)), learning_starts=0).learn(10)
    agent.learn(20).save(tmp_path / "agent")
    agent = rejeu.SAC.load(tmp_path / "agent", Counter(lengths=(1,)))
    by_steps, by_episodes = progress_of_updates(
        agent, {"total_timesteps": 20, "reset_num_timesteps": False}, {"episodes": 10, "reset_num_timesteps": False}
    )
    np.testing.assert_allclose(by_steps[-1], 40 / 40)
    np.testing.assert_allclose(by_steps[0], (20 + 21 - len(by_steps)) / 40, rtol=1e-6)
    np.testing.assert_allclose(by_episodes, (40 + np.arange(1, 11)) / 50, rtol=1e-6)


def test_any_function_of_the_progress_is_a_schedule(tmp_path):
    def half_cosine(progress):
        return 1e-2 * jnp.cos(progress * jnp.pi / 2)

    settings = {"learning_starts": 0, "batch_size": 4, "buffer_size": 100, "seed": 0}
    agent = rejeu.DDPG("MlpPolicy", "Pendulum-v1", learning_rate=half_cosine, **settings).learn(20)
    path = agent.save(tmp_path / "model")
    with pytest.raises(
        rejeu.CheckpointError, match=r"model\.safetensors: its learning_rate is your own, 'half_cosine'"
    ):
        rejeu.load(path)
    assert rejeu.load(path, learning_rate=half_cosine).config == agent.config
    assert rejeu.load(path, learning_rate=1e-3).config.learning_rate == 1e-3


# Which progress the loops tell.

ROOM = 64


class Heard(eqx.Module):
    """A state that writes down the progress that updates were told, and that their actions had been told."""

    updates: jax.Array
    acted: jax.Array
    weighed: jax.Array
    """Whether the importance weights of a batch differ."""
    n: jax.Array


def listener(config, observation_space, action_space):
    """An algorithm whose actions are the progress that it is told when it acts, and which learns nothing but that."""

    def init(key):
        return Heard(jnp.full(ROOM, -1.0), jnp.full(ROOM, -1.0), jnp.full(ROOM, -1.0), jnp.int32(0))

    def act(actor, obs, key=None, clock=None):
        n = jax.tree.leaves(obs)[0].shape[0]
        return jnp.full((n, 1), 0.0 if clock is None else clock.progress, jnp.float32)

    def update(state, batch, clock):
        weight = getattr(batch, "weight", None)
        differ = jnp.float32(0.0 if weight is None else weight.min() < 1)
        state = Heard(
            state.updates.at[state.n].set(clock.progress),
            state.acted.at[state.n].set(batch.action.reshape(-1)[-1]),
            state.weighed.at[state.n].set(differ),
            state.n + 1,
        )
        metrics = {"progress": jnp.float32(clock.progress)}
        return state, metrics | ({TD_ERROR: jnp.abs(batch.reward) + 0.01} if hasattr(batch, "weight") else {})

    return Algorithm(init, lambda state: state.n, act, act, update)


def listening(kind, on_device, **settings):
    """An agent of that algorithm in an environment on the device, which trains there or on the host."""
    base = {"off": OffPolicyConfig, "on": RolloutConfig}[kind]
    agent_of = {"off": rejeu.OffPolicyAgent, "on": rejeu.OnPolicyAgent}[kind]
    fields = {"__annotations__": {"name": ClassVar[str]}, "name": "Listener", "__module__": __name__}
    config = dataclasses.dataclass(frozen=True, kw_only=True)(type("Config", (base,), fields))
    cls = type("Listener", (agent_of,), {"algorithm": SimpleNamespace(Config=config, make=listener)})
    agent = cls("MlpPolicy", rejeu.make_vector("jax/Pendulum-v1", 1), seed=0, **settings)
    agent.on_device = on_device
    return agent


CALLS = [(8, True, 0, 8), (12, False, 8, 20), (8, True, 0, 8), (4, False, 8, 12)]
"""Steps to take, whether counters are reset, and by the rule of Stable-Baselines3 the steps before and in total."""


@pytest.mark.parametrize("on_device", [False, True], ids=["host", "device"])
def test_off_policy_loops_tell_actions_updates_and_weights_how_far_the_run_is(on_device):
    """In the first ``learn`` and in later ones, with counters reset or not. Beta is 0 in the first half of a run."""
    half = PriorityConfig(beta=lambda progress: jnp.where(jnp.asarray(progress) > 0.5, 1.0, 0.0))
    settings = {"learning_starts": 0, "batch_size": 16, "buffer_size": 100, "priorities": half}
    agent = listening("off", on_device, **settings)
    updates, acted = [], []
    for n_steps, reset, before, total in CALLS:
        agent.learn(n_steps, reset_num_timesteps=reset)
        taken = before + np.arange(n_steps)
        acted += [*(taken / total)]
        updates += [*((taken + 1) / total)]
    assert agent.call.stops is not None if on_device else agent.call.stops is None
    heard = agent.state
    n = int(heard.n)
    n_missing = len(updates) - n  # nothing can be drawn in the first turn
    assert n_missing <= 1
    np.testing.assert_allclose(heard.updates[:n], updates[n_missing:], rtol=1e-6)
    actions = agent.replay_buffer.arrays()["action"].ravel()[: len(acted)]
    first = np.cumsum([0, *(call[0] for call in CALLS[:-1])])  # chosen at the end of the call before
    later = np.setdiff1d(np.arange(len(acted)), first[1:])
    np.testing.assert_allclose(actions[later], np.array(acted)[later], rtol=1e-6)
    expected = np.array(updates[n_missing:]) > 0.5
    assert not np.array(heard.weighed[:n])[~expected].any()
    assert np.array(heard.weighed[:n])[expected][3:].all()


@pytest.mark.parametrize("on_device", [False, True], ids=["host", "device"])
def test_on_policy_loops_tell_actions_and_updates_how_far_the_run_is(on_device):
    agent = listening("on", on_device, n_steps=4)
    updates, acted = [], []
    for n_steps, reset, before, total in CALLS:
        agent.learn(n_steps, reset_num_timesteps=reset)
        ends = before + np.arange(4, n_steps + 1, 4)
        updates += [*(ends / total)]
        acted += [*((ends - 1) / total)]
    assert agent.call.stops is not None if on_device else agent.call.stops is None
    n = int(agent.state.n)
    np.testing.assert_allclose(agent.state.updates[:n], updates, rtol=1e-6)
    np.testing.assert_allclose(agent.state.acted[:n], acted, rtol=1e-6)
