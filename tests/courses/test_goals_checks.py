"""The checks of course 3 accept right answers, and name the mistake in typical wrong ones."""

import gymnasium as gym
import numpy as np
import pytest

import rejeu
from rejeu.courses import checks
from rejeu.courses.checks import goals as check
from tests.bit_flipping import BitFlipping


@pytest.fixture(autouse=True)
def language():
    checks.speak("en")


@pytest.mark.parametrize(
    ("test", "answers"),
    [
        (check.future, [lambda *_: [[1], [1, 2]]]),
        (check.steps_needed, [10**400]),
        (check.saving, [None, None, None, None]),
    ],
)
def test_an_answer_of_another_kind_gives_one_line(test, answers, capsys):
    assert not test(*answers)
    printed = capsys.readouterr().out
    assert "the check cannot use your answer (" in printed
    assert printed.count("\n") == 1


def compute_reward(achieved, desired, info):
    return np.where(np.all(achieved == desired, axis=-1), 0.0, -1.0)


def relabel(step, goal, observation="next_obs", **changes):
    reward = float(compute_reward(getattr(step, observation)["achieved_goal"], goal, {}))
    obs, next_obs = ({**seen, "desired_goal": goal} for seen in (step.obs, step.next_obs))
    new = {"obs": obs, "next_obs": next_obs, "reward": reward, "terminated": reward == 0} | changes
    return step._replace(**new)


def hindsight(episode, k, rng, draw=lambda rng, t, n, k: rng.integers(t, n, size=k), which="next_obs"):
    result = []
    for t, step in enumerate(episode):
        result.append(step)
        for later in draw(rng, t, len(episode), k):
            result.append(relabel(step, getattr(episode[later], which)["achieved_goal"]))  # noqa: PERF401
    return result


def future(rng, time, first, last):
    return rng.integers(time + 1, last + 1)


def final(rng, time, first, last):
    return last


def episode(rng, time, first, last):
    return rng.integers(first, last + 1)


def parking_reward(achieved, desired, weights):
    return -np.sqrt(abs(achieved - desired) @ weights)


RIGHT = [compute_reward, relabel, hindsight, future, final, episode, parking_reward]


@pytest.mark.parametrize("answer", RIGHT, ids=lambda answer: answer.__name__)
def test_a_right_answer_passes(answer, capsys):
    assert getattr(check, answer.__name__)(answer)
    assert capsys.readouterr().out == f"OK - {answer.__name__}\n"


def test_numbers_of_the_right_order_pass():
    assert check.steps_needed(4096)
    assert not check.steps_needed(12)


@pytest.mark.parametrize("answer", RIGHT, ids=lambda answer: answer.__name__)
@pytest.mark.parametrize("language", ["en", "fr"])
def test_unfilled_exercises_and_errors_give_one_line(answer, language, capsys):
    checks.speak(language)
    for wrong in (lambda *_: None, lambda *_: 1 / 0, lambda *_: "x", lambda *_: ..., 3):
        assert not getattr(check, answer.__name__)(wrong)
        out = capsys.readouterr().out
        assert len(out.splitlines()) == 1
        assert out.startswith({"en": "Not yet - ", "fr": "Pas encore - "}[language])


def changes_the_step(step, goal):
    step.obs["desired_goal"] = goal
    return relabel(step, goal)


def only_later(rng, time, first, last):
    return np.where(time + 2 <= last, rng.integers(np.minimum(time + 2, last), last + 1), last)


WRONG = [
    (compute_reward, lambda a, d, i: float(np.all(a == d)) - 1, "single number"),
    (compute_reward, lambda a, d, i: (a == d) - 1.0, "reward for each bit"),
    (compute_reward, lambda a, d, i: compute_reward(a, d, i) + 1, "it is 0 and -1"),
    (compute_reward, lambda a, d, i: -1 - compute_reward(a, d, i), "condition is reversed"),
    (compute_reward, lambda a, d, i: (a == d).mean(axis=-1) - 1, "number of wrong bits"),
    (compute_reward, lambda a, d, i: (a == d).any(axis=-1) - 1.0, "any or all"),
    (compute_reward, lambda a, d, i: np.where((a == d).all(axis=1), 0, -1), "AxisError"),
    (relabel, lambda s, g: relabel(s, g, obs=s.obs), "before the step (obs)"),
    (relabel, lambda s, g: relabel(s, g, next_obs=s.next_obs), "after the step (next_obs)"),
    (
        relabel,
        lambda s, g: relabel(s, g, obs={**s.obs, "desired_goal": g, "achieved_goal": g}),
        "more than the desired",
    ),
    (relabel, lambda s, g: relabel(s, g, reward=s.reward), "reward is still 0"),
    (relabel, lambda s, g: relabel(s, g, reward=0.0, terminated=True), "reward"),
    (relabel, lambda s, g: relabel(s, g, observation="obs"), "before the step"),
    (relabel, lambda s, g: relabel(s, g, terminated=False), "terminated is still False"),
    (relabel, lambda s, g: relabel(s, g, terminated=relabel(s, g).reward == 0 or s.terminated), "was kept"),
    (relabel, changes_the_step, "changes the arrays"),
    (relabel, lambda s, g: relabel(s, g).obs, "a Step is expected"),
    (hindsight, lambda e, k, rng: hindsight(e, k, rng)[1:], "steps, expected 6 x"),
    (hindsight, lambda e, k, rng: hindsight(e, k, rng, which="obs"), "achieved in s, before the action"),
    (hindsight, lambda e, k, rng: hindsight(e, k, rng, lambda rng, t, n, k: rng.integers(0, n, k)), "the past"),
    (hindsight, lambda e, k, rng: hindsight(e, k, rng, lambda rng, t, n, k: [n - 1] * k), "strategy final"),
    (hindsight, lambda e, k, rng: hindsight(e, k, rng, lambda rng, t, n, k: rng.integers(t + 1, n, k)), "ValueError"),
    (future, lambda rng, t, first, last: rng.integers(first, last + 1), "the past"),
    (future, lambda rng, t, first, last: rng.integers(t, last + 1), "achieved in s, before the action"),
    (future, lambda rng, t, first, last: rng.integers(t + 1, np.maximum(last, t + 2)), "excludes high"),
    (future, lambda rng, t, first, last: rng.integers(t + 1, last + 5), "another episode"),
    (future, lambda rng, t, first, last: last, "strategy final"),
    (future, only_later, "as often as every later one"),
    (future, lambda rng, t, first, last: rng.integers(t[0] + 1, last[0] + 1), "the shape ()"),
    (future, lambda rng, t, first, last: rng.uniform(t + 1, last), "whole numbers"),
    (final, lambda rng, t, first, last: last - 1, "last time but one"),
    (final, lambda rng, t, first, last: first, "the first time"),
    (final, lambda rng, t, first, last: t, "time of the step itself"),
    (episode, future, "strategy future"),
    (episode, lambda rng, t, first, last: rng.integers(first, last), "excludes high"),
    (episode, lambda rng, t, first, last: rng.integers(0, last + 1), "outside of the episode"),
    (episode, lambda rng, t, first, last: rng.integers(first + 1, last + 1), "first is never drawn"),
    (parking_reward, lambda a, d, w: -parking_reward(a, d, w), "a distance is a cost"),
    (parking_reward, lambda a, d, w: -abs(a - d) @ w, "square root is missing"),
    (parking_reward, lambda a, d, w: -np.sqrt((a - d) ** 2 @ w), "another norm"),
    (parking_reward, lambda a, d, w: -np.sqrt(abs(a - d).sum(axis=1)), "weights are missing"),
    (parking_reward, lambda a, d, w: -np.sqrt(abs(a - d)) @ w, "around the sum"),
    (parking_reward, lambda a, d, w: -np.sqrt(np.sum(w * abs(a - d))), "single number"),
]


@pytest.mark.parametrize(("right", "wrong", "message"), WRONG, ids=[f"{w[0].__name__}-{w[2]}" for w in WRONG])
def test_a_typical_mistake_is_named(right, wrong, message, capsys):
    assert not getattr(check, right.__name__)(wrong)
    out = capsys.readouterr().out
    assert message in out
    assert len(out.splitlines()) == 1


def save_all(agent, folder):
    agent.save(folder / "model")
    agent.save_replay_buffer(folder / "buffer")


def load_all(folder, env):
    agent = rejeu.DQN.load(folder / "model", env=env)
    agent.load_replay_buffer(folder / "buffer")
    return agent


def test_saving_needs_the_model_and_the_buffer(capsys):
    def make(seed=0):
        return rejeu.DQN("MultiInputPolicy", BitFlipping(4), replay_buffer_class="HerReplayBuffer", seed=seed)

    agent = make()
    agent.learn(20)
    wrong = [
        (save_all, lambda folder, env: rejeu.DQN.load(folder / "model", env=env), "holds 0 steps instead of 20"),
        (save_all, lambda folder, env: agent, "not one from the files"),
        (save_all, lambda folder, env: make(seed=1), "acts differently"),
        (lambda agent, folder: None, load_all, "FileNotFoundError"),
        (save_all, lambda folder, env: env, "instead of a DQN"),
    ]
    for save, load, message in wrong:
        assert not check.saving(save, load, agent, BitFlipping(4))
        out = capsys.readouterr().out
        assert message in out
        assert len(out.splitlines()) == 1
    assert check.saving(save_all, load_all, agent, BitFlipping(4))


def test_the_reward_of_parking_is_that_of_the_environment():
    pytest.importorskip("highway_env")
    env = gym.make("parking-v0").unwrapped
    obs, _ = env.reset(seed=0)
    goals = obs["achieved_goal"], obs["desired_goal"]
    ours = parking_reward(*(goal[None] for goal in goals), np.array([1.0, 0.3, 0.0, 0.0, 0.02, 0.02]))
    assert ours[0] == pytest.approx(float(env.compute_reward(*goals, {})))
