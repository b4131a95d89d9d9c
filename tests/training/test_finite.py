"""Training stops, or goes on without it, where an update would leave NaN or infinity; and says what, where and why."""

import itertools

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings, strategies as st

import rejeu
from rejeu.algorithms import sac
from rejeu.callbacks import Checkpoint
from rejeu.core.algorithm import EXPLAINED_VARIANCE, TD_ERROR, Rollout
from rejeu.core.checkpoint import read
from rejeu.core.errors import BadEnvironmentError, NonFiniteError
from rejeu.core.normalization import merged, no_moments
from rejeu.core.spaces import Leaf
from rejeu.envs.make import InProcess
from rejeu.lab import cli
from rejeu.replay.prioritized import Priorities, PriorityConfig
from rejeu.replay.ring import Ring
from rejeu.replay.rollout import RolloutBuffer
from rejeu.training import learner
from rejeu.training.learner import Readings
from tests.environments import Counter, Reach, Sampled
from tests.tiers import exhaustive, only, only_tuples

pytestmark = pytest.mark.usefixtures("learners_are_shared")

NETS = {"policy_kwargs": {"net_arch": [8]}, "seed": 0}
OFF = {"learning_starts": 8, "batch_size": 4, "buffer_size": 300, **NETS}
ON = {"n_steps": 8, **NETS}
TOTAL = 40


def box(n_envs=1, actions=None):
    return InProcess([Sampled(gym.spaces.Box(-1.0, 1.0, (3,)), actions) for _ in range(n_envs)], seed=0)


def choice():
    return box(actions=gym.spaces.Discrete(3))


class Rules(Sampled):
    """Forbids the last of three actions."""

    def __init__(self):
        super().__init__(gym.spaces.Box(-1.0, 1.0, (3,)), gym.spaces.Discrete(3))

    def action_masks(self):
        return np.array([True, True, False])


def her():
    return InProcess([Reach()], seed=0)


MAKE = {
    "SAC": lambda **s: rejeu.SAC("MlpPolicy", box(), **OFF, **s),
    "SAC, four steps in a scan": lambda **s: rejeu.SAC("MlpPolicy", box(), gradient_steps=4, **OFF, **s),
    "SAC, three environments": lambda **s: rejeu.SAC("MlpPolicy", box(3), **OFF, **s),
    "SAC with hindsight": lambda **s: rejeu.SAC(
        "MultiInputPolicy", her(), replay_buffer_class="HerReplayBuffer", **OFF, **s
    ),
    "SAC, normalised": lambda **s: rejeu.SAC("MlpPolicy", box(), normalize=True, **OFF, **s),
    "DQN with priorities": lambda **s: rejeu.DQN("MlpPolicy", choice(), priorities={}, train_freq=1, **OFF, **s),
    "TD3": lambda **s: rejeu.TD3("MlpPolicy", box(), **OFF, **s),
    "CrossQ": lambda **s: rejeu.CrossQ("MlpPolicy", box(), **OFF, **s),
    "PPO": lambda **s: rejeu.PPO("MlpPolicy", box(2), batch_size=8, n_epochs=2, **ON, **s),
    "PPO, normalised": lambda **s: rejeu.PPO("MlpPolicy", box(), batch_size=8, normalize=True, **ON, **s),
    "A2C": lambda **s: rejeu.A2C("MlpPolicy", choice(), **ON, **s),
    "PQN": lambda **s: rejeu.PQN("MlpPolicy", choice(), batch_size=8, **ON, **s),
    "MaskablePPO": lambda **s: rejeu.MaskablePPO("MlpPolicy", InProcess([Rules()], seed=0), batch_size=8, **ON, **s),
    "RecurrentPPO": lambda **s: rejeu.RecurrentPPO(
        "MlpPolicy",
        box(2),
        batch_size=8,
        n_steps=8,
        seed=0,
        policy_kwargs={"lstm_hidden_size": 4, "net_arch": [4]},
        **s,
    ),
}
SCANS = ("SAC, four steps in a scan", "SAC, three environments")
ON_POLICY = ("PPO", "PPO, normalised", "A2C", "PQN", "MaskablePPO", "RecurrentPPO")


def replace_update(agent, which, instead):
    """Lets the ``which``-th call of the update, counted from 0, be ``instead(state, batches, clock)``."""
    update, numbers = agent.learner.update, itertools.count()
    agent.learner.update = lambda *arguments: (instead if next(numbers) == which else update)(*arguments)


def poison(agent, which, value):
    """Puts ``value`` into a reward of the ``which``-th sample or rollout, so that what is saved is what was learnt from."""
    buffer, calls = agent.run.replay, []
    name = "rollout" if isinstance(buffer, RolloutBuffer) else "draw"
    method = getattr(buffer, name)

    def poisoned(*arguments):
        answer = method(*arguments)
        data, *drawn = answer if name == "draw" else (answer,)
        calls.append(data)
        if len(calls) != which + 1:
            return answer
        rewards = np.array(data.reward)
        if rewards.ndim == 1:
            rewards[0] = value
        else:
            rewards[1, 0] = value  # of a scan its second batch, of a rollout its second step
        data = data._replace(reward=rewards)
        return (data, *drawn) if drawn else data

    setattr(buffer, name, poisoned)


def assert_same(one, two):
    assert list(one) == list(two)
    for name, value in one.items():
        np.testing.assert_array_equal(value, two[name], err_msg=name)


@pytest.mark.parametrize("name", only(["SAC, four steps in a scan", "DQN with priorities", "PPO"], MAKE))
def test_an_update_that_breaks_something_ends_training_and_its_turn_is_named_and_saved(name, tmp_path):
    is_on_policy = name in ON_POLICY
    agent = MAKE[name]()
    agent.report_folder = tmp_path
    agent.learn(8 * agent.n_envs if is_on_policy else 12)
    good = agent.get_parameters()
    poison(agent, 0 if is_on_policy else 4, np.nan)
    with pytest.raises(NonFiniteError) as caught:
        agent.learn(TOTAL, reset_num_timesteps=False)
    error, n_envs = caught.value, agent.n_envs
    expected = 16 * n_envs if is_on_policy else 12 + 5 * n_envs
    assert error.step == expected
    steps = f"step {error.step}" if n_envs == 1 else f"steps {error.step - n_envs + 1} to {error.step}"
    assert f"the batch held reward (nan), in the update after environment {steps}. " in str(error)
    header, arrays = read(error.batch, "batch")
    assert error.batch.parent == tmp_path
    assert header["names"] == list(error.names) != []
    assert np.isnan(arrays["batches.0.reward"]).sum() == 1
    assert {name for name in arrays if name.startswith("state.")} == {f"state.{name}" for name in good}
    agent.set_parameters(good)
    agent.learn(2 * n_envs, reset_num_timesteps=False)
    assert all(np.isfinite(value).all() for value in agent.get_parameters().values())


def test_an_agent_with_a_state_that_is_not_finite_is_neither_saved_nor_trained(tmp_path):
    agent = MAKE["SAC"]()
    agent.report_folder = tmp_path
    agent.learn(20)
    agent.remember_best(1.0)
    poison(agent, 1, np.nan)
    with pytest.raises(NonFiniteError) as caught:
        agent.learn(TOTAL)
    for use in (lambda: agent.save(tmp_path / "model"), lambda: Checkpoint(tmp_path / "run").save(agent)):
        with pytest.raises(NonFiniteError) as again:
            use()
        assert again.value is caught.value
    with pytest.raises(NonFiniteError, match=r"of the agent's state and .* before learning begins"):
        agent.learn(20)
    agent.restore_best().learn(20)
    assert agent.save(tmp_path / "model").exists()


def broken_at(leaf, trigger=100.0):
    """SAC's ``make`` whose update puts NaN into a leaf of the state, and nowhere else, where a reward is ``trigger``."""
    make = sac.make

    def changed(*arguments):
        algorithm = make(*arguments)

        def update(state, batch, clock):
            after, metrics = algorithm.update(state, batch, clock)
            factor = jnp.where(jnp.max(batch.reward) >= trigger, jnp.nan, 1.0)
            return eqx.tree_at(leaf, after, leaf(after) * factor), metrics

        return algorithm._replace(update=update)

    return changed


LEAVES = {
    "critics.torso.layers.0.weight": lambda s: s.critics.torso.layers[0].weight,
    "actor.head.bias": lambda s: s.actor.head.bias,
    "log_alpha": lambda s: s.log_alpha,
    "critics_optimizer.nu.head.weight": lambda s: s.critics_optimizer.nu.head.weight,
}


def test_a_bad_weight_between_wide_layers_is_found(monkeypatch, tmp_path):
    """Arrays of more than 8,192 numbers are checked where the state is used."""
    monkeypatch.setattr(sac, "make", broken_at(lambda s: s.critics.torso.layers[1].weight))
    agent = rejeu.SAC("MlpPolicy", box(), **{**OFF, "policy_kwargs": {"net_arch": [100, 100]}})
    agent.report_folder = tmp_path
    poison(agent, 3, 100.0)
    with pytest.raises(NonFiniteError) as caught:
        agent.learn(12)
    assert caught.value.names == ("critics.torso.layers.1.weight",)
    assert caught.value.step == 12
    assert float(read(caught.value.batch, "batch")[1]["batches.0.reward"][0]) == 100.0


@pytest.mark.parametrize(
    ("name", "size"),
    only_tuples(
        [("critics_optimizer.nu.head.weight", 1)],
        [(name, size) for name in LEAVES for size in (1, 3)],
    ),
)
def test_a_gradient_that_breaks_a_weight_is_named_though_all_losses_are_finite(name, size, monkeypatch, tmp_path):
    monkeypatch.setattr(sac, "make", broken_at(LEAVES[name]))
    agent = rejeu.SAC("MlpPolicy", box(), gradient_steps=size, **OFF)
    agent.report_folder = tmp_path
    poison(agent, 4, 100.0)
    with pytest.raises(NonFiniteError) as caught:
        agent.learn(13)
    assert name in caught.value.names
    if size == 1:  # in a scan the next step spreads it
        assert str(caught.value).startswith(f"{name} (nan) of the state became NaN")
    assert "became NaN or infinite, in the update after environment step 13. " in str(caught.value)


def test_the_message_names_step_batch_model_and_what_to_try(tmp_path):
    agent = MAKE["SAC"]()
    agent.learn(20)
    model = agent.save(tmp_path / "model")
    agent.run.replay.ring.records["reward"][:] = 1e30
    with pytest.raises(NonFiniteError) as caught:
        agent.learn(5, reset_num_timesteps=False)
    message = str(caught.value)
    assert caught.value.batch == tmp_path / "nonfinite_batch_21.safetensors"  # beside the newest model
    assert "critic_loss (inf)" in message
    assert "in the update after environment step 21. " in message
    assert str(caught.value.batch) in message
    assert f"last saved model: {model}" in message
    assert "largest of this batch is 1e+30" in message
    assert "lower learning_rate (it is 0.0003)" in message
    assert "normalize=True" in message
    assert "\n" not in message
    assert 'nonfinite="skip"' in message


@exhaustive
def test_next_actions_that_were_not_taken_are_not_blamed(tmp_path):
    agent = rejeu.ReBRAC("MlpPolicy", box(), **OFF)
    agent.report_folder = tmp_path
    poison(agent, 3, 1e25)
    with pytest.raises(NonFiniteError, match=r"^critic_loss \(inf\)") as caught:
        agent.learn(TOTAL)
    assert np.isnan(read(caught.value.batch, "batch")[1]["batches.0.next_action"]).any()


def test_a_batch_never_replaces_another_and_goes_where_logs_or_the_process_are(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    paths = []
    for folder in (None, None, "logs"):
        agent = rejeu.SAC("MlpPolicy", box(), tensorboard_log=None if folder is None else tmp_path / folder, **OFF)
        agent.logger.outputs = [_Nothing()]  # no TensorBoard is needed
        poison(agent, 1, np.nan)
        with pytest.raises(NonFiniteError) as caught:
            agent.learn(TOTAL)
        paths.append(caught.value.batch.relative_to(tmp_path).as_posix())
    assert paths == [
        "nonfinite_batch_10.safetensors",
        "nonfinite_batch_10_2.safetensors",
        "logs/nonfinite_batch_10.safetensors",
    ]


class _Nothing:
    def write(self, step, row):
        pass


USES = {
    "save": lambda agent: agent.save("model"),
    "predict": lambda agent: agent.predict(np.zeros(3)),
    "remember_best": lambda agent: agent.remember_best(1.0),
    "state": lambda agent: agent.state,
    "the end of learn": None,
}


@pytest.mark.parametrize("use", USES)
def test_using_the_agent_right_after_a_bad_update_raises(use, tmp_path, monkeypatch):
    """And what happened is told where the batches cannot be saved."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    agent = MAKE["SAC"]()
    agent.report_folder = tmp_path / "file" / "folder"
    poison(agent, 1, np.nan)

    def look(agent, progress):
        if progress.step == 10 and USES[use] is not None:
            USES[use](agent)

    with pytest.raises(NonFiniteError, match=r"the batch held reward .* The batches could not be saved") as caught:
        agent.learn(10 if USES[use] is None else TOTAL, look)
    assert caught.value.batch is None
    assert caught.value.step == 10
    assert agent.run.step == 10
    assert not (tmp_path / "model.safetensors").exists()
    assert agent.best is None


def test_parameters_that_are_not_finite_are_named_before_learning_begins():
    agent = MAKE["SAC"]()
    bad = agent.get_parameters()
    bad["critics.head.bias"][0] = np.nan
    agent.set_parameters(bad)
    with pytest.raises(
        NonFiniteError, match=r"^critics\.head\.bias \(nan\) of the agent's state is not finite"
    ) as caught:
        agent.learn(20)
    assert caught.value.names == ("critics.head.bias",)
    assert agent.num_timesteps == 0


# Skipping


@pytest.mark.parametrize("name", only(["DQN with priorities", "PPO"], [name for name in MAKE if name not in SCANS]))
def test_skipping_an_update_is_as_if_its_batch_had_never_been_given(name):
    which = 1 if name in ON_POLICY else 5
    agent, twin = MAKE[name](nonfinite="skip"), MAKE[name](nonfinite="skip")
    poison(agent, which, np.nan)

    def nothing_learnt(state, batches, clock):
        weighted = not isinstance(batches, Rollout) and batches.weight is not None
        metrics = {"gradient_steps": 0.0}
        readings = Readings(tuple(metrics), np.array([*metrics.values(), 0.0], np.float32))
        return state, readings, np.full(batches.reward.shape, np.nan, np.float32) if weighted else None

    replace_update(twin, which, nothing_learnt)
    agent.learn(TOTAL)
    twin.learn(TOTAL)
    assert_same(agent.get_parameters(), twin.get_parameters())
    assert agent.statistics()["train/skipped_updates"] == 1
    assert twin.statistics()["train/skipped_updates"] == 0
    if name == "DQN with priorities":
        one, two = (a.run.replay.priorities for a in (agent, twin))
        np.testing.assert_array_equal(one.tree.nodes, two.tree.nodes)
        assert one.largest == two.largest
        assert np.isfinite(one.tree.nodes).all()


def test_of_a_scan_only_the_broken_step_is_skipped():
    make = lambda: rejeu.SAC("MlpPolicy", box(), gradient_steps=4, nonfinite="skip", **OFF)  # noqa: E731
    agent, twin = make(), make()
    poison(agent, 2, np.nan)  # in the second of four batches
    update = twin.learner.update

    def three_of_four(state, batches, clock):
        for i in (0, 2, 3):
            state, readings, td_error = update(state, jax.tree.map(lambda leaf, i=i: leaf[i], batches), clock)
        return state, readings, td_error

    replace_update(twin, 2, three_of_four)
    last = lambda _, progress: progress.step < 11  # noqa: E731
    agent.learn(TOTAL, last)
    twin.learn(TOTAL, last)
    assert agent.statistics()["train/skipped_updates"] == 1
    assert all(np.isfinite(value) for name, value in agent.statistics().items() if name.startswith("train/"))
    one, two = agent.get_parameters(), twin.get_parameters()
    assert one["n_updates"] == two["n_updates"] == 11
    for name, value in one.items():
        np.testing.assert_allclose(value, two[name], rtol=1e-5, atol=1e-7, err_msg=name)  # two programs, two roundings


def spoil(agent, field):
    """Makes a field of every batch that is drawn NaN."""
    draw = agent.run.replay.draw

    def spoiled(*arguments):
        batch, drawn = draw(*arguments)
        return batch._replace(**{field: getattr(batch, field) * np.float32(np.nan)}), drawn

    agent.run.replay.draw = spoiled


def test_updates_that_are_all_skipped_are_an_error_in_the_end(tmp_path):
    agent = MAKE["SAC"](nonfinite="skip")
    agent.report_folder = tmp_path
    agent.learn(20)
    spoil(agent, "reward")
    with pytest.raises(NonFiniteError, match=r"^100 updates in a row were skipped, .* the batch held reward") as caught:
        agent.learn(200)
    assert caught.value.batch.exists()
    assert agent.statistics()["train/skipped_updates"] == 100


def test_nonfinite_is_saved_with_the_model_and_checked(tmp_path):
    path = MAKE["PPO"](nonfinite="skip").save(tmp_path / "model")
    assert rejeu.PPO.load(path).config.nonfinite == "skip"
    assert rejeu.PPO.load(path, nonfinite="stop").config.nonfinite == "stop"
    with pytest.raises(ValueError, match="nonfinite='ignore' must be one of stop, skip"):
        MAKE["SAC"](nonfinite="ignore")


# What environments say


class Saying(Counter):
    """Returns a bad number in the observation of one step (of reset: 0) of one episode."""

    def __init__(self, value=np.nan, at=(1, 2)):
        super().__init__(lengths=(3,))
        self.value, self.at = value, at

    def _observe(self):
        obs = super()._observe()
        if (self.episode, self.time) == self.at:
            obs[2] = self.value
        return obs


@pytest.mark.parametrize(("at", "steps"), [((0, 0), 0), ((1, 0), 6)])
@pytest.mark.parametrize("make", only([rejeu.PPO], [rejeu.SAC, rejeu.PPO]))
def test_so_does_one_that_reset_returns(make, at, steps):
    agent = make("MlpPolicy", InProcess([Saying(at=at), Saying(at=(9, 9))], seed=0), seed=0)
    with pytest.raises(
        BadEnvironmentError, match=rf"reset returned an observation .* environment 0 after {steps} steps"
    ):
        agent.learn(40)


class Echo(Sampled):
    """Its observation is the action."""

    def step(self, action):
        _, *rest = super().step(action)
        return np.full(3, action[0], np.float32), *rest


def test_an_environment_is_not_blamed_for_an_action_that_was_not_finite():
    agent = rejeu.SAC("MlpPolicy", InProcess([Echo(gym.spaces.Box(-1.0, 1.0, (3,)))], seed=0), **OFF).learn(12)
    agent.run.action = np.full((1, 1), np.nan, np.float32)
    with pytest.raises(NonFiniteError, match=r"the policy chose the action \[nan\] in environment 0 after 12 steps"):
        agent.learn(3, reset_num_timesteps=False)


@pytest.mark.parametrize("overlap", only([False], [True, False]))
def test_no_action_is_taken_that_a_bad_update_led_to(overlap, tmp_path):
    """The first update makes all actions NaN, and with them all observations."""
    env, taken = Echo(gym.spaces.Box(-1.0, 1.0, (3,))), []
    step = env.step
    env.step = lambda action: (taken.append(action), step(action))[1]
    agent = rejeu.SAC("MlpPolicy", InProcess([env], seed=0), learning_rate=1e30, overlap=overlap, **OFF)
    agent.report_folder = tmp_path
    with pytest.raises(NonFiniteError, match=r"\(nan\) of the state .* after environment step 9\."):
        agent.learn(TOTAL)
    assert np.isfinite(taken).all()


# The parts


@settings(max_examples=40)
@given(
    st.lists(st.sampled_from([1, 700]), min_size=1, max_size=2),  # every combination of sizes is compiled
    st.integers(0, 699),
    st.sampled_from([np.nan, np.inf, -np.inf, 0.0, 3e38, -3e38, 1e-45]),
)
def test_all_finite_is_numpys_answer(sizes, place, value):
    vectors = [np.full(n, -1.5, np.float32) for n in sizes]
    vectors[-1][place % sizes[-1]] = value
    expected = all(np.isfinite(vector).all() for vector in vectors)
    assert bool(learner.check([*map(jnp.asarray, vectors), jnp.arange(3)], {})) == expected
    assert bool(learner.check([jnp.arange(3)], {}))


def test_metrics_must_be_finite_but_for_td_errors_and_explained_variance():
    fine, bad = jnp.float32(1), jnp.float32(np.inf)
    assert not bool(learner.check([], {"loss": jnp.stack([fine, bad])}))
    assert bool(learner.check([jnp.zeros(3)], {"policy_loss": fine, EXPLAINED_VARIANCE: bad, TD_ERROR: bad}))


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_td_errors_that_are_not_finite_leave_priorities_as_they_are(bad):
    ring = Ring(8, 1, (Leaf("", "continuous", (1,), "float32"),), jax.tree.structure(0), (1,), np.dtype("float32"))
    priorities = Priorities(ring, PriorityConfig(alpha=1.0, epsilon=1e-3))
    ring.begin(np.zeros((1, 1), np.float32))
    for _ in range(4):
        priorities.add(*ring.add(np.zeros((1, 1)), np.zeros(1), np.zeros(1, bool), np.zeros((1, 1), np.float32)))
    rows, _, drawn = priorities.draw(np.random.default_rng(0), 4, 0.0)
    before = priorities.tree[rows.position].copy()
    priorities.update([(drawn, np.array([2.0, bad, 0.5, bad], np.float32))])
    after = priorities.tree[rows.position]
    np.testing.assert_allclose(after, [2.001, before[1], 0.501, before[3]])
    assert priorities.largest == pytest.approx(2.001)
    assert priorities.tree.total == pytest.approx(after.sum())


def test_statistics_pass_over_what_is_not_finite_and_do_not_overflow():
    values = np.random.default_rng(0).normal(size=(6, 3)).astype(np.float32)
    spoilt = np.insert(values, [2, 4], [[np.nan, 0, 0], [0, np.inf, 1]], axis=0).astype(np.float32)
    one = merged(no_moments((3,)), jnp.asarray(values), jnp.ones(6))
    two = merged(no_moments((3,)), jnp.asarray(spoilt), jnp.ones(8))
    jax.tree.map(np.testing.assert_allclose, one, two)
    assert float(two.n_seen) == 6
    after = merged(two, jnp.full((8, 3), 1e30), jnp.ones(8))
    jax.tree.map(np.testing.assert_array_equal, two, after)


@exhaustive
def test_rejeu_train_says_in_one_line_what_broke_and_keeps_the_batch_in_the_run_folder(tmp_path, capsys):
    command = ["train", "Pendulum-v1", "--steps", "300", "--out", str(tmp_path / "run"), "--backend", "gymnasium"]
    settings = ["learning_rate=1e30", "learning_starts=50", "batch_size=8", "policy_kwargs.net_arch=[8]"]
    assert cli.main([*command, "--algo", "SAC", "--set", *settings]) == 2
    said = capsys.readouterr().err.strip()
    (batch,) = (tmp_path / "run").glob("nonfinite_batch_*.safetensors")
    assert said.count("\n") == 0
    assert str(batch) in said
    assert "lower learning_rate (it is 1e+30)" in said
    assert not (tmp_path / "run" / "agent.safetensors").exists()
    assert (tmp_path / "run" / "episodes.csv").exists()
